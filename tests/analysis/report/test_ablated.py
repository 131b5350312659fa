"""What is said of the prompt variants: true for whatever a database holds."""

from __future__ import annotations

from dataclasses import replace

import duckdb
import pytest

from merge_runner.results.store import Store
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.report.ablated import ablation_sentences
from tests.analysis.studies import Drive, write_study, yielding

LEVEL = [d for d in yielding("o3", reps=2) if d.condition == "N_0_0"]
CRASHES = [Drive("o3", "A1", name, 1, (0.0,), (0.0,)) for name in CONDITIONS]


def said(path, drives):
    return ablation_sentences(Study(write_study(path / "t.duckdb", drives)))


def as_variant(drives, variant="A1"):
    return [replace(drive, variant=variant) for drive in drives]


def test_what_a_variant_changes_is_said_with_its_interval(study, tables):
    texts = ablation_sentences(study)
    (a1,) = [text for text in texts if text.startswith("o3, A1: ")]
    assert "2 of 5 measures differ from baseline (55 trials against 110)" in a1
    row = next(r for r in tables["contrasts"].rows if r.id == "o3/A1/baseline/gap_m")
    low, high = row.values["ci"]
    change = row.values["difference"]
    assert row.values["p_holm"] < 0.05
    assert f"the gap by {change:+.2f} m (95 % CI {low:+.2f} to {high:+.2f})" in a1
    assert "collisions" not in a1
    assert "That does not show that the others are equal" in a1
    assert not any("other," in text for text in texts), "it has no variant"


@pytest.mark.parametrize(
    ("drives", "words"),
    [
        (
            [*yielding("o3", "A1", 1), *yielding("other", reps=1)],
            "there is no prompt baseline to compare with: no change can be stated",
        ),
        ([*LEVEL, *as_variant(LEVEL)], "0 of 5 measures differ from baseline (2 trials against 2)"),
        (
            [*yielding("o3", reps=3), *CRASHES],
            "measures differ from baseline (11 trials against 33): ",
        ),
        ([*yielding("o3", reps=3), *CRASHES], "Not compared: "),
    ],
)
def test_what_cannot_be_said_is_named(drives, words, tmp_path):
    assert any(words in text for text in said(tmp_path, drives))


@pytest.mark.parametrize("drives", [[], yielding("o3", reps=1)])
def test_without_variants_nothing_is_said(drives, tmp_path):
    if drives:
        assert said(tmp_path, drives) == []
    else:
        Store(tmp_path / "t.duckdb")
        assert ablation_sentences(Study(tmp_path / "t.duckdb")) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ("UPDATE trials SET scripted = true", []),
        (
            "UPDATE trials SET source = 'driver'",
            ["o3, A1: a program reads no prompt, and the variant can change nothing."],
        ),
    ],
)
def test_stand_ins_and_programs_have_no_ablation(change, expected, tmp_path):
    db = write_study(tmp_path / "t.duckdb", [*yielding("o3"), *yielding("o3", "A1")])
    with duckdb.connect(str(db)) as connection:
        connection.execute(change)
    assert ablation_sentences(Study(db)) == expected


def test_failed_trials_alone_are_not_compared(tmp_path):
    db = write_study(tmp_path / "t.duckdb", [*yielding("o3", reps=1), *yielding("o3", "A1", 1)])
    with duckdb.connect(str(db)) as connection:
        connection.execute("UPDATE trials SET status = 'failed', merged_first = NULL")
    (text,) = ablation_sentences(Study(db))
    assert "Not compared" in text
    assert "collisions" in text
