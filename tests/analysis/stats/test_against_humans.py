"""Measures against the humans, by pairs where these are known: refits, counts, and copies."""

from __future__ import annotations

from itertools import takewhile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from statsmodels.regression.linear_model import OLS

from merge_runner.config import ScenarioConfig
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.data.metric_values import outcomes_with_metrics
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.explain import explain
from merge_runner_analysis.metrics import BOXES, GAP
from merge_runner_analysis.stats.against_humans import contrast_by_pairs, contrast_with_humans
from merge_runner_analysis.stats.intervals import detectable
from merge_runner_analysis.tables import make_tables
from tests.analysis.stats.copies_of_humans import (
    WORLDS,
    called_different,
    driven,
    independent,
    shares,
)
from tests.analysis.studies import Drive, as_humans, write_study

DOCS = Path(__file__).parents[3] / "docs/reference/analysis.md"
RNG = np.random.default_rng(5)
# Pairs with unequal numbers of trials, two of which lack a condition.
HUMAN = driven(RNG, 5, differ=1.0, pairs=6).sample(frac=0.4, random_state=1)
HUMAN = HUMAN[(HUMAN["condition"] != "N_0_0") | ~HUMAN["pair"].isin(["pair0", "pair1"])]
DRIVER = driven(RNG, 3, differ=1.0, pairs=0)


def group(trials, setting="baseline", **more) -> Group:
    name = "driver" if setting else "human"
    return Group(name, setting, "s", trials, label=name, models=(name,), name=name, **more)


def published() -> Group:
    return group(outcomes_with_metrics(), "", measured=False)


def slope(both: pd.DataFrame, measure: str) -> float:
    """The coefficient of the source, by least squares with a level for each condition."""
    levels = pd.get_dummies(both["condition"], dtype=float)
    design = np.column_stack([both["driven"], levels.loc[:, levels.any()]])
    return float(OLS(both[measure].to_numpy(float), design).fit().params[0])


def refitted(driver, human, measure) -> tuple[float, float, float, int]:
    """The slope, and the squared errors of the driver and the humans, leaving out each in turn.

    The last is the number of pairs.
    """
    shared = set(driver["condition"]) & set(human["condition"])
    both = pd.concat([driver.assign(driven=1.0), human.assign(driven=0.0)], ignore_index=True)
    both = both[both["condition"].isin(shared)].dropna(subset=[measure])
    whole = slope(both, measure)
    trials = [slope(both.drop(index=i), measure) - whole for i in both.index[both["driven"] == 1]]
    names = both.loc[both["driven"] == 0, "pair"].unique()
    pairs = [slope(both[both["pair"] != name], measure) - whole for name in names]
    g = len(names)
    return whole, sum(x**2 for x in trials), sum(x**2 for x in pairs) * (g - 1) / g, g


@pytest.mark.parametrize("measure", ["gap_m", "joint"])
@pytest.mark.parametrize("conditions", [list(HUMAN_CONDITIONS), ["N_0_0", "L_4_8"]])
def test_it_is_a_linear_model_within_conditions_refitted_without_each_pair_and_trial(
    measure, conditions
):
    driver = DRIVER[DRIVER["condition"].isin(conditions)]
    found = contrast_by_pairs(driver, HUMAN, measure, rate=False)
    value, of_trials, of_pairs, pairs = refitted(driver, HUMAN, measure)
    se, n = (of_trials + of_pairs) ** 0.5, driver[measure].notna().sum()
    freedom = se**4 / (of_trials**2 / (n - 1) + of_pairs**2 / (pairs - 1))
    assert found.value == pytest.approx(value)
    assert found.freedom == pytest.approx(freedom)
    assert found.high - found.value == pytest.approx(stats.t.ppf(0.975, freedom) * se)
    assert found.p == pytest.approx(2 * stats.t.sf(abs(value) / se, freedom))
    assert found.detectable == pytest.approx(detectable(se, freedom))
    assert found.by == f"{pairs} pairs"


def test_a_rate_of_the_driver_has_at_least_the_error_of_equal_rates():
    driver = DRIVER.assign(collided=False)
    found = contrast_by_pairs(driver, HUMAN, "collided", rate=True)
    value, _, of_pairs, _ = refitted(driver.astype({"collided": float}), HUMAN, "collided")
    of_driver, weight = 0.0, 0.0
    for name, mine in driver.groupby("condition"):
        theirs = HUMAN.loc[HUMAN["condition"] == name, "collided"].astype(float)
        n, m = len(mine), len(theirs)
        variance = np.var([*mine["collided"].astype(float), *theirs], ddof=1)
        of_driver += n * (m / (n + m)) ** 2 * variance
        weight += n * m / (n + m)
    of_driver /= weight**2
    freedom = (of_driver + of_pairs) ** 2 / (of_driver**2 / (len(driver) - 1) + of_pairs**2 / 5)
    assert found.value == pytest.approx(value)
    assert found.freedom == pytest.approx(freedom)
    half = stats.t.ppf(0.975, freedom) * (of_driver + of_pairs) ** 0.5
    assert found.high - found.value == pytest.approx(half)


