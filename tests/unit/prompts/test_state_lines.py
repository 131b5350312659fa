"""What prompts may say of the state beyond the paper's numbers, and what where it has no value.

The golden texts are of all registered state blocks; see test_render for how they are rewritten.
"""

import re
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from merge_runner.prompts import state_lines
from merge_runner.prompts.blocks import BLOCKS, VARIANTS, Variant
from tests.support.cases import table
from tests.support.prompts import FIRST, SEEN, check, shown

TIMES = ("own_time_to_merge", "other_time_to_merge", "time_gap")
LINES = (*TIMES, "projected_headway", "relative_speed")
STATE = [name for name in BLOCKS if name.startswith("state.")]


@pytest.fixture(autouse=True)
def _a_variant_with_all_state_blocks(own_parts):
    VARIANTS.register("everything", Variant(adds=frozenset(STATE)))


@pytest.mark.parametrize("case", SEEN)
def test_the_lines_are_the_golden_text(case):
    prompt = shown(SEEN[case], variant="everything")
    check(f"state_lines/{case}.txt", prompt[: prompt.index("\n\nPrevious plan")] + "\n")


def test_the_table_says_what_the_list_says():
    for road in ("merge", "straight"):
        listed, tabled = (getattr(BLOCKS[name], road) for name in ("C0", "state.table"))
        introduction, _, items = listed.partition("\n- ")
        assert tabled.startswith(introduction)
        rows = [line.strip("| ").split(" | ") for line in tabled.splitlines()[5:]]
        told = [f"{row[0]}: {' '.join(row[1:])}".strip() for row in rows]
        assert told == items.split("\n- ")


speeds = st.sampled_from([0.0, 1e-9, 0.0049, 0.005, 9.6, 10.4]) | st.floats(0, 40)
distances = st.sampled_from([0.0, -1e-9, 1e-9]) | st.floats(-150, 150)


@given(speeds, speeds, distances, st.none() | distances, st.booleans())
def test_no_state_is_said_in_numbers_that_are_none(own, other, relative, to_merge, seen):
    road = "straight" if to_merge is None else "merge"
    observation = replace(FIRST, road=road, own_speed_mps=own, other_speed_mps=other)
    observation = replace(
        observation, relative_distance_m=relative, distance_to_merge_m=to_merge, other_seen=seen
    )
    for name in LINES:
        said = getattr(state_lines, name)(observation)
        assert not re.search(r"\b(nan|inf|None)\b|-\d|\d{6}|e\+", said)
        assert (said == "not seen") == (not seen and name != "own_time_to_merge")


@pytest.mark.parametrize(("line", "said", "change"), table("observations", "lines"))
def test_a_line_says_the_state_in_words(line, said, change):
    assert getattr(state_lines, line)(replace(FIRST, **change)) == said
