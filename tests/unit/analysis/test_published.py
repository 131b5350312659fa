"""The values that ship agree with each other and with the rounding of the paper."""

import numpy as np
import pandas as pd
import pytest

from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.metrics import BOXES, GAP, JOINT, RMSE
from merge_runner_analysis.published import (
    DATA,
    HUMAN_DOI,
    HUMAN_GAP_SD_M,
    HUMAN_TRIALS,
    citation,
    human_outcomes,
    published,
)

SETTINGS = ["baseline", *(f"A{k}" for k in range(1, 8))]


def cells(name) -> pd.DataFrame:
    return published(name).set_index(["driver", "setting"])


def test_every_shipped_file_has_a_citation_and_every_citation_a_file():
    cited = pd.read_csv(DATA / "sources.csv")["file"]
    assert sorted([*cited, "sources.csv"]) == sorted(path.name for path in DATA.glob("*.csv"))
    for name in (name.removesuffix(".csv") for name in cited):
        said = "arXiv 2604.09609, Table" if name.startswith("paper_") else ""
        said = {"human_outcomes": HUMAN_DOI, "human_mixed_models": "S4 and S6"}.get(name, said)
        assert said in citation(name)
        assert len(citation(name)) > 40


def test_the_human_counts_add_up_to_the_published_sums():
    counts = published("human_outcomes")
    assert list(counts["condition"]) == list(CONDITIONS)
    outcomes = counts[["left_first", "right_first", "collided"]]
    assert list(outcomes.sum()) == [465, 497, 28]
    assert (outcomes.sum(axis=1) == 90).all()
    times = counts.filter(like="crt_")  # of conflict resolution, in order
    assert list(times) == ["crt_min_s", "crt_q1_s", "crt_median_s", "crt_q3_s", "crt_max_s"]
    assert (times.diff(axis=1).iloc[:, 1:] >= 0).all(axis=None)


def test_human_outcomes_are_one_row_a_trial_under_their_condition():
    trials = human_outcomes()
    assert len(trials) == HUMAN_TRIALS
    for name, rows in trials.groupby("condition"):
        assert set(rows["projected_headway_m"]) == {CONDITIONS[name].projected_headway_m}
        assert set(rows["relative_velocity_mps"]) == {CONDITIONS[name].relative_velocity_mps}
    tie = trials[trials["condition"] == "L_4_8"]
    assert dict(tie["merged_first"].value_counts()) == {"left": 68, "right": 20}
    assert (trials["merged_first"].isna() == (trials["status"] == "collided")).all()
    assert set(trials["status"]) == {"finished", "collided"}


def test_the_human_row_of_table_vii_is_that_of_the_990_trials():
    row = published("paper_ablation_quantitative").query("driver == 'human'").iloc[0]
    found = [float(row[metric.paper_of_humans]) for metric in (BOXES, GAP, RMSE, JOINT)]
    assert found == [round(100 * 28 / 990, 2), 3.85, 0.66, round(100 * 510 / 962, 1)]


def test_the_ablation_tables_hold_the_humans_and_all_settings_of_both_models():
    models = [(driver, s) for driver in ("o3", "gemini-2.5-pro") for s in SETTINGS]
    for name in ("paper_ablation_qualitative", "paper_ablation_quantitative"):
        assert list(cells(name).index) == [("human", ""), *models]
    table = published("paper_ablation_qualitative")
    marks = table[["i1", "i2", "i3", "i4", "i5"]]
    assert marks.isin([0, 1]).all(axis=None)
    assert (marks.sum(axis=1) == table["score"]).all()


def test_the_four_human_standard_errors_of_the_gap_imply_its_deviation():
    """SE = SD * sqrt((X'X)^-1), with the human trials that finished in each condition."""
    trials = human_outcomes().query("status == 'finished'")
    h, dv = trials["projected_headway_m"], trials["relative_velocity_mps"]
    design = np.column_stack([np.ones(len(h)), abs(h), abs(dv), h * dv])
    inverse = np.linalg.inv(design.T @ design)
    printed = published("paper_gap").query("driver == 'human'")["se"].to_numpy()
    assert printed / inverse.diagonal() ** 0.5 == pytest.approx([HUMAN_GAP_SD_M] * 4, rel=0.02)
