"""Programs read no prompt: their trials with each are copies, which count once in every table."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from merge_runner_analysis.data.provenance import provenance
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.explain import explain
from merge_runner_analysis.report.page import alarms
from merge_runner_analysis.tables import make_tables
from tests.support.studies import Drive, changed, write_study, yielding

SAME = "programs play no trial at one of both levels"
PROGRAM = json.dumps({side: {"program": "own", "chance": True} for side in ("left", "right")})


def braking(drives, share):
    """The same drives with another strength."""
    return [
        replace(
            drive,
            left=tuple(share * action for action in drive.left),
            right=tuple(share * action for action in drive.right),
        )
        for drive in drives
    ]


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    """Two programs and a language model, each with two prompts; the model alone heeds them."""
    drives = [
        *yielding("one", reps=4), *yielding("one", "A1", 4),
        *braking(yielding("two", reps=4), 0.9), *braking(yielding("two", "A1", 4), 0.9),
        *yielding("o3", reps=4), *braking(yielding("o3", "A1", 4), 0.8),
    ]  # fmt: skip
    path = write_study(tmp_path_factory.mktemp("copies") / "t.duckdb", drives)
    changed(
        path,
        f"UPDATE specs SET spec = '{PROGRAM}' WHERE spec_hash NOT LIKE 'o3%'",
        "UPDATE trials SET source = 'driver' WHERE trial_id NOT LIKE 'o3/%'",
    )
    return path


def made(name, *args, **options):
    (table,) = make_tables(Study(*args, **options), [name])
    return table, {row.id: row for row in table.rows}


def test_a_level_counts_each_trial_of_a_program_once(db):
    table, rows = made("factors", db)
    for model, n in (("one", 44), ("two", 44), ("o3", 88)):
        row = rows[f"model={model}/left_first_percent"]
        assert (row.values["trials"], row.values["n"]) == (n, n)
        # Each prompt is a cell of its own only to the model, but where all are compared.
        cell = f"model={model}/left_first_percent:n"
        assert sum(len(source.trials) for source in explain(Study(db), table, cell).sources) == n
    (note,) = [note for note in table.notes if "trials of programs are equal to others" in note]
    assert "model=one: 44 of 88, model=two: 44 of 88" in note
    (note,) = [note for note in table.notes if note.startswith("model: ")]
    assert note == "model: every level has the same 11 cells"


def test_two_programs_are_compared_by_distinct_trials(db):
    both, once = (
        made("factors", db, ["one", "two"], where=where)[1]
        for where in (None, {"prompt": ["baseline"]})
    )
    for measure in ("left_first_percent", "gap_m"):
        shown, alone = (rows[f"model=two/{measure}"].values for rows in (both, once))
        for column in ("n", "value", "ci", "difference", "difference_ci", "p"):
            assert shown[column] == pytest.approx(alone[column]), (measure, column)


def test_no_test_is_made_of_copies_and_the_rows_say_so(db):
    _, rows = made("factors", db, ["one", "two"])
    for measure in ("left_first_percent", "gap_m", "conflict_resolution_s"):
        row = rows[f"prompt=A1/{measure}"]
        assert {row.values.get(name) for name in ("difference", "difference_ci", "p")} == {None}
        assert SAME in row.note
    table, rows = made("contrasts", db)
    assert {row.partition("/")[0] for row in rows} == {"o3"}
    (note,) = [note for note in table.notes if SAME in note]
    assert note.startswith("one/A1, two/A1, beside baseline: ")


def test_a_program_that_heeds_a_level_in_some_conditions_is_compared_in_all(tmp_path):
    """Conditions in which it does not heed it belong to the difference, too."""
    drives = yielding("one", reps=4)
    heeded = {*sorted({drive.condition for drive in drives})[:5]}
    other = [
        braking([drive], 0.8)[0] if drive.condition in heeded else drive
        for drive in yielding("one", "A1", 4)
    ]
    study = changed(
        write_study(tmp_path / "t.duckdb", [*drives, *other]),
        f"UPDATE specs SET spec = '{PROGRAM}'",
        "UPDATE trials SET source = 'driver'",
    )
    contrasts, factors = make_tables(study, ["contrasts", "factors"])
    row = next(row for row in contrasts.rows if row.id.endswith("/gap_m"))
    (level,) = [row for row in factors.rows if row.id == "prompt=A1/gap_m"]
    first, second = (
        group.finished.groupby("condition")["gap_m"].agg(["mean", "size"]) for group in study.models
    )
    assert len(first) == len(second) == 11
    weights = first["size"] * second["size"] / (first["size"] + second["size"])
    within = abs(((first["mean"] - second["mean"]) * weights).sum() / weights.sum())
    assert within > 0.1
    for shown in (row.values["difference"], level.values["difference"]):
        assert abs(shown) == pytest.approx(within)
    assert (row.values["n"], row.values["n_reference"]) == (44, 44)
    assert not row.note
    assert not level.note


def test_a_row_says_in_how_many_cells_of_programs_nothing_is_compared(db):
    _, rows = made("factors", db)
    assert rows["prompt=A1/gap_m"].note == (
        "the difference leaves out 22 of 33 shared cells, those of programs that play the same "
        "trials at both levels"
    )


def test_what_a_prompt_changes_rests_on_who_reads_it(db):
    _, every = made("factors", db)
    _, model = made("factors", db, ["o3"])
    row, alone = (rows["prompt=A1/gap_m"].values for rows in (every, model))
    for column in ("difference", "difference_ci", "p"):
        assert row[column] == pytest.approx(alone[column])


def test_no_interaction_is_made_of_copies(db):
    _, rows = made("factors", db, ["one", "two"], by="prompt")
    row = rows["prompt=A1/model=two/interaction/gap_m"]
    assert row.values.get("p") is None
    assert "the same ones at two levels" in row.note


def test_the_report_says_which_trials_of_programs_are_copies(db):
    found = alarms(Study(db), provenance(db))["Trials repeat earlier ones"]
    assert "one: 44 of 88 trials of programs at different levels of factors are distinct" in found
    assert "o3" not in found


def drawn(driver, rng):
    """Trials of a program: who goes first, and how hard either drives, are drawn for each."""
    for condition in ("L_4_-8", "N_0_0", "R_-4_8"):
        for rep in range(1, 7):
            hard, sign = rng.uniform(0.1, 0.6, 2), rng.choice([-1, 1])
            yield Drive(
                driver, "baseline", condition, rep, (sign * hard[0],) * 3, (-sign * hard[1],) * 3
            )


def with_prompts(names):
    """Statements after which programs played the same trials with other prompts, too."""
    for name in names:
        for table in ("trials", "states"):
            variant = f", '{name}' AS variant" if table == "trials" else ""
            yield (
                f"INSERT INTO {table} SELECT * REPLACE (replace(trial_id, 'baseline', '{name}') AS "
                f"trial_id, replace(spec_hash, 'baseline', '{name}') AS spec_hash{variant}) "
                f"FROM {table} WHERE trial_id LIKE '%/baseline/%'"
            )
        yield f"INSERT INTO specs VALUES ('one-{name}', '{PROGRAM}'), ('two-{name}', '{PROGRAM}')"


@pytest.mark.long
def test_programs_of_one_distribution_differ_in_no_more_studies_than_stated(tmp_path):
    """Each is played with eight prompts that it does not read, from draws of its own.

    A study's tests are correlated, so that 8 % is allowed for a true rate of 5 %.
    """
    rejected, tested = 0, 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        path = tmp_path / f"{seed}.duckdb"
        write_study(path, [*drawn("one", rng), *drawn("two", rng)])
        study = changed(
            path,
            f"UPDATE specs SET spec = '{PROGRAM}'",
            "UPDATE trials SET source = 'driver'",
            *with_prompts([f"A{number}" for number in range(1, 8)]),
        )
        (table,) = make_tables(study, ["factors"])
        rows = [row.values for row in table.rows if row.id.startswith("model=two/")]
        assert {row["trials"] for row in rows} == {36 // 2}
        p = [row["p"] for row in rows if row.get("p") is not None]
        rejected, tested = rejected + sum(value < 0.05 for value in p), tested + len(p)
    assert tested >= 150
    assert rejected <= 0.08 * tested
