"""The list of metrics, and what a group of trials comes to by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from merge_runner.errors import UsageError
from merge_runner.results.store import Store
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.human.archive import open_files
from merge_runner_analysis.human.load import import_trials, sort_files
from merge_runner_analysis.metrics import (
    BOXES,
    COLLISIONS,
    GAP,
    JOINT,
    METRICS,
    RMSE,
    Metric,
    register,
    shown_in,
)
from merge_runner_analysis.stats.measures import (
    counts,
    estimate,
    median,
    no_human_value,
    values,
)
from merge_runner_analysis.tables import make_tables
from tests.support.recordings import drive, write_folder
from tests.support.studies import write_study, yielding


@pytest.fixture
def added(own_parts):
    """Adds a metric for the length of a test."""

    def add(**changes):
        return register(replace(RMSE, paper_of_humans="", paper_of_drivers="", **changes))

    return add


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    """o3 with a variant, once in every condition."""
    drives = [*yielding("o3", reps=1), *yielding("o3", "A1", reps=1)]
    return write_study(tmp_path_factory.mktemp("metrics") / "t.duckdb", drives)


@pytest.fixture(scope="module")
def partly(tmp_path_factory):
    """o3 beside one pair of humans, once in every condition."""
    folder = tmp_path_factory.mktemp("partly")
    files = {
        f"experiment_4/experiment_4_iter_{number}.csv": drive(name).csv()
        for number, name in enumerate(CONDITIONS, 1)
    }
    path = write_study(folder / "t.duckdb", yielding("o3", reps=1))
    with open_files(write_folder(folder / "recordings", files)) as found:
        import_trials(sort_files(found), Store(path))
    return path


def test_places_show_the_metrics_in_the_order_of_the_list():
    assert shown_in("tables") == [COLLISIONS, BOXES, GAP, RMSE, JOINT]


def test_a_metric_needs_a_name_for_a_column(added):
    with pytest.raises(UsageError, match=r"'mean \|a\|' needs a name of letters"):
        added(name="mean |a|")
    with pytest.raises(UsageError, match="there is a metric 'gap_m' already"):
        register(GAP)


def test_a_metric_whose_parts_do_not_fit_together_is_refused(added):
    with pytest.raises(UsageError, match=r"^the metric 'a_m' .*it needs trials='ended'"):
        added(name="a_m", value="collided", estimator="proportion")


def test_the_trials_of_a_share_are_those_that_it_is_found_in(added, partly):
    added(name="driven_percent", estimator="proportion", trials="ended", value="end_time_s > 0")
    human = Study(partly).human
    assert counts(human, METRICS["driven_percent"]) == (11, 11)
    assert counts(human, BOXES) == (28, 990)


def test_why_humans_have_no_value_is_told_of_collisions_alone_by_their_rule(added):
    whole = added(name="a_mps", label="a")
    assert no_human_value(COLLISIONS).endswith("published human collisions are boxes that overlap")
    assert no_human_value(whole) == "a (m/s): no human value is published, and none is imported"


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


def test_a_rate_is_compared_and_a_median_is_not(added, db):
    rate = {"estimator": "proportion", "value": "joint"}
    added(name="a_percent", label="a", **rate)
    added(name="c_mps", label="c", estimator="median")
    (table,) = make_tables(Study(db), ["contrasts"])
    rows = {row.id for row in table.rows}
    assert "o3/A1/baseline/a_percent" in rows
    assert not any(name.endswith("c_mps") for name in rows)


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
