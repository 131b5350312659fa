"""What is said of simulated studies in which nothing differs, and of two models that do differ."""

from copy import copy
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.special import expit
from scipy.stats import binom
from statsmodels.stats.contingency_tables import StratifiedTable

from merge_runner_analysis.metrics import COLLISIONS, LEFT_FIRST, METRICS
from merge_runner_analysis.stats.effects import driver_effects, effects
from merge_runner_analysis.study import Study
from merge_runner_analysis.tables import make_tables
from merge_runner_analysis.web.question import answered
from tests.integration.study.test_words_study import EXAMPLE
from tests.support.harness import FAST
from tests.support.studies import write_study, yielding

STUDIES = 200
REPS = 20  # of a model in each of eleven conditions
ASKED = {"endpoint": "https://example.org", "body": {"model": "m"}}


def bounds(rate):
    """How many of STUDIES may be found at this rate: two-sided, at 95 %."""
    return binom.interval(0.95, STUDIES, rate)


def simulated(study, outcomes):
    """The study with other outcomes: of the trials of a group their status and their column."""
    groups = []
    for group in study.models:
        status, metric, values = outcomes(group)
        columns = dict.fromkeys((one.column for one in METRICS.values()), pd.NA)
        columns |= {"status": status, metric.column: pd.array(values, dtype="boolean")}
        columns["way"] = group.trials["trial_id"]  # as of language models
        trials = group.trials.assign(**columns)
        groups.append(replace(group, trials=trials, whole=None, posing=""))
    other = copy(study)
    vars(other).pop("_remembered", None)
    other.models, other.groups = groups, [study.human, *groups]
    return other


@pytest.fixture(scope="module")
def scientists(prepare, tmp_path_factory):
    """The study of two personas, a hurry and two opponents, as it is played."""
    folder = tmp_path_factory.mktemp("scientists")
    (folder / "study.toml").write_text(EXAMPLE)
    done = prepare(folder, "sweep", "study.toml", "--db", "t.duckdb", *FAST)
    assert done.code == 0, done.err
    return Study(folder / "t.duckdb")


def drawn_first(rng, hurried):
    """Who goes first by a logit, which a hurry adds to; one trial in twenty ends in a crash."""

    def outcomes(group):
        rows = group.trials
        logit = 1.11 * rows["projected_headway_m"] - 3.30 * rows["relative_velocity_mps"]
        logit += np.where(rows["ego"] == "left", -0.3, 0.3)
        logit += hurried * (group.levels["hurry"] == "yes")
        crashed = rng.random(len(rows)) < 0.05
        first = pd.array(rng.random(len(rows)) < expit(logit), dtype="boolean")
        first[crashed] = pd.NA
        return np.where(crashed, "collided", "finished"), LEFT_FIRST, first

    return outcomes


@pytest.mark.parametrize("hurried", [0.0, 1.5])
def test_the_first_page_says_that_nothing_is_shown_where_nothing_is(scientists, hurried):
    rng, claims = np.random.default_rng(52), []
    for _ in range(STUDIES if not hurried else STUDIES // 10):
        study = simulated(scientists, drawn_first(rng, hurried))
        (table,) = make_tables(study, ["effects"])
        claims.append(answered(table.rows)[0])
    if hurried:
        assert all(claim.startswith("Hurry changes who goes first: ") for claim in claims)
        return
    none = sum(claim.startswith("No change of who goes first is shown by ") for claim in claims)
    assert none >= bounds(0.95)[0]


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """Two language models, each with 220 trials."""
    drives = [drive for name in ("one", "two") for drive in yielding(name, reps=REPS)]
    path = tmp_path_factory.mktemp("two") / "t.duckdb"
    return Study(write_study(path, drives, asked=ASKED))


def crashes_of(study):
    """Both by model: the crashes and the trials of each condition."""
    return [
        group.trials.groupby("condition")[COLLISIONS.column].agg(["sum", "count"])
        for group in study.models
    ]


def independent_p(study):
    """The test of Mantel and Haenszel as statsmodels has it."""
    one, two = crashes_of(study)
    tables = [
        np.array([[a, n - a], [b, m - b]], float)
        for (a, n), (b, m) in zip(one.to_numpy(int), two.to_numpy(int), strict=True)
    ]
    return StratifiedTable(tables).test_null_odds(correction=False).pvalue


@pytest.mark.parametrize("rates", [(0.1, 0.3), (0.1, 0.1), (0.3, 0.3)])
def test_two_models_are_told_apart_by_their_crashes_and_copies_of_one_are_not(two, rates):
    rng, found = np.random.default_rng(53), 0
    rate_of = dict(zip(("one", "two"), rates, strict=True))

    def outcomes(group):
        crashed = rng.random(len(group.trials)) < rate_of[group.models[0]]
        return np.where(crashed, "collided", "finished"), COLLISIONS, crashed

    for _ in range(STUDIES):
        study = simulated(two, outcomes)
        assert [len(group.trials) for group in study.models] == [220, 220]
        (side_by_side,) = driver_effects(study, *reversed(study.models))
        (row,) = [one for one in effects(study) if one.metric is COLLISIONS]
        p = independent_p(study)
        assert side_by_side.difference.p == row.difference.p == pytest.approx(p, rel=1e-9)
        found += p < 0.05
    assert found == STUDIES if rates[0] < rates[1] else found <= bounds(0.06)[1]
