"""What a driver is told where its perception is imperfect."""

from dataclasses import replace
from itertools import pairwise
from math import exp
from random import Random
from statistics import fmean, pstdev

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from merge_runner.config import PERFECT, Perception, ScenarioConfig
from merge_runner.drivers.registry import PROGRAMS
from merge_runner.perception import NoisyObserver, error_process
from merge_runner.records import FAR_BEHIND_M, SIDES
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from tests.support import driven_trials
from tests.support.driven_trials import OTHER, both

FOGGY = {
    "position_sd_m": 0.5,
    "speed_sd_mps": 0.3,
    "autocorrelation_s": 1.0,
    "delay_s": 0.4,
    "dropout": 0.2,
    "range_m": 7.0,
}
NOTHING_OF_THE_OTHER = {
    "other_seen": True,
    "other_speed_mps": 0,
    "relative_distance_m": 0,
    "other_speeds_mps": (),
    "other_acceleration_mps2": 0,
}
few = settings(max_examples=20)
names = st.sampled_from(sorted(CONDITIONS))
seeds = st.integers(0, 2**64 - 1)
actions = st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=1, max_size=8)
scenarios = st.builds(
    ScenarioConfig,
    control_start=st.sampled_from(["both_exits", "own_exit"]),
    straight_after=st.sampled_from(["own", "both"]),
    history_start=st.sampled_from(["cruise", "empty"]),
)


def drive(pairs, condition="L_4_-8", scenario=None, steps=5):
    """The world after each step, each pair of actions being held for so many steps."""
    world = World(scenario or ScenarioConfig(), CONDITIONS[condition], TRACK)
    yield world
    for left, right in pairs:
        for _ in range(steps):
            world.drive([left], [right])
            yield world


def watched(perception, truths, seed=1, step_s=0.2):
    """Yield the observation of each step of the true ones."""
    truths = list(truths)
    observer = NoisyObserver(Perception(**perception), seed, step_s, truths.__getitem__)
    for step in range(len(truths)):
        yield observer.observe(step)


def truths(side="left", pairs=((0.4, -0.2), (-0.7, 0.9), (0.1, 0.3)), **options):
    return [world.observe(side) for world in drive(pairs, **options)]


def of_the_other(seen):
    return {name: getattr(seen, name) for name in NOTHING_OF_THE_OTHER}


def of_the_own(seen):
    return replace(seen, **NOTHING_OF_THE_OTHER)


@few
@given(names, scenarios, actions, seeds)
def test_without_errors_delay_dropout_and_range_the_truth_is_told(condition, scenario, pairs, seed):
    """By the observer itself, which a trial with such a perception has not."""
    true = truths("right", pairs, condition=condition, scenario=scenario)
    assert Perception() == PERFECT
    assert list(watched({}, true, seed)) == true


@few
@given(names, actions, seeds)
def test_only_what_is_known_of_the_other_changes_unless_own_is_asked_for(condition, pairs, seed):
    true = truths("left", pairs, condition=condition)
    told = list(watched(FOGGY, true, seed))
    assert list(map(of_the_own, told)) == list(map(of_the_own, true))
    assert told != true


def test_own_errors_keep_the_position_and_the_distance_to_the_merge_point_together():
    true = truths()
    told = list(watched({"position_sd_m": 0.5, "speed_sd_mps": 0.3, "own": True}, true))
    own, others = set(), set()
    for seen, so in zip(told, true, strict=True):
        error_m = seen.own_position_m - so.own_position_m
        own.add(error_m)
        others.add(seen.relative_distance_m - so.relative_distance_m)
        assert seen.own_speed_mps != so.own_speed_mps
        assert seen.own_accelerations_mps2 == so.own_accelerations_mps2
        if so.distance_to_merge_m is not None:
            assert seen.distance_to_merge_m == pytest.approx(so.distance_to_merge_m - error_m)
    assert len(others) == len(own) == len(true)
    assert not others & own


