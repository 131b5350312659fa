"""Track, vehicles and measures in SQL: those of the simulator, of any size and of one version."""

import importlib
import json
from pathlib import Path

import duckdb
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from merge_runner.results.database import schema_sql
from merge_runner.results.store import Store, query
from merge_runner.scenarios.merge import measures
from merge_runner.scenarios.merge.collision import rectangles_overlap
from merge_runner.scenarios.merge.conditions import MEAN_SPEED_MPS
from merge_runner.scenarios.merge.geometry import TRACK


def test_a_remark_is_no_other_version_of_the_measures_and_a_definition_is(monkeypatch):
    read = Path.read_text

    def version(added):
        monkeypatch.setattr(Path, "read_text", lambda self, **how: read(self, **how) + added)
        return importlib.reload(measures).measures_version()

    comment = "COMMENT ON VIEW trial_metrics IS 'what it means';\n"
    (same,) = {*map(version, ("", "-- A remark.\n", "    -- Another one.\n", comment))}
    assert version("SELECT 1;\n") != same
    assert version("") == same


async def test_older_measures_are_told_to_a_reader_and_replaced_when_the_database_is_written_to(
    merge_runner, tmp_path
):
    path = tmp_path / "t.duckdb"
    Store(path)
    with duckdb.connect(str(path)) as connection:
        connection.execute("CREATE OR REPLACE VIEW trial_metrics AS SELECT 1 AS old")
        connection.execute("CREATE OR REPLACE MACRO measures_version() AS 'another'")
    asked = ("sql", "FROM trial_metrics", "--db", path)
    told = await merge_runner(*asked)
    assert (told.code, told.out.split()[0]) == (0, "old")
    assert told.err.count("another version of the program defined the measures") == 1
    assert "`merge-runner sweep` into it brings them up to date" in told.err
    Store(path)
    assert "gap_m" in query(path, "FROM trial_metrics")[0]
    assert (await merge_runner(*asked)).err == ""


HAIR_M = 1e-6


@pytest.fixture(scope="module")
def database():
    with duckdb.connect() as connection:
        connection.execute(schema_sql())
        yield connection


def of_size(database, length_m=None, width_m=None):
    """The row of a spec as a dict."""
    size = {"vehicle_length_m": length_m, "vehicle_width_m": width_m} if length_m else {}
    database.execute("DELETE FROM specs")
    database.execute("INSERT INTO specs VALUES ('feed', ?)", [json.dumps({"scenario": size})])
    (row,) = database.execute("FROM geometry").fetchall()
    return dict(zip((column[0] for column in database.description), row, strict=True))


def test_the_track_in_sql_is_the_simulators(database):
    sql = "SELECT merge_point_m(), track_end_m(), branch_sine(), mean_speed_mps()"
    track = (TRACK.merge_point_m, TRACK.end_m, TRACK.branch_sine, MEAN_SPEED_MPS)
    assert database.execute(sql).fetchall() == [track]


def test_without_a_size_the_bounds_are_those_of_the_experiments_vehicles(database):
    found = of_size(database)
    assert (found["length_m"], found["width_m"]) == (4.5, 1.8)
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
