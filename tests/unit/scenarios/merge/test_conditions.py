"""The 11 conditions have the start of control that the human experiment gave its participants."""

from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from merge_runner.scenarios.merge.conditions import CONDITIONS, condition_name
from merge_runner.scenarios.merge.geometry import TRACK

# Speeds in m/s, travelled distances in m, times in s, always (left, right).
# name: (speeds, starts, exit times, positions when both are out)
TABLE = {
    "N_0_0": ((10.0, 10.0), (0, 0), (5.0, 5.0), (50, 50)),
    "L_0_-8": ((9.6, 10.4), (7.6923, 0), (4.4071, 4.8077), (53.8462, 50)),
    "L_2_-8": ((9.6, 10.4), (9.5385, 0), (4.2147, 4.8077), (55.6923, 50)),
    "L_4_-8": ((9.6, 10.4), (11.3846, 0), (4.0224, 4.8077), (57.5385, 50)),
    "L_4_0": ((10.0, 10.0), (4.0, 0), (4.6, 5.0), (54, 50)),
    "L_4_8": ((10.4, 9.6), (0, 3.6923), (4.8077, 4.8237), (50.1667, 50)),
    "R_0_8": ((10.4, 9.6), (0, 7.6923), (4.8077, 4.4071), (50, 53.8462)),
    "R_-2_8": ((10.4, 9.6), (0, 9.5385), (4.8077, 4.2147), (50, 55.6923)),
    "R_-4_8": ((10.4, 9.6), (0, 11.3846), (4.8077, 4.0224), (50, 57.5385)),
    "R_-4_0": ((10.0, 10.0), (0, 4.0), (5.0, 4.6), (50, 54)),
    "R_-4_-8": ((9.6, 10.4), (3.6923, 0), (4.8237, 4.8077), (50, 50.1667)),
}


near = partial(pytest.approx, abs=1e-4)  # as the table is rounded


def test_there_are_exactly_the_11_conditions():
    assert set(CONDITIONS) == set(TABLE)


@pytest.mark.parametrize("name", TABLE)
def test_speeds_starts_exits_and_the_start_of_control_match_the_table(name):
    condition, (speeds, starts, exits, positions) = CONDITIONS[name], TABLE[name]
    assert condition.speeds_mps == near(speeds)
    assert condition.starts_m(TRACK) == near(starts)
    assert condition.exit_times_s(TRACK) == near(exits)
    assert condition.positions_m(max(condition.exit_times_s(TRACK)), TRACK) == near(positions)


@given(st.integers(-9999, 9999), st.integers(-1999, 1999))
def test_any_headway_and_velocity_have_one_name_that_leads_back_to_them(headway_cm, velocity_cm):
    headway_m, velocity_mps = headway_cm / 100, velocity_cm / 100
    found = CONDITIONS[condition_name(headway_m, velocity_mps)]
    assert (found.projected_headway_m, found.relative_velocity_mps) == (headway_m, velocity_mps)
    assert found.mean_speed_mps == 10.0


def test_a_condition_of_the_humans_keeps_its_name_and_the_others_are_called_by_their_numbers():
    assert condition_name(4.0, -0.8) == "L_4_-8"
    assert condition_name(-0.0, 0.0) == "N_0_0"
    assert condition_name(2.5, -1.2) == "h2.5_dv-1.2"
    assert "h2.5_dv-1.2" not in list(CONDITIONS)


SPELT = ["h2.50_dv0", "h02_dv0", "h2_dv-0", "h4_dv-0.8", "h0_dv20", "h2_dv1e1", "h2", "h2_dv0 "]


@pytest.mark.parametrize("name", [*SPELT, "h\u0662_dv0"])
def test_another_spelling_or_what_cannot_be_driven_is_no_name(name):
    assert name not in CONDITIONS
    assert CONDITIONS.get(name) is None
