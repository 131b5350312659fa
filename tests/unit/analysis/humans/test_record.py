"""What a recording becomes: its condition, its outcome, its times and its ids."""

from itertools import pairwise

import pytest

from merge_runner.scenarios.merge.conditions import CONDITIONS, HUMAN_CONDITIONS
from merge_runner_analysis.humans.archive import Unreadable
from merge_runner_analysis.humans.record import (
    SPEC_HASH,
    condition_of,
    parse_csv,
    trace_of,
    trial_record,
    trials_of,
)
from tests.support.pages import velocity_page
from tests.support.recordings import drive


def record(recording, experiment=6, iteration=1):
    return trial_record(parse_csv(recording.csv()), experiment, iteration)


def changed(name, values, condition="L_4_0", **how):
    """A recording of which the first values of a column are others."""
    recording = drive(condition, **how)
    recording.columns[name][: len(values)] = values
    return recording


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("condition", CONDITIONS)
def test_every_condition_is_known_by_its_start_also_one_step_late(condition, late):
    found = record(drive(condition, late=late))
    assert found.spec.condition == condition
    assert found.spec.trial_id == f"human/pair3/{condition}/iter001"


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    ("name", "near", "far"),
    [("travelled_distance.right", 0.59, 0.61), ("velocities.left", 0.099, 0.101)],
)
def test_a_start_is_a_condition_s_within_the_tolerance_alone(name, near, far, sign):
    (start,) = drive("N_0_0").columns[name][:1]
    assert record(changed(name, [start + sign * near], "N_0_0")).spec.condition == "N_0_0"
    with pytest.raises(Unreadable, match="starts like none of the conditions: left"):
        record(changed(name, [start + sign * far], "N_0_0"))


@pytest.mark.parametrize(
    ("experiment", "pair"),
    [(4, "pair1"), (6, "pair3"), (8, "pair4"), (13, "pair9"), (7, "experiment_7")],
)
def test_pairs_are_numbered_as_in_the_publications(experiment, pair):
    spec = record(drive(), experiment, 12).spec
    assert (spec.pair, spec.trial_id) == (pair, f"human/{pair}/L_4_0/iter012")
    assert (spec.repetition, spec.sample_set, spec.variant, spec.scripted) == (12, 0, None, False)
    assert (spec.source, spec.model_left, spec.model_right) == ("human", "human", "human")
    assert spec.spec_hash == SPEC_HASH


@pytest.mark.parametrize(
    ("recording", "status", "first", "error"),
    [
        (drive(), "finished", "left", None),
        (drive(yields="left"), "finished", "right", None),
        (drive("N_0_0", yields="nobody"), "collided", None, None),
        (drive("N_0_0", yields="both"), "timeout", None, None),
        # Also past the merge point.
        (changed("end_state", ["Collided"]), "collided", None, None),
        (changed("end_state", ["Time ran out"]), "timeout", "left", None),
        (changed("end_state", ["Beyond track bounds"]), "failed", None, "Beyond track bounds"),
    ],
)
def test_outcomes_are_those_of_the_trial(recording, status, first, error):
    found = record(recording)
    assert (found.status, found.merged_first, found.error) == (status, first, error)


def unfinished():
    recording = drive()
    for name, values in recording.columns.items():
        recording.columns[name] = values[:-3] if len(values) > 1 else values
    return recording


@pytest.mark.parametrize(
    ("recording", "says"),
    [
        (changed("end_state", ["Won"]), "end_state is 'Won'; known: Finished, Collided, Time"),
        (unfinished(), r"Finished, but ends with no vehicle beyond 14[0-8]\.\d m"),
        (
            changed("travelled_distance.left", [4.0, *[20.0] * 600], yields="both"),
            "never both beyond the tunnels",
        ),
    ],
)
def test_a_trial_that_ends_like_none_is_refused(recording, says):
    with pytest.raises(Unreadable, match=says):
        record(recording)


