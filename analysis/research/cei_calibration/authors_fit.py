"""The authors' fit of thresholds to human drivers, from imported traces.

Siebinga, Zgonnikov and Abbink (2024): agents without noise and incentives, of 25 by 25 pairs of
thresholds, drive beside a car that keeps its speed. A human trial has the thresholds of the agent
whose speed is nearest one second after both vehicles have left their tunnels.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from analysis.research.cei_calibration.design import experiment
from analysis.research.cei_calibration.simulation import Trial, simulate
from merge_runner.drivers.cei.agents import Model
from merge_runner.drivers.cei.motion import task_of
from merge_runner.drivers.cei.parameters import FITTING, TICK_S, Base, ThresholdSet
from merge_runner.errors import UsageError
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS, Condition
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner_analysis.frames import load

Array = NDArray[np.float64]
LOWER = np.linspace(0.01, 0.40, 25)
UPPER = np.linspace(0.30, 0.90, 25)
GRID = tuple(Base(float(lower), float(upper)) for lower, upper in product(LOWER, UPPER))
# A speed that no agent comes near to has no thresholds.
NEAR_MPS = 0.5
# Where the highest of equal estimates is this one, the authors take the lowest.
EXCEPTION = 0.85
# Where a driver never reacts, its upper threshold is beyond all that it was seen to bear.
BEYOND = 1.1
LATER_S = 1.0
# Long enough for the second after the later exit.
SIMULATED_S = 6.5
# By trial and side: the speeds at the exit and one second later, who is ahead and who is faster as
# seen from there, and whether the driver reacted before the first vehicle merged.
REACTIONS = f"""
WITH cars AS (
    SELECT trial_id, spec_hash, side,
        max(position_m) FILTER (time_s = 0) AS exit_m,
        max(velocity_mps) FILTER (time_s = 0) AS exit_mps,
        max(velocity_mps) FILTER (time_s = {LATER_S}) AS later_mps,
        max(abs(velocity_mps - mean_speed_mps()
            - if(side = 'left', 0.5, -0.5) * relative_velocity_mps))
            FILTER (time_s <= first_s) AS changed_mps
    FROM states JOIN trials USING (trial_id, spec_hash) JOIN merge_times USING (trial_id, spec_hash)
    WHERE source = 'human' AND status = 'finished' GROUP BY ALL
)
SELECT own.trial_id, pair || '-' || own.side AS driver, condition, own.side,
    own.exit_mps, own.later_mps,
    own.exit_m - other.exit_m AS headway_m, own.exit_mps - other.exit_mps AS relative_mps,
    own.changed_mps > {NEAR_MPS} AS reacted
FROM cars AS own JOIN cars AS other USING (trial_id, spec_hash) JOIN trials
    USING (trial_id, spec_hash)
WHERE own.side <> other.side ORDER BY own.trial_id, own.side
"""  # noqa: S608 # our own numbers
TERMS = ("intercept", "headway", "relative_velocity", "product")


@dataclass(frozen=True, slots=True)
class Fit:
    """A threshold's mixed model: fixed terms, and by driver how far its intercept is off."""

    n: int
    terms: dict[str, float]
    drivers: dict[str, float]


def fit_thresholds(db: Path) -> tuple[Fit, Fit]:
    """The lower and the upper threshold of the imported humans; raises UsageError."""
    reactions = load(REACTIONS, db)
    if reactions.empty:
        raise UsageError(
            f"{db} holds no finished human trials: merge-runner human import PATH brings them in"
        )
    estimates = estimated(reactions)
    return mixed(estimates, "lower"), mixed(estimates, "upper")


def estimated(reactions: pd.DataFrame) -> pd.DataFrame:
    """Return the reactions with the columns ``lower`` and ``upper``; NaN is unknown."""
    speeds = grid_speeds()
    thresholds = [
        _thresholds(speeds[row.condition, row.side], row.exit_mps, row.later_mps, row.reacted)
        for row in reactions.itertuples()
    ]
    lower, upper = zip(*thresholds, strict=True)
    estimates = reactions.assign(lower=lower, upper=upper)
    still = estimates[~estimates["reacted"]]
    highest = still.groupby("driver")["upper"].transform("max") * BEYOND
    never = ~estimates.groupby(["driver", "condition"])["reacted"].transform("any")
    estimates.loc[never, "upper"] = highest
    return estimates


