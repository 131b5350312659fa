"""How often copies of the humans are said to differ from them, and how often an effect is found."""

from collections.abc import Iterator

import numpy as np
import pandas as pd
import pytest
from scipy.special import expit

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.grouping import Group
from merge_runner_analysis.published import HUMAN_GAP_SD_M, human_counts, published
from merge_runner_analysis.stats import verdicts
from merge_runner_analysis.stats.regressions import gap_design
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.wording import DIFFERS
from tests.support.studies import write_study

COPIES = 200
CONDITIONS = pd.DataFrame(
    [
        (name, at.projected_headway_m, at.relative_velocity_mps, *human_counts()[name])
        for name, at in HUMAN_CONDITIONS.items()
    ],
    columns=["condition", "projected_headway_m", "relative_velocity_mps", "left", "right", "hit"],
)
INTERCEPTS_M = published("human_gap_intercepts")["intercept_m"].to_numpy()
# What remains within pairs of the published scatter of gaps about their regression.
WITHIN_M = float(np.sqrt(HUMAN_GAP_SD_M**2 - INTERCEPTS_M.var()))


def drawn(rng: np.random.Generator, trials: int, *, pairs: bool, of_velocity: float = 0.0) -> Group:
    """A copy of the humans: outcomes by the published counts, gaps by the published regression.

    With ``pairs`` it is nine pairs, drawn from the published ones, and each keeps its level of the
    gap. ``of_velocity`` is added to the log-odds of going first for each m/s.
    """
    at = CONDITIONS.loc[np.repeat(CONDITIONS.index, trials // len(CONDITIONS))]
    n = len(at)
    counts = at[["left", "right", "hit"]].to_numpy(float)
    hit = rng.random(n) < counts[:, 2] / counts.sum(axis=1)
    left, right = counts[:, :2].T + (0.5 if of_velocity else 0.0)  # log-odds are finite
    chance = expit(np.log(left / right) + of_velocity * at["relative_velocity_mps"].to_numpy())
    rows = published("paper_gap").query("driver == 'human'")["b"].to_numpy(float)
    design = gap_design(*at[["projected_headway_m", "relative_velocity_mps"]].to_numpy().T)
    scatter = rng.normal(0, HUMAN_GAP_SD_M, n)
    if pairs:
        level = rng.choice(INTERCEPTS_M, len(INTERCEPTS_M))
        scatter = rng.normal(0, WITHIN_M, n) + level[np.arange(n) % len(level)]
    gap = np.where(hit, np.nan, design @ rows + scatter)
    found = at[["condition", "projected_headway_m", "relative_velocity_mps"]].assign(
        trial_id=[f"copy/{number}" for number in range(n)],
        spec_hash="copy",
        pair=None,
        status=np.where(hit, "collided", "finished"),
        merged_first=np.where(hit, None, np.where(rng.random(n) < chance, "left", "right")),
        gap_m=gap,
        counted_gap_m=gap,
        collided_boxes=hit,
    )
    found = found.reset_index(drop=True)
    return Group(
        name="copy", driver="copy", label="copy", models=("copy",), setting="baseline", trials=found
    )


@pytest.fixture(scope="module")
def humans(tmp_path_factory):
    """The humans as published."""
    return StudyResults(write_study(tmp_path_factory.mktemp("humans") / "t.duckdb", [])).human


@np.errstate(divide="ignore")
def states(groups: Iterator[Group], humans: Group) -> list[dict[str, str]]:
    every = (verdicts.Both(group, humans) for group in groups)
    return [verdicts.states_of(both, verdicts.tests_of(both)) for both in every]


@pytest.mark.parametrize("pairs", [True, False])
@pytest.mark.parametrize("trials", [22, 110, 330])
def test_at_most_6_percent_of_copies_of_the_humans_are_said_to_differ(humans, trials, pairs):
    rng = np.random.default_rng(trials + pairs)
    found = states((drawn(rng, trials, pairs=pairs) for _ in range(COPIES)), humans)
    different = sum(not DIFFERS.isdisjoint(of.values()) for of in found)
    assert different <= 0.06 * COPIES


def test_a_planted_weaker_response_to_relative_velocity_is_found(humans):
    """-1.0 in place of the humans' -3.3 log-odds per m/s."""
    rng = np.random.default_rng(1)
    weaker = {"pairs": True, "of_velocity": -1.0 + 3.3}
    found = states((drawn(rng, 110, **weaker) for _ in range(COPIES)), humans)
    assert sum(of["velocity"] in DIFFERS for of in found) >= 0.85 * COPIES
