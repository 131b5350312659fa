"""What a recording becomes: its condition, its outcome, its times and its ids."""

from __future__ import annotations

from itertools import pairwise

import pytest

from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.human.archive import Unreadable
from merge_runner_analysis.human.record import SPEC_HASH, parse_csv, trial_record
from tests.support.recordings import drive


def record(recording, experiment=6, iteration=1):
    return trial_record(parse_csv(recording.csv()), experiment, iteration)


def moved(recording, *, position=0.0, velocity=0.0):
    recording.columns["travelled_distance.right"][0] += position
    recording.columns["velocities.left"][0] += velocity
    return recording


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("condition", CONDITIONS)
def test_every_condition_is_known_by_its_start_also_one_step_late(condition, late):
    found = record(drive(condition, late=late))
    assert found.spec.condition == condition
    assert found.spec.trial_id == f"human/pair3/{condition}/iter001"


@pytest.mark.parametrize("sign", [1, -1])
def test_a_start_is_a_condition_s_within_the_tolerance_alone(sign):
    for near in ({"position": sign * 0.59}, {"velocity": sign * 0.099}):
        assert record(moved(drive("N_0_0"), **near)).spec.condition == "N_0_0"
    for far in ({"position": sign * 0.61}, {"velocity": sign * 0.101}):
        with pytest.raises(Unreadable, match="starts like none of the conditions: left"):
            record(moved(drive("N_0_0"), **far))


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
    ("condition", "yields", "status", "first"),
    [
        ("L_4_0", "right", "finished", "left"),
        ("L_4_0", "left", "finished", "right"),
        ("N_0_0", "nobody", "collided", None),
        ("N_0_0", "both", "timeout", None),
    ],
)
def test_outcomes_are_those_of_the_trial(condition, yields, status, first):
    found = record(drive(condition, yields=yields))
    assert (found.status, found.merged_first, found.error) == (status, first, None)


def test_a_collision_has_no_first_even_past_the_merge_point():
    recording = drive("L_4_0")
    recording.columns["end_state"] = ["Collided"]
    assert record(recording).merged_first is None


def test_a_timeout_has_a_first_if_anyone_merged():
    recording = drive("L_4_0")
    recording.columns["end_state"] = ["Time ran out"]
    found = record(recording)
    assert (found.status, found.merged_first) == ("timeout", "left")


def test_leaving_the_track_is_a_failure_that_says_so():
    recording = drive("L_4_0")
    recording.columns["end_state"] = ["Beyond track bounds"]
    found = record(recording)
    assert (found.status, found.merged_first) == ("failed", None)
    assert found.error == "Beyond track bounds"


def test_an_unknown_end_is_refused():
    recording = drive()
    recording.columns["end_state"] = ["Won"]
    with pytest.raises(Unreadable, match="end_state is 'Won'; known: Finished, Collided, Time"):
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
            assert states[step, side].time_s == round(step / 20, 9)
            assert states[step, side].position_m == positions[step - first]
            speeds = recording.columns[f"velocities.{side}"]
            assert states[step, side].velocity_mps == speeds[step - first]
    assert found.end_time_s == found.states[-1].time_s == round((len(left) - 1 + first) / 20, 9)


def test_50_m_itself_is_in_the_tunnel():
    recording = drive("N_0_0")
    left, right = (recording.columns[f"travelled_distance.{side}"] for side in ("left", "right"))
    k = next(k for k, s in enumerate(left) if s > 50)
    left[k] = 50.0
    first = record(recording).states[0].step
    assert (k + 1) == -first
    assert right[k] > 50


def test_accelerations_are_those_realised_over_the_step_before():
    recording = drive("L_4_0")
    speeds = recording.columns["velocities.left"]
    found = [s.acceleration_mps2 for s in record(recording).states if s.side == "left"]
    assert found[0] == 0
    assert found[1:] == pytest.approx([(b - a) / 0.05 for a, b in pairwise(speeds)])


def test_the_step_is_the_file_s_own():
    recording = drive("L_4_0")
    recording.columns["dt"] = [20]
    states = record(recording).states
    assert states[2].time_s - states[0].time_s == pytest.approx(0.02)
    speeds = recording.columns["velocities.left"]
    assert states[2].acceleration_mps2 == pytest.approx((speeds[1] - speeds[0]) / 0.02)


def test_a_trial_that_never_leaves_the_tunnels_is_refused():
    recording = drive("L_4_0", yields="both")
    recording.columns["travelled_distance.left"][1:] = [20.0] * 600
    with pytest.raises(Unreadable, match="never both beyond the tunnels"):
        record(recording)


def test_a_finished_trial_without_its_end_is_refused():
    recording = drive("L_4_0")
    recording.columns = {
        name: values[:-3] if len(values) > 1 else values
        for name, values in recording.columns.items()
    }
    with pytest.raises(
        Unreadable, match=r"Finished, but ends with no vehicle beyond 14[0-8]\.\d m"
    ):
        record(recording)
