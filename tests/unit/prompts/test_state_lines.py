"""What prompts may say of the state beyond the paper's numbers, and what where it has no value.

The golden texts are of all registered state blocks; see test_render for how they are rewritten.
"""

import os
import re
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from merge_runner.prompts import state_lines
from merge_runner.prompts.blocks import BLOCKS, VARIANTS, Variant
from merge_runner.records import FAR_BEHIND_M
from tests.unit.prompts.test_render import FIRST, FORMS, STRAIGHT, shown

GOLDEN = Path(__file__).parents[2] / "golden" / "state_lines"
UPDATE = os.environ.get("UPDATE_GOLDEN_PROMPTS") == "1"
UNSEEN = replace(
    FIRST,
    other_seen=False,
    other_speed_mps=FIRST.own_speed_mps,
    relative_distance_m=-FAR_BEHIND_M,
    other_speeds_mps=(),
)
CASES = {
    **{form: observation for form, (observation, _) in FORMS.items()},
    "standing": replace(FIRST, own_speed_mps=0.0, other_speed_mps=0.0),
    "other_passed": replace(FIRST, relative_distance_m=45.0),
    "unseen": UNSEEN,
    "unseen_straight": replace(UNSEEN, road="straight", distance_to_merge_m=None),
}
TIMES = ("own_time_to_merge", "other_time_to_merge", "time_gap")
LINES = (*TIMES, "projected_headway", "relative_speed")
STANDS = {"own_speed_mps": 0.0}
STATE = [name for name in BLOCKS if name.startswith("state.")]


@pytest.fixture(autouse=True)
def _a_variant_with_all_state_blocks(own_parts):
    VARIANTS.register("everything", Variant(adds=frozenset(STATE)))


@pytest.mark.parametrize("case", CASES)
def test_the_lines_are_the_golden_text(case):
    file = GOLDEN / f"{case}.txt"
    prompt = shown(CASES[case], variant="everything")
    lines = prompt[: prompt.index("\n\nPrevious plan")] + "\n"
    if UPDATE:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(lines.encode())
    assert lines == file.read_bytes().decode()


def test_every_golden_file_is_checked():
    assert {file.stem for file in GOLDEN.iterdir()} == {*CASES}


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


@pytest.mark.parametrize(
    ("line", "change", "said"),
    [
        # FIRST is how L_4_-8 starts for the left vehicle, whose projected headway is 4 m.
        ("projected_headway", {}, "you are 4.00 m ahead"),
        ("relative_speed", {"other_speed_mps": 10.4}, "the other car is 0.8 m/s faster than you"),
        ("relative_speed", {"other_speed_mps": 8.8}, "the other car is 0.8 m/s slower than you"),
        ("relative_speed", {"other_speed_mps": 9.65}, "the other car is as fast as you"),
        ("relative_speed", {"other_speed_mps": 9.55}, "the other car is as fast as you"),
        ("relative_speed", {"other_speed_mps": 9.66}, "the other car is 0.1 m/s faster than you"),
        ("time_gap", {"relative_distance_m": 12.0}, "the other car is 1.25 s ahead"),
        ("time_gap", {"relative_distance_m": -12.48}, "you are 1.20 s ahead"),
        ("time_gap", {"relative_distance_m": 0.0}, "neither, both cars are level"),
        ("time_gap", STANDS | {"relative_distance_m": 3.0}, "not defined, you stand still"),
        ("time_gap", {"other_speed_mps": 0.0}, "not defined, the other car stands still"),
        ("own_time_to_merge", {}, "4.42 s"),
        ("other_time_to_merge", {}, "4.81 s"),
        ("own_time_to_merge", STANDS, "never, you stand still"),
        ("other_time_to_merge", STANDS, "4.81 s"),
        ("own_time_to_merge", {"other_speed_mps": 0.0}, "4.42 s"),
        ("other_time_to_merge", {"other_speed_mps": 0.0}, "never, it stands still"),
        ("own_time_to_merge", {"relative_distance_m": 45.0}, "4.42 s"),
        ("other_time_to_merge", {"relative_distance_m": 45.0}, "it has passed it"),
        ("own_time_to_merge", {"distance_to_merge_m": -1.0}, "you have passed it"),
        ("other_time_to_merge", {"distance_to_merge_m": -1.0}, "0.63 s"),
    ],
)
def test_a_line_says_the_state_in_words(line, change, said):
    assert getattr(state_lines, line)(replace(FIRST, **change)) == said


def test_what_is_not_seen_has_no_unit():
    prompt = shown(UNSEEN, variant="everything")
    assert "not seen" in prompt
    assert not re.search(r"not seen (m|s|km|mph)", prompt)
    assert "- Observed speeds of the other car (m/s): not seen\n" in prompt


def test_a_car_that_is_seen_is_never_said_not_to_be():
    assert "not seen" not in shown(STRAIGHT)
