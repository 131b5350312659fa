"""The values that ship agree with each other and with the rounding of the paper."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.data.reference_data import (
    DATA,
    HUMAN_DOI,
    HUMAN_GAP_SD_M,
    HUMAN_TRIALS,
    citation,
    human_outcomes,
    published,
)
from merge_runner_analysis.metrics import BOXES, GAP, JOINT, RMSE
from merge_runner_analysis.stats.regressions import GAP_TERMS, WHO_FIRST_TERMS

# Cells that only 110 trials can have given: (driver, setting, trials without an outcome).
OF_110 = [
    ("o3", "baseline", 1),
    *(("o3", setting, 0) for setting in ("A1", "A2", "A5", "A6", "A7")),
    *(("gemini-2.5-pro", setting, 0) for setting in ("baseline", "A4", "A5")),
]
SETTINGS = ["baseline", *(f"A{k}" for k in range(1, 8))]


def cells(name) -> pd.DataFrame:
    return published(name).set_index(["driver", "setting"])


def is_printed(percent: float, n: int) -> bool:
    """Whether a percentage of two decimals is a whole number of ``n`` trials."""
    return f"{100 * round(percent * n / 100) / n:.2f}" == f"{percent:.2f}"


def test_every_shipped_file_has_a_citation_and_every_citation_a_file():
    cited = pd.read_csv(DATA / "sources.csv")["file"]
    assert cited.is_unique
    assert {*cited, "sources.csv"} == {path.name for path in DATA.glob("*.csv")}
    assert all(len(citation(name.removesuffix(".csv"))) > 40 for name in cited)


def test_values_of_the_paper_and_of_the_humans_are_cited_as_theirs():
    for path in DATA.glob("paper_*.csv"):
        assert "arXiv 2604.09609, Table" in citation(path.stem)
    assert HUMAN_DOI in citation("human_outcomes")
    assert "S4 and S6" in citation("human_mixed_models")


def test_the_published_mixed_models_load():
    tables = published("human_mixed_models").set_index(["table", "term"])
    assert tables.apply(tuple, axis=1).to_dict() == {
        ("S4", "intercept"): (-0.32, 0.212),
        ("S4", "projected_headway"): (1.15, 0.08),
        ("S4", "relative_velocity"): (-3.413, 0.321),
        ("S6", "intercept"): (4.13, 0.45),
        ("S6", "abs_projected_headway"): (0.15, 0.04),
        ("S6", "abs_relative_velocity"): (-0.18, 0.17),
        ("S6", "headway_x_velocity"): (0.18, 0.03),
    }


def test_the_human_counts_add_up_to_the_published_sums():
    counts = published("human_outcomes")
    assert list(counts["condition"]) == list(CONDITIONS)
    outcomes = counts[["left_first", "right_first", "collided"]]
    assert list(outcomes.sum()) == [465, 497, 28]
    assert (outcomes.sum(axis=1) == 90).all()


def test_conflict_resolution_times_are_in_order():
    times = published("human_outcomes").filter(like="crt_")
    assert list(times) == ["crt_min_s", "crt_q1_s", "crt_median_s", "crt_q3_s", "crt_max_s"]
    assert (times.diff(axis=1).iloc[:, 1:] >= 0).all(axis=None)


def test_human_outcomes_are_one_row_a_trial_under_their_condition():
    trials = human_outcomes()
    assert len(trials) == HUMAN_TRIALS == 990
    assert (trials["condition"].value_counts() == 90).all()
    for name, rows in trials.groupby("condition"):
        assert set(rows["projected_headway_m"]) == {CONDITIONS[name].projected_headway_m}
        assert set(rows["relative_velocity_mps"]) == {CONDITIONS[name].relative_velocity_mps}
    tie = trials[trials["condition"] == "L_4_8"]
    assert dict(tie["merged_first"].value_counts()) == {"left": 68, "right": 20}
    assert (trials["merged_first"].isna() == (trials["status"] == "collided")).all()
    assert set(trials["status"]) == {"finished", "collided"}


@pytest.mark.parametrize(("driver", "setting", "open_trials"), OF_110)
def test_table_vii_prints_whole_numbers_of_110_trials(driver, setting, open_trials):
    row = cells("paper_ablation_quantitative").loc[(driver, setting)]
    collided = row["collided_percent"] * 110 / 100
    assert collided == pytest.approx(round(collided), abs=0.01)
    finished = 110 - open_trials - round(collided)
    assert is_printed(row["joint_percent"], finished)


def test_every_cell_of_table_vii_fits_110_trials_and_half_of_the_ablations_not_55():
    possible = {}
    table = published("paper_ablation_quantitative").query("setting in @SETTINGS[1:]")
    assert len(table) == 14
    for _, row in table.iterrows():
        cell = row["driver"], row["setting"]
        for n in (110, 55):
            collided = round(row["collided_percent"] * n / 100)
            possible[cell, n] = is_printed(row["collided_percent"], n) and is_printed(
                row["joint_percent"], n - collided
            )
    assert all(fits for (_, n), fits in possible.items() if n == 110)
    impossible = {cell for (cell, n), fits in possible.items() if n == 55 and not fits}
    assert impossible == {cell[:2] for cell in OF_110 if cell[1] != "baseline"}


def test_the_human_row_of_table_vii_is_that_of_the_990_trials():
    row = published("paper_ablation_quantitative").query("driver == 'human'").iloc[0]
    found = [float(row[metric.paper_of_humans]) for metric in (BOXES, GAP, RMSE, JOINT)]
    assert found == [2.83, 3.85, 0.66, 53.0]
    assert f"{100 * 28 / 990:.2f}" == "2.83"
    assert f"{100 * 510 / 962:.1f}" == "53.0"


def test_a_score_is_the_sum_of_its_indicators():
    table = published("paper_ablation_qualitative")
    marks = table[["i1", "i2", "i3", "i4", "i5"]]
    assert marks.isin([0, 1]).all(axis=None)
    assert (marks.sum(axis=1) == table["score"]).all()


@pytest.mark.parametrize("name", ["paper_ablation_qualitative", "paper_ablation_quantitative"])
def test_the_ablation_tables_hold_the_humans_and_all_settings_of_both_models(name):
    models = [(driver, s) for driver in ("o3", "gemini-2.5-pro") for s in SETTINGS]
    assert list(cells(name).index) == [("human", ""), *models]


@pytest.mark.parametrize(
    ("name", "terms", "statistic"),
    [("paper_who_first", WHO_FIRST_TERMS, "z"), ("paper_gap", GAP_TERMS, "t")],
)
def test_the_regression_tables_agree_with_themselves(name, terms, statistic):
    table = published(name)
    for _, rows in table.groupby(["driver", "setting"]):
        assert tuple(rows["term"]) == terms
    # b is printed with two decimals, its error with three and the statistic with two.
    ratio = table["b"] / table["se"]
    rounding = (0.0051 + 0.00051 * ratio.abs()) / table["se"] + 0.0051
    assert ((ratio - table[statistic]).abs() <= rounding).all()
    significant = table[statistic].abs() > 1.98
    assert (significant == (table["p"].str.removeprefix("<").astype(float) < 0.05)).all()


@pytest.mark.parametrize("name", ["paper_who_first", "paper_gap"])
def test_the_regressions_rest_on_the_trials_that_did_not_collide(name):
    ns = published(name).groupby("driver")["n"].agg(["min", "max"])
    collided = cells("paper_ablation_quantitative")["collided_percent"]
    assert tuple(ns.loc["human"]) == (962, 962)
    assert tuple(ns.loc["gemini-2.5-pro"]) == (82, 82)
    assert tuple(ns.loc["o3"]) == (109, 109)  # one of 110 did not finish
    assert 110 - round(collided["gemini-2.5-pro", "baseline"] * 1.1) == 82


@pytest.mark.parametrize("driver", ["human", "o3", "gemini-2.5-pro"])
def test_the_published_marks_follow_from_the_published_regressions(driver):
    who_first = published("paper_who_first").query("driver == @driver").set_index("term")
    gap = published("paper_gap").query("driver == @driver").set_index("term")

    def significant(row):
        return float(row["p"].removeprefix("<")) < 0.05

    headway, velocity = who_first.loc["projected_headway"], who_first.loc["relative_velocity"]
    growth, main = gap.loc["abs_projected_headway"], gap.loc["abs_relative_velocity"]
    marks = [
        headway["b"] > 0 and significant(headway),
        velocity["b"] < 0 and significant(velocity),
        growth["b"] > 0 and significant(growth),
        not significant(main),
    ]
    row = published("paper_ablation_qualitative").query(
        "driver == @driver and setting in ('', 'baseline')"
    )
    assert marks == [bool(row[f"i{k}"].item()) for k in range(1, 5)]


def test_the_four_human_standard_errors_of_the_gap_imply_its_deviation():
    """SE = SD * sqrt((X'X)^-1), with the human trials that finished in each condition."""
    trials = human_outcomes().query("status == 'finished'")
    h, dv = trials["projected_headway_m"], trials["relative_velocity_mps"]
    design = np.column_stack([np.ones(len(h)), abs(h), abs(dv), h * dv])
    inverse = np.linalg.inv(design.T @ design)
    printed = published("paper_gap").query("driver == 'human'")["se"].to_numpy()
    for implied in printed / inverse.diagonal() ** 0.5:
        assert implied == pytest.approx(HUMAN_GAP_SD_M, rel=0.02)