@few
@given(st.integers(1, 8), st.sampled_from([{}, {"position_sd_m": 0.5, "speed_sd_mps": 0.3}]))
def test_a_delay_shows_of_the_other_what_was_seen_that_long_ago(steps, errors):
    true = truths()
    now = list(watched(errors, true))
    late = list(watched({**errors, "delay_s": 0.2 * steps}, true))
    for earlier, later in zip(now, late[steps:], strict=False):
        assert of_the_other(later) == of_the_other(earlier)


def test_what_is_seen_late_at_the_start_is_the_cruise_before_it():
    """In L_4_-8 the left vehicle is ahead, and falls back by 0.8 m a second."""
    true = truths("right")[0]
    told = next(watched({"delay_s": 1.0}, [true]))
    assert told.other_speed_mps == true.other_speed_mps == 9.6
    assert told.relative_distance_m - true.relative_distance_m == pytest.approx(0.8)
    assert told.other_speeds_mps == (9.6,) * 10


def test_errors_have_the_stated_size_and_fade_at_the_stated_pace():
    sd, tau_s, step_s = 0.5, 0.8, 0.4
    series = [
        [error(k * step_s) for k in range(100)]
        for error in (error_process((seed,), sd, tau_s) for seed in range(150))
    ]
    flat = [value for values in series for value in values]
    assert fmean(flat) == pytest.approx(0, abs=0.03)
    assert pstdev(flat) == pytest.approx(sd, rel=0.03)
    for lag in (1, 2, 4):
        products = [a * b for values in series for a, b in zip(values, values[lag:], strict=False)]
        wanted = exp(-lag * step_s / tau_s)
        assert fmean(products) / sd**2 == pytest.approx(wanted, abs=0.05)


def test_errors_that_hardly_fade_have_the_stated_size_too():
    values = [error_process((seed,), 0.5, 1e9)(0.0) for seed in range(2000)]
    assert pstdev(values) == pytest.approx(0.5, rel=0.03)


def test_without_autocorrelation_each_instant_has_an_error_of_its_own():
    error = error_process(("x",), 1.0, 0.0)
    values = [error(k / 20) for k in range(2000)]
    assert pstdev(values) == pytest.approx(1, rel=0.03)
    assert fmean(a * b for a, b in pairwise(values)) == pytest.approx(0, abs=0.06)


@pytest.mark.parametrize("tau_s", [0.0, 0.3, 2.0, 1e6])
def test_the_errors_do_not_depend_on_the_steps_and_the_order_in_which_they_are_asked(tau_s):
    times = [k / 20 for k in range(-60, 200)]
    coarse = {t: error_process((1,), 1.0, tau_s)(t) for t in times[::40]}
    fine = error_process((1,), 1.0, tau_s)
    values = {t: fine(t) for t in Random(2).sample(times, len(times))}
    assert {t: values[t] for t in coarse} == coarse


def test_the_history_is_what_was_told_at_the_time():
    """Speeds told now stand unchanged in what is told later."""
    told = list(watched({"speed_sd_mps": 0.3, "autocorrelation_s": 0.5}, truths()))
    speeds = [seen.other_speed_mps for seen in told]
    for step in range(11, len(told)):
        assert list(told[step].other_speeds_mps) == pytest.approx(speeds[step - 10 : step])


def test_a_dropped_observation_shows_what_was_received_last():
    true = truths(pairs=[(0.4, -0.2)] * 8)
    told = list(watched({"dropout": 0.5}, true, seed=3))
    received = [of_the_other(seen) == of_the_other(so) for seen, so in zip(told, true, strict=True)]
    assert 0.3 < fmean(received[1:]) < 0.7
    for (before, after), got in zip(pairwise(told), received[1:], strict=True):
        assert got or of_the_other(after) == of_the_other(before)


def test_before_anything_is_received_the_other_cruises():
    true = truths()
    for told in watched({"dropout": 1.0, "speed_sd_mps": 5.0}, true):
        assert of_the_other(told) == of_the_other(true[0])


def test_the_other_is_seen_within_the_range_alone():
    """In L_4_-8 the right vehicle is behind, and draws level with the left one."""
    true = truths("left", [(-1.0, 0.5)] * 4)
    told = list(watched({"range_m": 3.0}, true))
    assert {seen.other_seen for seen in told} == {True, False}
    for seen, so in zip(told, true, strict=True):
        assert seen.other_seen == (abs(so.relative_distance_m) <= 3.0)
        if not seen.other_seen:
            assert seen.relative_distance_m == -FAR_BEHIND_M
            assert seen.other_speed_mps == so.own_speed_mps
            assert (seen.other_speeds_mps, seen.other_acceleration_mps2) == ((), 0.0)


