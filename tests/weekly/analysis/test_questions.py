"""What is said of simulated studies in which nothing differs, and of some in which a hurry does."""

from copy import copy
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.special import expit
from scipy.stats import binom

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.metrics import COLLISIONS, GAP, LEFT_FIRST, METRICS, RMSE
from merge_runner_analysis.stats.effects import driver_effects
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables import make_tables
from merge_runner_analysis.web.claims import answered
from tests.support.harness import FAST
from tests.support.studies import Drive, write_study
from tests.support.words_study import EXAMPLE

STUDIES = 200


@pytest.fixture(scope="module")
def scientists(prepare, tmp_path_factory):
    """The study of two personas, a hurry and two opponents, as it is played."""
    folder = tmp_path_factory.mktemp("scientists")
    (folder / "study.toml").write_text(EXAMPLE)
    prepare(folder, "sweep", "study.toml", "--db", "t.duckdb", *FAST, code=0)
    return StudyResults(folder / "t.duckdb")


def simulated(study, rng, hurried):
    """The study with other outcomes, drawn by a logit to which a hurry adds; one in 20 crashes."""
    groups = []
    for group in study.models:
        rows = group.trials
        logit = 1.11 * rows["projected_headway_m"] - 3.30 * rows["relative_velocity_mps"]
        logit += np.where(rows["ego"] == "left", -0.3, 0.3)
        logit += hurried * (group.levels["hurry"] == "yes")
        crashed = rng.random(len(rows)) < 0.05
        first = pd.array(rng.random(len(rows)) < expit(logit), dtype="boolean")
        first[crashed] = pd.NA
        columns = dict.fromkeys((one.column for one in METRICS.values()), pd.NA)
        columns |= {"status": np.where(crashed, "collided", "finished"), LEFT_FIRST.column: first}
        columns["way"] = rows["trial_id"]  # as of language models
        groups.append(replace(group, trials=rows.assign(**columns), whole=None, posing=""))
    other = copy(study)
    vars(other).pop("_remembered", None)
    other.models, other.groups = groups, [study.human, *groups]
    return other


@pytest.mark.parametrize("hurried", [0.0, 1.5])
def test_the_first_page_says_that_nothing_is_shown_where_nothing_is(scientists, hurried):
    rng, claims = np.random.default_rng(52), []
    for _ in range(STUDIES if not hurried else STUDIES // 10):
        study = simulated(scientists, rng, hurried)
        (table,) = make_tables(study, ["effects"])
        claims.append(answered(table.rows)[0])
    if hurried:
        assert all(claim.startswith("Hurry changes who goes first: ") for claim in claims)
        return
    none = sum(claim.startswith("No change of who goes first is shown by ") for claim in claims)
    assert none >= binom.interval(0.95, STUDIES, 0.95)[0]


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """Two models with 110 trials each."""
    drives = [
        Drive(model, "baseline", condition, rep, (0.1,) * 3, (-0.1,) * 3, {})
        for model in ("one", "two")
        for condition in HUMAN_CONDITIONS
        for rep in range(1, 11)
    ]
    return StudyResults(write_study(tmp_path_factory.mktemp("two") / "t.duckdb", drives))


def drawn(study, rng, crashes):
    """The two models with outcomes drawn from one process but for the rates of ``crashes``."""
    groups = []
    for group, rate in zip(study.models, crashes, strict=True):
        rows = group.trials
        logit = 1.11 * rows["projected_headway_m"] - 3.30 * rows["relative_velocity_mps"]
        crashed = rng.random(len(rows)) < rate
        first = pd.array(rng.random(len(rows)) < expit(logit), dtype="boolean")
        gaps_m = rng.normal(4 + 0.3 * rows["projected_headway_m"].abs(), 1.2)
        rmse_mps = rng.normal(1, 0.2, len(rows))
        first[crashed], gaps_m[crashed], rmse_mps[crashed] = pd.NA, np.nan, np.nan
        columns = dict.fromkeys((one.column for one in METRICS.values()), pd.NA)
        columns |= {LEFT_FIRST.column: first, GAP.column: gaps_m, RMSE.column: rmse_mps}
        columns |= {COLLISIONS.column: crashed, "way": rows["trial_id"]}
        columns["status"] = np.where(crashed, "collided", "finished")
        groups.append(replace(group, trials=rows.assign(**columns), whole=None, posing=""))
    other = copy(study)
    vars(other).pop("_remembered", None)
    other.models, other.groups = groups, [study.human, *groups]
    return other


@pytest.mark.parametrize(
    ("crashes", "least", "most"), [((0.05, 0.05), 0, 12), ((0.05, 0.25), 180, 200)]
)
def test_copies_of_a_model_are_not_told_apart_and_20_points_of_crashes_are(
    two, crashes, least, most
):
    rng, apart = np.random.default_rng(53), 0
    for _ in range(STUDIES):
        study = drawn(two, rng, crashes)
        found = driver_effects(study, study.models[1], study.models[0])
        tested = {of.metric.name: of.p_corrected for of in found if of.difference.p is not None}
        assert {*tested} == {metric.name for metric in (COLLISIONS, LEFT_FIRST, GAP, RMSE)}
        p = min(tested.values()) if crashes[0] == crashes[1] else tested[COLLISIONS.name]
        apart += p < 0.05
    assert least <= apart <= most
