"""The 11 conditions have the start of control that the human experiment gave its participants."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from merge_runner.scenarios.merge.conditions import CONDITIONS, condition_name
from merge_runner.scenarios.merge.geometry import TRACK
from tests.support.cases import table


def test_there_are_the_11_conditions_with_the_speeds_starts_exits_and_positions_of_the_table():
    known = table("track", "conditions")
    assert set(CONDITIONS) == set(known)
    for name, values in known.items():
        condition = CONDITIONS[name]
        exits = condition.exit_times_s(TRACK)
        found = (condition.speeds_mps, condition.starts_m(TRACK), exits,
                 condition.positions_m(max(exits), TRACK))  # fmt: skip
        for measured, wanted in zip(found, values, strict=True):
            assert measured == pytest.approx(tuple(wanted), abs=1e-4)  # as the table is rounded


@given(st.integers(-9999, 9999), st.integers(-1999, 1999))
def test_any_headway_and_velocity_have_one_name_that_leads_back_to_them(headway_cm, velocity_cm):
    headway_m, velocity_mps = headway_cm / 100, velocity_cm / 100
    found = CONDITIONS[condition_name(headway_m, velocity_mps)]
    assert (found.projected_headway_m, found.relative_velocity_mps) == (headway_m, velocity_mps)
    assert found.mean_speed_mps == 10.0
    told = [condition_name(*pair) for pair in ((4.0, -0.8), (-0.0, 0.0), (2.5, -1.2))]
    assert told == ["L_4_-8", "N_0_0", "h2.5_dv-1.2"]
    assert told[2] not in list(CONDITIONS)


@pytest.mark.parametrize("name", table("plans", "no-conditions", "names"))
def test_another_spelling_or_what_cannot_be_driven_is_no_name(name):
    assert name not in CONDITIONS
    assert CONDITIONS.get(name) is None
