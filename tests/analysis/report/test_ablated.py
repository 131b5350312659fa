"""What is said of the prompt variants: true for whatever a database holds."""

from __future__ import annotations

from dataclasses import replace

import duckdb
import numpy as np
import pytest

from analysis.data.study import Study
from analysis.metrics import COLLISIONS, GAP
from analysis.report.ablated import ablation_sentences, smallest_p
from analysis.stats.contrasts import Cells, contrast_cells, contrast_means
from merge_runner.results.store import Store
from merge_runner.scenarios.merge.conditions import CONDITIONS
from tests.analysis.studies import Drive, write_study, yielding

LEVEL = [d for d in yielding("o3", reps=2) if d.condition == "N_0_0"]
CRASHES = [Drive("o3", "A1", name, 1, (0.0,), (0.0,)) for name in CONDITIONS]


def said(path, drives):
    return ablation_sentences(Study(write_study(path / "t.duckdb", drives)))


def as_variant(drives, variant="A1"):
    return [replace(drive, variant=variant) for drive in drives]


def test_what_a_variant_changes_is_said_with_interval_and_what_not_with_what_could_be_shown(
    study, tables
):
    texts = ablation_sentences(study)
    (a1,) = [text for text in texts if "A1 (55 trials) differs from the baseline (110)" in text]
    row = next(r for r in tables["contrasts"].rows if r.id == "o3/A1/baseline/gap_m")
    low, high = row.values["ci"]
    change = row.values["difference"]
    assert row.values["p_holm"] < 0.05
    assert f"the gap by {change:+.2f} m (95 % CI {low:+.2f} to {high:+.2f})" in a1
    assert "collisions" not in a1
    (rest,) = [text for text in texts if "no difference from the baseline is shown" in text]
    assert "collisions by the scenario's rule, collisions of boxes and joint contributions" in rest
    rows = [r for r in tables["contrasts"].rows if r.id.endswith("/baseline/joint_percent")]
    shares = [r.values["detectable"] for r in rows if r.groups[0].startswith("o3/A")]
    assert f"{shares[0]:.2f} points in joint contributions" in rest
    assert "RMSE" not in rest
    assert not any("other" in text for text in texts), "it has no variant"


@pytest.mark.parametrize(
    ("drives", "words"),
    [
        (
            [*yielding("o3", "A1", 1), *yielding("other", reps=1)],
            "it has no baseline to compare with: what A1 changes cannot be said",
        ),
        (
            [*LEVEL, *as_variant(LEVEL)],
            (
                "nothing could have been shown in collisions by the scenario's rule, collisions of "
                "boxes, the gap"
            ),
        ),
        ([*yielding("o3", reps=3), *CRASHES], "differs from the baseline (33), also after Holm's"),
        ([*yielding("o3", reps=3), *CRASHES], "not compared with the baseline: "),
    ],
)
def test_what_cannot_be_said_is_named(drives, words, tmp_path):
    assert any(words in text for text in said(tmp_path, drives))


def test_two_trials_are_too_few_for_any_word_of_a_difference(tmp_path):
    texts = said(tmp_path, [*LEVEL[:1], *as_variant(LEVEL[:1])])
    assert not any("differs" in text or "no difference" in text for text in texts)


@pytest.mark.parametrize("drives", [[], yielding("o3", reps=1)])
def test_without_variants_nothing_is_said(drives, tmp_path):
    if drives:
        assert said(tmp_path, drives) == []
    else:
        Store(tmp_path / "t.duckdb")
        assert ablation_sentences(Study(tmp_path / "t.duckdb")) == []


@pytest.mark.slow
@pytest.mark.usefixtures("few_draws")
@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ("UPDATE trials SET scripted = true", []),
        (
            "UPDATE trials SET source = 'driver'",
            ["o3 is a program and reads no prompt: A1 can change nothing."],
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
    assert "not compared" in text
    assert "collisions" in text


def test_the_smallest_p_is_that_of_the_most_extreme_outcome(tmp_path):
    """Of two trials each, either way of one condition: 2 of 6 shuffles, and 1 of 3 tables."""
    strong = [replace(d, variant="A1", left=(0.8,) * 3, right=(-0.8,) * 3) for d in LEVEL]
    study = Study(write_study(tmp_path / "t.duckdb", [*LEVEL, *strong]))
    baseline, variant = study.models
    found = contrast_means(variant.finished, baseline.finished, "gap_m")
    assert (
        smallest_p(variant, baseline, GAP)
        == pytest.approx(1 / 3)
        == pytest.approx(found.p, abs=0.02)
    )
    assert smallest_p(variant, baseline, COLLISIONS) == pytest.approx(
        contrast_cells(Cells(*np.array([[2, 2, 0, 2]]).T)).p
    )
