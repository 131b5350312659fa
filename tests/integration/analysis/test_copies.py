"""Programs read no prompt: their trials with each are copies, which count once in every table."""

import json
from dataclasses import replace

import pytest

from merge_runner_analysis.explain import explain, sources_of
from merge_runner_analysis.selection import Selection
from merge_runner_analysis.study import StudyResults
from tests.support.harness import environment
from tests.support.program import invoke
from tests.support.studies import changed, scaled, write_study, yielding
from tests.support.tables import by_id, made, notes_with, values_of

SAME = "not tested: the same trials at both levels"
PROGRAM = json.dumps({side: {"program": "own", "chance": True} for side in ("left", "right")})


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    """Two programs and a language model, each with two prompts; the model alone heeds them."""
    drives = [
        *yielding("one", reps=4), *yielding("one", "A1", 4),
        *scaled(yielding("two", reps=4), 0.9), *scaled(yielding("two", "A1", 4), 0.9),
        *yielding("o3", reps=4), *scaled(yielding("o3", "A1", 4), 0.8),
    ]  # fmt: skip
    path = write_study(tmp_path_factory.mktemp("copies") / "t.duckdb", drives)
    changed(
        path,
        f"UPDATE specs SET spec = '{PROGRAM}' WHERE spec_hash NOT LIKE 'o3%'",
        "UPDATE trials SET source = 'driver' WHERE trial_id NOT LIKE 'o3/%'",
    )
    return path


@pytest.fixture(scope="module")
def factors(db):
    return made(StudyResults(db), "factors")


def rows(name, db, *args, **options):
    return by_id(made(StudyResults(db, Selection(*args, **options)), name))


def test_a_level_counts_each_trial_of_a_program_once(db, factors):
    for model, n in (("one", 44), ("two", 44), ("o3", 88)):
        row = by_id(factors)[f"model={model}/left_first_percent"].values
        assert (row["trials"], row["n"]) == (n, n)
        # Each prompt is a cell of its own only to the model, but where all are compared.
        sources = explain(StudyResults(db), factors, f"model={model}/left_first_percent:n").sources
        assert sum(len(source.trials) for source in sources) == n
    (note,) = notes_with(factors, "went exactly as others of the level")
    assert "model=one: 44 of 88, model=two: 44 of 88" in note
    assert "model: every level has the same 11 cells" in factors.notes


def test_a_row_with_copies_and_no_other_trial_has_none(db, factors):
    row = by_id(factors)["model=one/left_first_percent"]
    study, copies = StudyResults(db), (("one/A1", "one-A1"),)
    sources = sources_of(study, factors, replace(row, conditions=("none",), copies=copies))
    assert {source.trials for source in sources} == {()}


def test_two_programs_are_compared_by_distinct_trials(db):
    both, once = (
        rows("factors", db, ["one", "two"], where=where)
        for where in (None, {"prompt": ["baseline"]})
    )
    for measure in ("left_first_percent", "gap_m"):
        shown, alone = (of[f"model=two/{measure}"].values for of in (both, once))
        for column in ("n", "value", "ci", "difference", "difference_ci", "p"):
            assert shown[column] == pytest.approx(alone[column]), (measure, column)
    # No test is made of copies, and the rows say so.
    for measure in ("left_first_percent", "gap_m", "conflict_resolution_s"):
        row = both[f"prompt=A1/{measure}"]
        assert {row.values.get(name) for name in ("difference", "difference_ci", "p")} == {None}
        assert SAME in row.note


def test_what_a_prompt_changes_rests_on_who_reads_it(db, factors):
    contrasts = made(StudyResults(db), "contrasts")
    assert {name.partition("/")[0] for name in by_id(contrasts)} == {"o3"}
    assert notes_with(contrasts, SAME)[0].startswith("one/A1, two/A1, beside baseline: ")
    every, alone = by_id(factors)["prompt=A1/gap_m"], rows("factors", db, ["o3"])["prompt=A1/gap_m"]
    for column in ("difference", "difference_ci", "p"):
        assert every.values[column] == pytest.approx(alone.values[column])
    assert every.note == (
        "the difference leaves out 22 of 33 shared cells, those with the same trials at both levels"
    )


def test_no_interaction_is_made_of_copies(db):
    found = rows("factors", db, ["one", "two"], by="prompt")
    row = found["prompt=A1/model=two/interaction/gap_m"]
    assert row.values.get("p") is None
    assert SAME in row.note


def test_a_program_that_heeds_a_level_in_some_conditions_is_compared_in_all(tmp_path):
    """Conditions in which it does not heed it belong to the difference, too."""
    drives = yielding("one", reps=4)
    heeded = {*sorted({drive.condition for drive in drives})[:5]}
    other = yielding("one", "A1", 4)
    drives += [scaled([d], 0.8)[0] if d.condition in heeded else d for d in other]
    study = changed(
        write_study(tmp_path / "t.duckdb", drives),
        f"UPDATE specs SET spec = '{PROGRAM}'",
        "UPDATE trials SET source = 'driver'",
    )
    contrast = by_id(made(study, "contrasts"))["one/A1/baseline/gap_m"]
    level = by_id(made(study, "factors"))["prompt=A1/gap_m"]
    first, second = (
        group.finished.groupby("condition")["gap_m"].agg(["mean", "size"]) for group in study.models
    )
    assert len(first) == len(second) == 11
    weights = first["size"] * second["size"] / (first["size"] + second["size"])
    within = abs(((first["mean"] - second["mean"]) * weights).sum() / weights.sum())
    assert within > 0.1
    for shown in (contrast, level):
        assert abs(shown.values["difference"]) == pytest.approx(within)
        assert not shown.note
    assert (contrast.values["n"], contrast.values["n_reference"]) == (44, 44)


UNREAD = """
models = ["emulator"]
repetitions = 3
conditions = ["N_0_0", "L_4_0"]
mirror = true
[factors]
persona = ["none", "taxi"]
[texts.persona.taxi]
add = [{ after = "C3.human", text = "You are a taxi driver." }]
given_to = "ego"
"""


def test_verdicts_count_a_trial_once_whichever_side_has_words_that_nobody_reads(tmp_path):
    (tmp_path / "study.toml").write_text(UNREAD)
    asked = ("sweep", "study.toml", "--db", "t.duckdb", "--quiet")
    assert invoke(asked, cwd=tmp_path, env=environment()).code == 0
    study = StudyResults(tmp_path / "t.duckdb")
    table = made(study, "verdicts")
    verdicts, stored = by_id(table), {group.id: len(group.trials) for group in study.models}
    assert (stored["emulator/baseline"], stored["emulator/persona=taxi"]) == (6, 12)
    for measure in ("headway", "collisions", "gap"):
        own, base = (
            verdicts[f"emulator/{name}/{measure}"] for name in ("persona=taxi", "baseline")
        )
        for column in ("n", "k", "estimate", "counted", "p"):
            assert own.values.get(column) == base.values.get(column), (measure, column)
        (source,) = explain(study, table, f"{own.id}:n").sources
        assert len(source.trials) == own.values["n"]
        if own.values.get("counted"):
            (source,) = explain(study, table, f"{own.id}:counted").sources
            assert f"{len(source.numerator)} of {len(source.trials)}" == own.values["counted"]
    (note,) = notes_with(table, "equal trials count once")
    assert note.startswith("emulator/persona=taxi: 6 of 12 trials equal another one")
    # The first page counts them so, too.
    levels = values_of(study, "levels")
    assert levels["persona=none"]["ended"] == 6