@pytest.mark.parametrize(
    ("before", "now", "first"),
    [
        ((99.6, 99.7), (100.3, 100.8), "right"),
        ((99.7, 99.6), (100.8, 100.3), "left"),
        ((99.0, 99.9), (99.9, 100.0), "right"),
    ],
)
def test_the_time_within_the_step_decides_who_merged_first(before, now, first):
    recording = drive("L_4_0")
    for side, *passing in zip(("left", "right"), before, now, strict=True):
        positions = recording.columns[f"travelled_distance.{side}"]
        positions[150:] = [*passing, *(passing[1] + n for n in range(1, len(positions) - 151))]
        positions[2:150] = [min(position, passing[0]) for position in positions[2:150]]
    assert record(recording).merged_first == first


def test_times_count_from_the_first_sample_with_both_out_of_the_tunnel():
    recording = drive("R_-4_8")
    left, right = (recording.columns[f"travelled_distance.{side}"] for side in ("left", "right"))
    found = record(recording)
    states = {(s.step, s.side): s for s in found.states}
    assert len(states) == 2 * len(left)
    first = min(step for step, _ in states)
    assert left[-first] > 50 >= left[-first - 1]
    assert right[-first - 1] > 50
    for step in (first, -1, 0, 1, 3):
        for side, positions in (("left", left), ("right", right)):
            state, speeds = states[step, side], recording.columns[f"velocities.{side}"]
            assert (state.time_s, state.position_m, state.velocity_mps) == (
                round(step / 20, 9), positions[step - first], speeds[step - first],
            )  # fmt: skip
    assert found.end_time_s == found.states[-1].time_s == round((len(left) - 1 + first) / 20, 9)


@pytest.mark.parametrize("step_s", [0.05, 0.02])
def test_accelerations_are_those_realised_over_the_step_before_which_the_file_names(step_s):
    recording = changed("dt", [1000 * step_s])
    speeds = recording.columns["velocities.left"]
    states = [s for s in record(recording).states if s.side == "left"]
    assert states[1].time_s - states[0].time_s == pytest.approx(step_s)
    assert [s.acceleration_mps2 for s in states] == pytest.approx(
        [0, *((b - a) / step_s for a, b in pairwise(speeds))]
    )


def test_the_pages_are_named_as_in_the_publications():
    for name in HUMAN_CONDITIONS:
        assert condition_of(f"docs/plots/{name.split('_', 1)[1]}.html") == name
    assert condition_of("L_4_-8.html") == "L_4_-8"
    assert condition_of("initial_action.html") is condition_of("experiment_4_iter_1.csv") is None


def swap(traces):
    traces["left"]["line"].update(dash="dash")
    traces["right"]["line"].update(dash="solid")


def cut(traces):
    for each in traces.values():
        for axis in "xy":
            del each[axis][120:]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda traces: traces.pop("right"), "it does not show both vehicles"),
        (lambda traces: traces["left"]["x"].pop(), "it does not show both vehicles"),
        (lambda traces: traces["left"]["x"].__setitem__(3, 0.3), "at equal steps from 0 s on"),
        (lambda traces: traces["left"]["x"].__setitem__(0, 0.05), "at equal steps from 0 s on"),
        (swap, "its lines are dash and solid, but left is ahead at the end"),
        (lambda traces: traces["left"]["line"].update(dash="dot"), "its lines are dot and dash"),
        (cut, "with no vehicle beyond"),
    ],
)
def test_a_trial_that_the_page_does_not_show_whole_says_why(change, says):
    ((_, _, traces),) = trials_of(velocity_page({"1-1": drive("L_4_0")}), "L_4_0")
    assert trace_of(traces, "L_4_0").velocities_mps["left"] == traces["left"]["y"]
    change(traces)
    with pytest.raises(Unreadable, match=says):
        trace_of(traces, "L_4_0")