def test_only_the_conditions_that_both_have_count():
    """Five of 90 human trials of N_0_0 collided; over all conditions it is 28 of 990."""
    human = published()
    tie = group(human.trials.query("condition == 'N_0_0'"))
    found = contrast_with_humans(human, tie, BOXES)
    assert (found.value, found.p, found.by) == (0, 1, "")
    known = driven(np.random.default_rng(1), 10, differ=1.0, pairs=9)
    alone = contrast_by_pairs(DRIVER.query("condition == 'N_0_0'"), known, "gap_m", rate=False)
    assert alone == contrast_by_pairs(
        DRIVER.query("condition == 'N_0_0'"),
        known.query("condition == 'N_0_0'"),
        "gap_m",
        rate=False,
    )


def test_a_driver_of_one_condition_is_set_against_the_human_trials_of_it(tmp_path):
    drives = [
        Drive(
            "o3", "baseline", "N_0_0", rep, () if rep == 1 else (0.5,) * 3, (-0.5 * (rep > 1),) * 3
        )
        for rep in range(1, 19)
    ]
    by_boxes = ScenarioConfig(collision_rule="rectangle")
    db = write_study(tmp_path / "t.duckdb", drives, by_boxes)
    (table,) = make_tables(Study(db), ["contrasts"])
    (row,) = table.rows
    assert (row.values["difference"], row.values["p"]) == (pytest.approx(0), 1)
    assert (row.values["n"], row.values["n_reference"]) == (18, 90)
    assert row.values["errors"] == "trials"
    notes = " ".join(table.notes)
    assert "coll. boxes (%) against humans: the published counts" in notes
    assert "gap, RMSE and joint rate against humans need the recordings" in notes
    assert "over all trials" not in notes


@pytest.mark.parametrize("pairs", [2, 3])
def test_explain_lists_the_trials_of_the_shared_conditions_and_notes_say_what_has_no_test(
    pairs, tmp_path
):
    drives = [
        Drive(name, variant, condition, rep, (0.1 * (rep + i),) * 3, (-0.3,) * 3)
        for i, (name, variant) in enumerate(
            [("o3", "baseline"), *(("human", f"pair{i}") for i in range(1, pairs + 1))]
        )
        for condition in ("N_0_0", "L_4_8")
        for rep in range(1, 4)
        if (name, condition) != ("o3", "L_4_8")
    ]
    db = write_study(tmp_path / "t.duckdb", drives)
    as_humans(db)
    study = Study(db)
    (table,) = make_tables(study, ["contrasts"])
    rows = {row.id: row for row in table.rows}
    if pairs == 2:
        assert "o3/baseline/human/gap_m" not in rows
        reason = "o3/baseline: gap (m) is not tested against humans: 2 human pairs are too few"
        assert any(reason in note for note in table.notes)
        return
    row = rows["o3/baseline/human/gap_m"].values
    assert (row["n"], row["n_reference"], row["errors"]) == (3, 9, "3 pairs")
    found = explain(study, table, "o3/baseline/human/gap_m:difference").sources
    assert {source.group: len(source.trials) for source in found} == {"human": 9, "o3/baseline": 3}


NOTHING = DRIVER.assign(collided=False)
UNTESTED = {
    "2 human pairs are too few": (DRIVER, HUMAN[HUMAN["pair"].isin(["pair0", "pair1"])], "gap_m"),
    "1 human pair is too few": (DRIVER, HUMAN[HUMAN["pair"] == "pair2"], "gap_m"),
    "a single trial": (DRIVER.head(1), HUMAN, "rmse_mps"),
    "there is nothing to test": (NOTHING, HUMAN.assign(collided=False), "collided"),
    "": (DRIVER.query("condition == 'N_0_0'"), HUMAN.query("condition != 'N_0_0'"), "gap_m"),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("reason", UNTESTED)
def test_what_has_no_test_says_why(reason):
    *both, measure = UNTESTED[reason]
    found = contrast_by_pairs(*both, measure, rate=measure == "collided")
    assert found.startswith(reason) or found.endswith(reason)
    assert bool(found) == bool(reason)


def test_a_gap_is_tested_by_pairs_while_collisions_are_still_the_published_ones():
    human = group(HUMAN, "", published_outcomes=outcomes_with_metrics())
    driver = group(DRIVER.assign(collided_boxes=DRIVER["collided"], counted_gap_m=DRIVER["gap_m"]))
    human.trials["counted_gap_m"] = human.trials["gap_m"]
    assert contrast_with_humans(human, driver, GAP).by == "6 pairs"
    assert contrast_with_humans(human, driver, BOXES).by == ""


def test_a_rate_with_undecided_trials_is_not_compared():
    driver = group(DRIVER.assign(collided_boxes=[None, *DRIVER["collided"][1:]]))
    found = contrast_with_humans(published(), driver, BOXES)
    assert found == "undecided is whether 1 of the driver's trials collided"


@pytest.mark.slow
def test_copies_are_often_called_different_where_pairs_are_taken_as_independent_trials():
    assert called_different(independent, "nine pairs", 20)["gap_m"] > 20


def printed(world: str) -> dict[str, str]:
    """The shares of a world in the docs, by test."""
    lines = DOCS.read_text(encoding="utf-8").splitlines()
    start = lines.index(f"| called different (%) | {' | '.join(WORLDS)} |") + 2
    rows = (line.strip("| ").split(" | ") for line in takewhile(str.strip, lines[start:]))
    return {name: of[list(WORLDS).index(world)] for name, *of in rows}


@pytest.mark.long
@pytest.mark.parametrize("world", WORLDS)
def test_at_most_7_of_100_copies_of_the_humans_are_called_different_as_the_docs_print(world):
    found = shares(world)
    assert max(found.values()) <= 7
    assert {name: f"{share:.1f}" for name, share in found.items()} == printed(world)
