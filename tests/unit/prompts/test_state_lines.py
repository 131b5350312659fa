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

from merge_runner.config import ScenarioConfig
from merge_runner.prompts import state_lines
from merge_runner.prompts.blocks import BLOCKS, VARIANTS, Variant, prompt_of, render_prompt
from merge_runner.records import FAR_BEHIND_M
from tests.unit.prompts.test_render import FIRST, FORMS, STRAIGHT

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
OTHER = "the other car"
STATE = [name for name in BLOCKS if name.startswith("state.")]


@pytest.fixture
def everything(own_parts):
    """A variant with all state blocks."""
    VARIANTS.register("everything", Variant(adds=frozenset(STATE)))
    return "everything"


def render(observation, variant):
    return render_prompt(observation, None, prompt=prompt_of(variant), scenario=ScenarioConfig())


@pytest.mark.parametrize("case", CASES)
def test_the_lines_are_the_golden_text(case, everything):
    file = GOLDEN / f"{case}.txt"
    prompt = render(CASES[case], everything)
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
    observation = replace(
        FIRST,
        road="straight" if to_merge is None else "merge",
        own_speed_mps=own,
        other_speed_mps=other,
        relative_distance_m=relative,
        distance_to_merge_m=to_merge,
        other_seen=seen,
    )
    for function in LINES:
        said = function(observation)
        assert not re.search(r"\b(nan|inf|None)\b|-\d|\d{6}|e\+", said)
        assert (said == "not seen") == (not seen and function is not state_lines.own_time_to_merge)


LINES = (
    state_lines.projected_headway,
    state_lines.own_time_to_merge,
    state_lines.other_time_to_merge,
    state_lines.time_gap,
    state_lines.relative_speed,
)


def test_the_projected_headway_is_that_of_the_condition():
    """FIRST is how L_4_-8 starts for the left vehicle, whose projected headway is 4 m."""
    assert state_lines.projected_headway(FIRST) == "you are 4.00 m ahead"


@pytest.mark.parametrize(
    ("own", "other", "said"),
    [
        (10.0, 10.8, "the other car is 0.8 m/s faster than you"),
        (10.0, 9.2, "the other car is 0.8 m/s slower than you"),
        (10.0, 10.05, "the other car is as fast as you"),
        (10.0, 9.95, "the other car is as fast as you"),
        (10.0, 10.06, "the other car is 0.1 m/s faster than you"),
    ],
)
def test_the_relative_speed_is_said_in_words(own, other, said):
    seen = replace(FIRST, own_speed_mps=own, other_speed_mps=other)
    assert state_lines.relative_speed(seen) == said


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"relative_distance_m": 12.0}, "the other car is 1.25 s ahead"),
        ({"relative_distance_m": -12.48}, "you are 1.20 s ahead"),
        ({"relative_distance_m": 0.0}, "neither, both cars are level"),
        ({"own_speed_mps": 0.0, "relative_distance_m": 3.0}, "not defined, you stand still"),
        (
            {"other_speed_mps": 0.0, "relative_distance_m": -3.0},
            "not defined, the other car stands still",
        ),
    ],
)
def test_the_time_gap_is_that_of_the_car_behind(change, said):
    assert state_lines.time_gap(replace(FIRST, **change)) == said


@pytest.mark.parametrize(
    ("change", "own", "other"),
    [
        ({}, "4.42 s", "4.81 s"),
        ({"own_speed_mps": 0.0}, "never, you stand still", "4.81 s"),
        ({"other_speed_mps": 0.0}, "4.42 s", "never, it stands still"),
        ({"relative_distance_m": 45.0}, "4.42 s", "it has passed it"),
        ({"distance_to_merge_m": -1.0}, "you have passed it", "0.63 s"),
    ],
)
def test_the_times_to_the_merge_point_are_those_at_present_speeds(change, own, other):
    seen = replace(FIRST, **change)
    assert state_lines.own_time_to_merge(seen) == own
    assert state_lines.other_time_to_merge(seen) == other


def test_what_is_not_seen_has_no_unit(everything):
    prompt = render(UNSEEN, everything)
    assert "not seen" in prompt
    assert not re.search(r"not seen (m|s|km|mph)", prompt)
    assert "- Observed speeds of the other car (m/s): not seen\n" in prompt


def test_a_car_that_is_seen_is_never_said_not_to_be():
    assert "not seen" not in render(STRAIGHT, "baseline")
