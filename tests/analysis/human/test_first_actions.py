"""First actions: decoded from a page of known pedals, stored once, and compared with."""

from __future__ import annotations

import numpy as np
import pytest

from analysis.data.study import Study
from analysis.human.archive import Unreadable
from analysis.human.first_actions import (
    FITS,
    cruise_speed,
    off_grid,
    pedal,
    read_first_actions,
)
from analysis.stats.first_look import DECODED, PUBLISHED, humans
from analysis.tables import make_tables
from merge_runner.results.store import query
from tests.analysis.pages import first_action_page, first_actions, packed, page
from tests.analysis.studies import write_study, yielding

TRIALS = first_actions(330)


def as_tuples(found):
    return sorted(
        (one.relative_velocity_mps, one.merged_first or "", one.left_mps2, one.right_mps2)
        for one in found
    )


def as_csv(trials) -> bytes:
    rows = ["relative_velocity_mps,merged_first,left_mps2,right_mps2"]
    rows += [f"{velocity},{who or ''},{left!r},{right!r}" for velocity, who, left, right in trials]
    return "\n".join(rows).encode()


def test_the_cruise_control_settles_a_little_below_its_speed():
    found = [cruise_speed(nominal) for nominal in (9.6, 10.0, 10.4)]
    assert found == pytest.approx([9.52372, 9.92063, 10.31742], abs=5e-6)


def test_a_released_and_a_full_pedal_have_the_published_accelerations():
    for nominal, released, full in (
        (9.6, -0.94898, 1.5391),
        (10.0, -0.98719, 1.5004),
        (10.4, -1.02693, 1.4601),
    ):
        found = pedal(np.array([released, full]), cruise_speed(nominal))
        assert found == pytest.approx([0.0, 1.0], abs=1e-4)
        assert (off_grid(found) < FITS).all()


@pytest.mark.parametrize("form", [list, packed])
def test_the_conditions_of_simulated_pedals_are_decoded_exactly(form):
    found, left_out = read_first_actions(first_action_page(TRIALS, form))
    known = sorted((v, who or "", left, right) for v, who, left, right in TRIALS)
    assert left_out + len(found) == len(TRIALS)
    # Two pedals lie on the grid of other speeds by chance; these trials are left out.
    assert left_out <= 0.03 * len(TRIALS)
    assert set(as_tuples(found)) <= set(known)


def test_a_brake_does_not_tell_the_condition_and_is_left_out():
    braking = [(0.0, "left", -1.7, -1.2345)]
    found, left_out = read_first_actions(first_action_page([*TRIALS[:11], *braking]))
    assert left_out >= 1
    assert -1.7 not in [one.left_mps2 for one in found]


def test_a_csv_holds_the_same():
    found, left_out = read_first_actions(as_csv(TRIALS))
    assert left_out == 0
    assert as_tuples(found) == sorted((v, who or "", left, right) for v, who, left, right in TRIALS)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"<html>Plotly.newPlot(", "no page that Plotly wrote"),
        (page([{"name": "left", "x": [1.0], "y": ["a"]}]), "the y of a trace is no list"),
        (page([{"name": "left", "x": [1.0], "y": [1.0, 2.0]}]), "has 1 x and 2 y"),
        (page([{"name": "left", "x": {"dtype": "f8", "bdata": "?"}, "y": []}]), "the x of a trace"),
        (page([{"name": "other", "x": [1.0], "y": [1.0]}]), "shows no first actions"),
        (b"left,right\n1,2\n", "it lacks relative_velocity_mps, merged_first, left_mps2"),
        (as_csv([(0.3, "left", 0.1, 0.2)]), r"relative_velocity_mps is 0.3 in row 1; valid: -0.8"),
        (as_csv([(0.8, "both", 0.1, 0.2)]), "merged_first is 'both' in row 1"),
        (as_csv([(0.8, "left", float("nan"), 0.2)]), "left_mps2 is 'nan' in row 1"),
        (as_csv([(0.8, "left", 0.1, -3.6)]), "an acceleration is -3.6 m/s² in row 1"),
        (as_csv([]), "it holds no first action"),
        (b"\xff\xfe", "neither a page nor a CSV"),
    ],
)
def test_what_cannot_be_read_says_why(content, says):
    with pytest.raises(Unreadable, match=says):
        read_first_actions(content)


@pytest.mark.long
def test_a_page_is_imported_once_and_drivers_are_compared_with_it(human, tmp_path):
    db = write_study(tmp_path / "t.duckdb", yielding("o3", reps=2))
    (tmp_path / "initial_action.html").write_bytes(first_action_page(TRIALS))
    known, left_out = read_first_actions(first_action_page(TRIALS))
    run = human("import-first-actions", "initial_action.html", "--db", db)
    assert run.code == 0
    assert run.out.startswith(f"{len(known)} trials added, 0 there already, {left_out} left out")
    again = human("import-first-actions", "initial_action.html", "--db", db)
    assert again.out.startswith(f"0 trials added, {len(known)} there already, ")
    assert query(db, "SELECT count(*) FROM human_first_actions")[1] == [(2 * len(known),)]
    status = human("status", "--db", db)
    assert status.out.startswith(f"first actions of {len(known)} trials are imported\n")
    (tmp_path / "other.csv").write_bytes(as_csv(TRIALS[:20]))
    other = human("import-first-actions", "other.csv", "--db", db)
    assert other.code == 2
    assert "other first actions, which stay: add --replace" in other.err
    few = human("import-first-actions", "other.csv", "--replace", "--db", db)
    assert (few.code, few.out.startswith("20 trials added")) == (0, True), few.err
    assert humans(Study(db)).source == PUBLISHED
    notes = make_tables(Study(db), ["first-action"])[0].notes
    assert any("first actions of 20 trials do not count: 100 are needed" in note for note in notes)
    assert human("import-first-actions", "initial_action.html", "--replace", "--db", db).code == 0
    study = Study(db)
    assert humans(study).source == DECODED
    (table,) = make_tables(study, ["first-action"])
    rows = {row.id: row.values for row in table.rows}
    slower = [
        action
        for v, _, left, right in (
            (o.relative_velocity_mps, 0, o.left_mps2, o.right_mps2) for o in known
        )
        for own, action in ((v, left), (-v, right))
        if own == -0.8
    ]
    assert rows["human/-0.8"]["n"] == len(slower)
    assert rows["human/-0.8"]["mean"] == pytest.approx(np.mean(slower))
    assert rows["human/all"]["slope"] != pytest.approx(-0.338, abs=1e-6)


def test_a_wrong_file_ends_with_2_and_says_what_to_name(human, tmp_path):
    (tmp_path / "wrong.html").write_bytes(b"<html></html>")
    for name in ("wrong.html", "gone.html"):
        run = human("import-first-actions", name)
        assert run.code == 2
        assert name in run.err
        assert len(run.err.splitlines()) == 1
    assert not (tmp_path / "results").exists()
