"""A driver of which too many decisions are invalid: shown with the reason, and in nothing else."""

from __future__ import annotations

from dataclasses import replace

import pytest

from merge_runner.audit.checks import not_judged
from merge_runner.run.stored_replay import audit_database
from merge_runner_analysis.data.provenance import provenance
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.explorer.pages.prompts import differences
from merge_runner_analysis.report.page import alarms
from merge_runner_analysis.tables import make_tables
from tests.support.studies import Said, changed, write_study, yielding

PROSE = Said(failure="no_array")


def failing(drives, decisions=range(99)):
    """The drives, of whose left decisions these are invalid."""
    return [replace(drive, said=dict.fromkeys(decisions, PROSE)) for drive in drives]


@pytest.fixture(scope="module")
def drives():
    return [*yielding("o3"), *yielding("o3", "A2"), *yielding("other")]


@pytest.fixture(scope="module")
def mixed(drives, tmp_path_factory):
    """Drivers, and beside them a variant and a driver with too many invalid decisions."""
    bad = [*failing(yielding("o3", "A1", reps=2)), *failing(yielding("bad"))]
    return write_study(tmp_path_factory.mktemp("mixed") / "t.duckdb", [*drives, *bad])


def test_more_than_a_fifth_is_too_much_and_a_fifth_is_not():
    assert not_judged("m", 20, 100) == not_judged("m", 0, 0) == ""
    assert not_judged("m", 21, 100) == (
        "not judged: 21 of the 100 decisions of m are invalid (21.0 %, more than 20 %)"
    )


@pytest.mark.slow
def test_the_page_of_prompts_compares_it_with_nothing(mixed):
    (contrasts,) = make_tables(Study(mixed), ["contrasts"])
    found, _ = differences(contrasts, {"o3", "bad"})
    shown = {driver: list(prompts) for driver, prompts in found.items()}
    assert shown == {"o3": ["A2 against baseline"]}


@pytest.mark.slow
def test_tables_show_it_without_a_value_and_the_rest_as_if_it_were_not_there(
    mixed, drives, tmp_path
):
    alone = Study(write_study(tmp_path / "alone.duckdb", drives))
    for table, expected in zip(make_tables(Study(mixed)), make_tables(alone), strict=True):
        unjudged = [row for row in table.rows if {"o3/A1", "bad/baseline"} & {*row.groups}]
        if table.name == "attempts":  # which counts the calls of all
            assert [row.values["calls"] > 0 for row in unjudged] == [True, True]
            continue
        for row in unjudged:
            names = {name for name, value in row.values.items() if value is not None}
            assert names <= {"driver", "setting", "kind", table.columns[0].name}, table.name
            assert row.note.startswith("not judged: "), table.name
        assert len(unjudged) == 2, table.name
        judged = [row for row in table.rows if row not in unjudged]
        assert [(row.id, row.note) for row in judged] == [
            (row.id, row.note) for row in expected.rows
        ]
        # The last digits of a fit depend on where in memory its numbers lie.
        for row, other in zip(judged, expected.rows, strict=True):
            assert row.values == {name: pytest.approx(v) for name, v in other.values.items()}


def test_report_and_audit_say_that_it_is_not_judged_and_conclude_nothing(mixed):
    study, origin = Study(mixed), provenance(mixed)
    (table,) = make_tables(study, ["verdicts"])
    assert "bad" not in table.notes[0]
    ((title, text),) = alarms(study, origin).items()
    assert title == "Too few valid decisions"
    for group in ("bad/baseline", "o3/A1"):
        assert f"{group}: not judged: " in text
        assert any(text.startswith(f"{group}: Not judged: ") for text in table.notes)
        notes = [note for audit in audit_database(mixed) for note in audit.notes]
        assert any(note.startswith(f"{group}: not judged: ") for note in notes)


def test_where_no_driver_is_judged_nothing_is_concluded(tmp_path):
    study = Study(write_study(tmp_path / "t.duckdb", failing(yielding("bad", reps=1))))
    (table,) = make_tables(study, ["verdicts"])
    assert table.notes[0] == "No language model is judged here."
    (row,) = (row for row in table.rows if row.groups != ("human",))
    assert "state" not in row.values


@pytest.mark.parametrize(("first", "judged"), [([0], True), (range(3), False)])
def test_of_a_pair_the_decisions_of_each_model_count_by_themselves(tmp_path, first, judged):
    db = write_study(tmp_path / "t.duckdb", failing(yielding("m", reps=1), first))
    study = changed(db, "UPDATE trials SET model_right = 'constant'",
                    "UPDATE decisions SET call_key = NULL WHERE side = 'right'")  # fmt: skip
    (group,) = study.played
    assert study.models == ([group] if judged else [])
    assert ("decisions of m are invalid" in group.unjudged) is not judged


def test_a_comparison_without_a_judged_driver_says_what_it_takes(tmp_path):
    """Not that there is no driver: one was played."""
    study = Study(write_study(tmp_path / "t.duckdb", failing(yielding("bad"))))
    for name, said in (("contrasts", "there is no pair of judged groups to compare"),):
        (table,) = make_tables(study, [name])
        assert [row.id for row in table.rows] == ["bad/baseline"]
        assert any(note.startswith(said) for note in table.notes), name
