"""A driver of which too many decisions are invalid: shown with the reason, and in nothing else."""

from dataclasses import replace

import pytest

from merge_runner.audit.checks import not_judged
from merge_runner.run.stored_replay import audit_database
from merge_runner_analysis.provenance import provenance
from merge_runner_analysis.selection import Selection
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables import make_tables
from merge_runner_analysis.web.alarms import alarms
from merge_runner_analysis.web.pages.prompts import differences
from tests.support.studies import Said, changed, write_study, yielding
from tests.support.tables import QUICK, made, notes_with


def failing(drives, decisions=range(99)):
    """The drives, of whose left decisions these are invalid."""
    prose = dict.fromkeys(decisions, Said(failure="no_array"))
    return [replace(drive, said=prose) for drive in drives]


DRIVES = [*yielding("o3", reps=2), *yielding("o3", "A2", reps=2)]


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """Drivers, and beside them a variant and a driver with too many invalid decisions."""
    bad = [*failing(yielding("o3", "A1", reps=2)), *failing(yielding("bad", reps=2))]
    return write_study(tmp_path_factory.mktemp("mixed") / "t.duckdb", [*DRIVES, *bad])


def test_more_than_a_fifth_is_too_much_and_a_fifth_is_not():
    assert not_judged("m", 20, 100) == not_judged("m", 0, 0) == ""
    assert not_judged("m", 21, 100) == (
        "not judged: 21 of the 100 decisions of m are invalid (21.0 %, more than 20 %)"
    )


def test_tables_show_it_without_a_value_and_the_rest_as_if_it_were_not_there(mixed, tmp_path):
    alone = StudyResults(write_study(tmp_path / "alone.duckdb", DRIVES))
    for table, expected in zip(
        *(make_tables(study, QUICK) for study in (StudyResults(mixed), alone)), strict=True
    ):
        unjudged = [row for row in table.rows if {"o3/A1", "bad/baseline"} & {*row.groups}]
        assert len(unjudged) == 2, table.name
        if table.name == "attempts":  # which counts the calls of all
            assert [row.values["calls"] > 0 for row in unjudged] == [True, True]
            continue
        for row in unjudged:
            names = {name for name, value in row.values.items() if value is not None}
            assert names <= {"driver", "setting", "kind", table.columns[0].name}, table.name
            assert row.note.startswith("not judged: "), table.name
        judged = [row for row in table.rows if row not in unjudged]
        # The last digits of a fit depend on where in memory its numbers lie.
        assert [(row.id, row.note, row.values) for row in judged] == [
            (row.id, row.note, {name: pytest.approx(v) for name, v in row.values.items()})
            for row in expected.rows
        ]
        if table.name == "contrasts":  # nor does the page of prompts
            shown, _ = differences(table, {"o3", "bad"})
            assert {k: [*of] for k, of in shown.items()} == {"o3": ["A2 against baseline"]}


def test_report_and_audit_say_that_it_is_not_judged_and_conclude_nothing(mixed):
    table = made(StudyResults(mixed, Selection(where={"prompt": ["baseline", "A1"]})), "verdicts")
    assert "bad" not in table.notes[0]
    ((title, (texts, _)),) = alarms(StudyResults(mixed), provenance(mixed)).items()
    assert title == "Too few valid decisions"
    notes = [note for audit in audit_database(mixed) for note in audit.notes]
    for group in ("bad/baseline", "o3/A1"):
        assert any(text.startswith(f"{group}: not judged: ") for text in texts)
        assert notes_with(table, f"{group}: Not judged: ")
        assert any(note.startswith(f"{group}: not judged: ") for note in notes)


def test_where_no_driver_is_judged_nothing_is_concluded(tmp_path):
    study = StudyResults(write_study(tmp_path / "t.duckdb", failing(yielding("bad", reps=1))))
    table = made(study, "verdicts")
    assert table.notes[0] == "No language model is judged here."
    (row,) = (row for row in table.rows if row.groups != ("human",))
    assert "state" not in row.values
    contrasts = made(study, "contrasts")
    assert [row.id for row in contrasts.rows] == ["bad/baseline"]
    assert notes_with(contrasts, "there is no pair of judged groups to compare")


@pytest.mark.parametrize(("first", "judged"), [([0], True), (range(3), False)])
def test_of_a_pair_the_decisions_of_each_model_count_by_themselves(tmp_path, first, judged):
    db = write_study(tmp_path / "t.duckdb", failing(yielding("m", reps=1), first))
    study = changed(db, "UPDATE trials SET model_right = 'constant'",
                    "UPDATE decisions SET call_key = NULL WHERE side = 'right'")  # fmt: skip
    (group,) = study.played
    assert study.models == ([group] if judged else [])
    assert ("decisions of m are invalid" in group.unjudged) is not judged