def test_the_other_is_seen_from_so_many_metres_before_the_merge_point_on():
    """Late, it is seen so much later."""
    true = truths("left", [(0.0, 0.0)] * 6)
    distances_m = [so.distance_to_merge_m or 0.0 for so in true]
    for delay in (0, 2):
        told = list(watched({"view_from_m": 30.0, "delay_s": 0.2 * delay}, true))
        near = [False] * delay + [distance_m <= 30.0 for distance_m in distances_m]
        assert [seen.other_seen for seen in told] == near[: len(told)]
        assert (true[-1].road, {*near}) == ("straight", {True, False})


def test_the_history_begins_where_the_other_came_into_sight():
    told = list(watched({"range_m": 3.0}, truths("left", [(-1.0, 0.5)] * 4)))
    first = next(step for step, seen in enumerate(told) if seen.other_seen)
    assert [len(seen.other_speeds_mps) for seen in told[first : first + 4]] == [0, 1, 2, 3]


def test_no_speed_appears_negative():
    standing = replace(truths()[0], own_speed_mps=0.0, other_speed_mps=0.0)
    told = [
        next(watched({"speed_sd_mps": 3.0, "own": True}, [standing], seed)) for seed in range(50)
    ]
    assert min(seen.other_speed_mps for seen in told) == 0.0
    assert min(seen.own_speed_mps for seen in told) == 0.0
    assert max(seen.other_speed_mps for seen in told) > 1.0


def play(name="projected-order", condition="L_4_-8", repetition=1, **scenario):
    task = ScenarioConfig(**scenario)
    return driven_trials.play(both(PROGRAMS[name]), condition, repetition, scenario=task)


def outcome(trial):
    return trial.status, trial.merged_first, trial.end_time_s, trial.states


def test_a_driver_with_a_noiseless_observer_drives_as_one_without():
    far = {"range_m": 1e6}
    trial, usual = play(perception_left=far, perception_right=far), play()
    assert outcome(trial) == outcome(usual)
    assert [row.decision for row in trial.decisions] == [row.decision for row in usual.decisions]
    assert all(row.observed and row.observed.other_seen for row in trial.decisions)
    foggy = play(perception_right=FOGGY)
    assert outcome(foggy) != outcome(usual)
    assert all((row.observed is None) == (row.side == "left") for row in foggy.decisions)


def test_both_sides_have_errors_of_their_own_and_a_slot_keeps_its_errors():
    """Whoever drives: with a steady world, which does not show who does."""
    noisy = {"perception_left": {"speed_sd_mps": 0.3}, "perception_right": {"speed_sd_mps": 0.3}}

    def errors(trial, side):
        truth = {(s.side, s.time_s): s.velocity_mps for s in trial.states}
        return [
            row.observed.other_speed_mps - truth[OTHER[side], row.time_s]
            for row in trial.decisions
            if row.side == side
        ][:4]

    trial = play("constant", "N_0_0", **noisy)
    assert errors(trial, "left") != errors(trial, "right")
    other = play("projected-order", "N_0_0", **noisy)
    for side in SIDES:
        assert errors(trial, side) == pytest.approx(errors(other, side))
    again = play("constant", "N_0_0", 2, **noisy)
    assert errors(again, "left") != errors(trial, "left")


def test_perfect_perception_is_no_part_of_a_spec():
    assert ScenarioConfig().model_dump() == ScenarioConfig(perception_left={}).model_dump()
    assert not [name for name in ScenarioConfig().model_dump() if "perception" in name]
    dumped = ScenarioConfig(perception_left=FOGGY).model_dump()
    assert dumped["perception_left"]["speed_sd_mps"] == 0.3
    assert "perception_right" not in dumped
    assert ScenarioConfig.model_validate(dumped) == ScenarioConfig(perception_left=FOGGY)
