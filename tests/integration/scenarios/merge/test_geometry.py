"""The track and the vehicles in SQL are those of the simulator, for vehicles of any size."""

import json

import duckdb
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from merge_runner.results.database import schema_sql
from merge_runner.scenarios.merge.collision import rectangles_overlap
from merge_runner.scenarios.merge.conditions import MEAN_SPEED_MPS
from merge_runner.scenarios.merge.geometry import TRACK

HAIR_M = 1e-6


@pytest.fixture(scope="module")
def database():
    with duckdb.connect() as connection:
        connection.execute(schema_sql())
        yield connection


def geometry(database, spec):
    """The row of a spec as a dict."""
    database.execute("DELETE FROM specs")
    database.execute("INSERT INTO specs VALUES ('feed', ?)", [json.dumps(spec)])
    (row,) = database.execute("FROM geometry").fetchall()
    return dict(zip((column[0] for column in database.description), row, strict=True))


def of_size(database, length_m, width_m):
    size = {"vehicle_length_m": length_m, "vehicle_width_m": width_m}
    return geometry(database, {"scenario": size})


def test_the_track_in_sql_is_the_simulators(database):
    sql = "SELECT merge_point_m(), track_end_m(), branch_sine(), mean_speed_mps()"
    track = (TRACK.merge_point_m, TRACK.end_m, TRACK.branch_sine, MEAN_SPEED_MPS)
    assert database.execute(sql).fetchall() == [track]


@pytest.mark.parametrize("spec", [{"source": "human"}, {"scenario": {}}])
def test_a_size_that_a_spec_does_not_say_is_that_of_the_experiment(database, spec):
    found = geometry(database, spec)
    assert (found["length_m"], found["width_m"]) == (4.5, 1.8)


def test_the_bounds_of_the_experiments_vehicles_are_the_known_ones(database):
    found = of_size(database, 4.5, 1.8)
    names = ("front_m", "rear_m", "contact_m", "contact_high_m", "merge_low_m", "merge_high_m")
    bounds = [97.75, 102.25, 90.6065, 95.1065, 95.3471, 104.5949]
    assert [round(found[name], 4) for name in names] == bounds


@given(st.floats(0.5, 30), st.floats(0.2, 6))
@example(4.5, 1.8)
@example(8.0, 2.5)
@example(8.0, 1.0)  # longer than eight widths: what is at the contact point reaches past the merge
@example(30.0, 0.2)
@example(0.5, 6.0)
def test_boxes_overlap_between_the_bounds_and_nowhere_else(database, length_m, width_m):
    found = of_size(database, length_m, width_m)
    contact_m, merge_m, end_m = found["contact_m"], TRACK.merge_point_m, TRACK.end_m
    points = (
        (contact_m + HAIR_M / 1000, contact_m, found["contact_high_m"]),
        (merge_m, found["merge_low_m"], found["merge_high_m"]),
        (end_m, end_m - length_m, end_m + length_m),
    )
    for at_m, low_m, high_m in points:
        inside = [low_m + HAIR_M, high_m - HAIR_M]
        outside = [
            edge + way * (HAIR_M + far_m)
            for edge, way in ((low_m, -1), (high_m, 1))
            for far_m in (0, 0.1, 1, 5, 20)
        ]
        for other_m in inside + outside:
            overlap = rectangles_overlap(TRACK, at_m, other_m, length_m, width_m)
            assert overlap == (other_m in inside)


@given(st.floats(0.5, 30), st.floats(0.2, 6), st.floats(0, 60), st.floats(0, 1))
def test_boxes_on_the_two_branches_cannot_overlap_before_the_contact_point(
    database, length_m, width_m, before_m, share
):
    contact_m = of_size(database, length_m, width_m)["contact_m"]
    own_m = contact_m - HAIR_M - before_m
    other_m = own_m + share * (TRACK.merge_point_m - own_m)
    assert not rectangles_overlap(TRACK, own_m, other_m, length_m, width_m)