@cache
def grid_speeds() -> dict[tuple[str, str], Array]:
    """By condition and side: the agents' speeds one second after the exit, one of each GRID."""
    conditions: dict[tuple[str, str], Condition] = {}
    for name, condition in HUMAN_CONDITIONS.items():
        conditions[name, "left"] = condition
        conditions[name, "right"] = Condition(
            -condition.projected_headway_m, -condition.relative_velocity_mps
        )
    distinct = list(dict.fromkeys(conditions.values()))
    trials = [Trial(condition, (agent, None), (0, 0)) for condition in distinct for agent in GRID]
    scenario = experiment().model_copy(update={"timeout_s": SIMULATED_S})
    model = Model(task_of(scenario, TRACK), ThresholdSet(*(0.0,) * 10), FITTING)
    traces = simulate(model, trials, tunnel=True)
    later = traces.control_at + round(LATER_S / TICK_S)
    speeds = traces.speeds_mps[later, 0, np.arange(len(trials))].reshape(len(distinct), -1)
    speeds_of = dict(zip(distinct, speeds, strict=True))
    return {key: speeds_of[condition] for key, condition in conditions.items()}


def _thresholds(
    speeds: Array, exit_mps: float, later_mps: float, reacted: bool
) -> tuple[float, float]:
    """The lower and the upper threshold of one driver in one trial; NaN: it tells nothing."""
    off = np.abs(speeds - (later_mps if reacted else exit_mps))
    if off.min() >= NEAR_MPS:
        return np.nan, np.nan
    nearest = [GRID[n] for n in np.flatnonzero(np.isclose(off, off.min(), rtol=0, atol=1e-9))]
    lowers, uppers = {agent.lower for agent in nearest}, {agent.upper for agent in nearest}
    if not reacted:
        return np.nan, min(uppers)
    highest = max(uppers)
    return max(lowers), min(uppers) if np.isclose(highest, EXCEPTION) else highest


def mixed(estimates: pd.DataFrame, threshold: str) -> Fit:
    """Return the mixed model of a threshold on headway, relative velocity and their product."""
    from statsmodels.regression.mixed_linear_model import MixedLM
    from statsmodels.tools.sm_exceptions import ConvergenceWarning, SingularMatrixWarning

    chosen = estimates[estimates[threshold].notna()]
    headway, velocity = (chosen[name].to_numpy(float) for name in ("headway_m", "relative_mps"))
    terms = np.column_stack([np.ones(len(chosen)), headway, velocity, headway * velocity])
    few = f"{len(chosen)} estimates of the {threshold} threshold are too few for a mixed model"
    if np.linalg.matrix_rank(terms) < terms.shape[1] or chosen["driver"].nunique() < 2:
        raise UsageError(few)
    model = MixedLM(chosen[threshold].to_numpy(float), terms, groups=chosen["driver"].to_numpy())
    for method in ("bfgs", "lbfgs", "powell"):
        with warnings.catch_warnings():
            # Both warnings are checked below.
            warnings.simplefilter("ignore", ConvergenceWarning)
            warnings.simplefilter("ignore", SingularMatrixWarning)
            try:
                fit = model.fit(reml=True, method=method)
            except np.linalg.LinAlgError:  # a step to the edge, where drivers do not differ
                continue
        if fit.converged and float(fit.cov_re[0, 0]) > 0:
            return Fit(
                len(chosen),
                dict(zip(TERMS, map(float, fit.fe_params), strict=True)),
                {
                    str(name): float(np.ravel(intercept)[0])
                    for name, intercept in fit.random_effects.items()
                },
            )
    raise UsageError(f"{few}: none of its fits converges")


def threshold_set(lower: Fit, upper: Fit) -> ThresholdSet:
    """Both fits as the ten numbers of a set; spreads are those of the drivers' intercepts."""
    return ThresholdSet(
        lower_mean=lower.terms["intercept"],
        upper_mean=upper.terms["intercept"],
        lower_spread=float(np.std(list(lower.drivers.values()))),
        upper_spread=float(np.std(list(upper.drivers.values()))),
        lower_headway=lower.terms["headway"],
        lower_speed=lower.terms["relative_velocity"],
        lower_product=lower.terms["product"],
        upper_headway=upper.terms["headway"],
        upper_speed=upper.terms["relative_velocity"],
        upper_product=upper.terms["product"],
    )
