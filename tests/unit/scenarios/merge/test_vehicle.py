"""The motion of one vehicle."""

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from merge_runner.scenarios.merge.vehicle import advance, net_acceleration, time_to_reach
from tests.support.cases import cases

speeds = st.floats(0, 30)
accelerations = st.floats(-5, 5)
steps = st.floats(0.01, 2)


@pytest.mark.parametrize("case", cases("track", "steps"))
def test_a_step_is_s_plus_v_dt_plus_half_a_dt_squared(case):
    velocity, acceleration, moved, new_velocity = case
    wanted = pytest.approx((50.0 + moved, new_velocity), abs=1e-12)
    assert advance(50.0, velocity, acceleration, 0.2) == wanted


@given(speeds, st.lists(accelerations, min_size=1, max_size=20), steps)
def test_speed_is_never_negative_and_a_vehicle_never_reverses(velocity, commands, step):
    position = 0.0
    for acceleration in commands:
        new_position, velocity = advance(position, velocity, acceleration, step)
        assert velocity >= 0
        assert new_position >= position
        position = new_position


@given(speeds, accelerations, steps)
def test_two_half_steps_equal_one_step(velocity, acceleration, step):
    """Also across a stop, since a stopped vehicle stays."""
    half = advance(0.0, velocity, acceleration, step / 2)
    twice = advance(*half, acceleration, step / 2)
    assert twice == pytest.approx(advance(0.0, velocity, acceleration, step), abs=1e-9)


@given(speeds, accelerations, steps)
def test_time_to_reach_inverts_the_motion(velocity, acceleration, step):
    distance, _ = advance(0.0, velocity, acceleration, step)
    assert time_to_reach(0.0, velocity, acceleration) == 0.0
    assume(distance > 1e-6)
    seconds = time_to_reach(distance, velocity, acceleration)
    assert 0 < seconds <= step + 1e-6
    assert advance(0.0, velocity, acceleration, seconds)[0] == pytest.approx(distance, rel=1e-6)


@pytest.mark.parametrize(
    ("resistance", "velocity", "drag"),
    [("human", 0.0, 0.5), ("human", 10.0, 1.0), ("human", 20.0, 2.5), ("none", 10.0, 0.0)],
)
def test_the_human_resistance_takes_half_plus_0_005_v_squared(resistance, velocity, drag):
    assert net_acceleration(1.25, velocity, resistance) == pytest.approx(1.25 - drag, abs=1e-12)
