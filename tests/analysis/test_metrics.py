"""The list of metrics, and what a group of trials comes to by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from analysis.data.study import Study
from analysis.metrics import (
    BOXES,
    COLLISIONS,
    GAP,
    JOINT,
    LEFT_FIRST,
    METRICS,
    RMSE,
    HumanReference,
    Metric,
    register,
    shown_in,
)
from analysis.stats.measures import counts, estimate, human_reference, median, values
from analysis.tables import make_tables
from merge_runner.errors import UsageError
from tests.analysis.studies import write_study, yielding


@pytest.fixture
def added(monkeypatch):
    """Adds a metric for the length of a test."""
    monkeypatch.setattr(METRICS, "_things", dict(METRICS._things))

    def add(**changes):
        return register(replace(RMSE, paper_of_humans="", paper_of_drivers="", **changes))

    return add


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    """o3 with a variant, once in every condition."""
    drives = [*yielding("o3", reps=1), *yielding("o3", "A1", reps=1)]
    return write_study(tmp_path_factory.mktemp("metrics") / "t.duckdb", drives)


def test_places_show_the_metrics_in_the_order_of_the_list():
    assert shown_in("tables") == [COLLISIONS, BOXES, GAP, RMSE, JOINT]
    assert shown_in("fallbacks") == [COLLISIONS, BOXES, LEFT_FIRST, GAP, RMSE, JOINT]


def test_a_metric_needs_a_name_for_a_column_and_places_that_there_are(added):
    with pytest.raises(UsageError, match=r"'mean \|a\|' needs a name of letters"):
        added(name="mean |a|")
    with pytest.raises(UsageError, match="'a_m' is shown in nowhere; valid: tables, fallbacks"):
        added(name="a_m", shown=frozenset({"nowhere"}))
    with pytest.raises(UsageError, match="there is a metric 'gap_m' already"):
        register(GAP)


def test_trials_whose_value_is_missing_or_no_finite_number_do_not_count(added, db):
    odd = added(
        name="odd_m",
        value="CASE condition WHEN 'N_0_0' THEN NULL WHEN 'L_4_0' THEN 'inf'::DOUBLE "
        "WHEN 'R_-4_0' THEN 'nan'::DOUBLE ELSE gap_m END",
    )
    group = Study(db).models[0]
    assert len(values(group, odd)) == 11 - 3
    assert estimate(group, odd).n == 11 - 3


def test_a_proportion_of_all_ended_trials_counts_those_of_which_it_is_known(added, db):
    slow = added(
        name="slow_percent",
        estimator="proportion",
        trials="ended",
        value="if(condition = 'N_0_0', NULL, condition LIKE 'L%')",
    )
    assert counts(Study(db).models[0], slow) == (5, 10)


@pytest.mark.usefixtures("few_draws")
def test_a_rate_is_tested_against_humans_where_its_trials_are_published(added, db):
    """Of a median there is no test, and without n none of a rate."""
    rate = {"estimator": "proportion", "value": "joint"}
    added(name="a_percent", label="a", human=HumanReference(40.0, "X (2026)", n=50), **rate)
    added(name="b_percent", label="b", human=HumanReference(40.0, "X (2026)"), **rate)
    added(name="c_mps", label="c", estimator="median")
    (table,) = make_tables(Study(db), ["contrasts"])
    rows = {row.id: row for row in table.rows}
    assert rows["o3/baseline/human/a_percent"].values["n_reference"] == 50
    note = rows["o3/baseline/human/a_percent"].note
    assert "human a: 20 of 50 trials, from the 40.0 % of X (2026)" in note
    assert "o3/A1/baseline/b_percent" in rows
    assert "o3/baseline/human/b_percent" not in rows
    assert not any(name.endswith("c_mps") for name in rows)


@pytest.mark.usefixtures("few_draws")
def test_a_published_human_value_stands_in_the_tables_with_its_interval_and_source(added, db):
    known = HumanReference(0.5, "X (2026)", low=0.4, high=0.6)
    added(name="a_mps", label="a", word="a", human=known)
    quantitative, indicators = make_tables(Study(db), ["ablation-quantitative", "indicators"])
    (human,) = (row for row in quantitative.rows if row.id == "human")
    assert (human.values["a_mps"], human.values["a_mps_ci"]) == (0.5, (0.4, 0.6))
    assert "a is a published value, no human traces are imported (X (2026))" in human.note
    (human,) = (row for row in indicators.rows if row.id == "human/a_mps")
    assert human.values["interval"] == (0.4, 0.6)


def test_what_is_published_of_rates_is_of_the_trials_that_count():
    assert human_reference(JOINT).n == 962
    assert human_reference(BOXES).n == 990
    assert human_reference(COLLISIONS) is None


@pytest.mark.parametrize("n", [6, 7, 20, 101])
def test_the_interval_of_a_median_covers_it_in_95_of_100_samples_and_is_no_wider(n):
    found = median(np.arange(1.0, n + 1))
    assert found.value == (n + 1) / 2
    k = int(found.low)
    assert found.high == n + 1 - k
    assert 1 - 2 * stats.binom.cdf(k - 1, n, 0.5) >= 0.95 > 1 - 2 * stats.binom.cdf(k, n, 0.5)


def test_few_values_have_a_median_without_an_interval():
    assert median(np.array([3.0, 1.0, 2.0])) == median(np.array([1.0, 2.0, 3.0]))
    assert median(np.arange(5.0)).low is None
    assert median(np.array([])).value is None


def test_every_metric_of_the_list_says_what_it_is():
    assert all(isinstance(one, Metric) and one.meaning and one.unit for one in METRICS.values())
