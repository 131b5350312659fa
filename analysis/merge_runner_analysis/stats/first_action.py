"""First actions: their slope on the own relative velocity, and the exchange rate of headway.

A first action is a vehicle's net acceleration over its first controlled step. Errors are clustered
by trial or human pair.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from math import sqrt
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy import special

from merge_runner.records import SIDES
from merge_runner_analysis.cache import remembered
from merge_runner_analysis.drivers import has_chance
from merge_runner_analysis.frames import KEYS
from merge_runner_analysis.grouping import Group, of_trials
from merge_runner_analysis.published import human_outcomes
from merge_runner_analysis.queries import QUERIES
from merge_runner_analysis.stats.estimate import Array, Estimate
from merge_runner_analysis.stats.intervals import LEVEL, estimate
from merge_runner_analysis.stats.regressions import (
    CONDITION,
    unfit_for_logit,
    who_first_data,
)
from merge_runner_analysis.study import StudyResults

# A human pedal seldom holds a speed exactly: within this a driver holds, beyond it goes or brakes.
HOLD_MPS2 = 0.2
KINDS: dict[str, Callable[[pd.Series], pd.Series]] = {
    "brake": lambda mps2: mps2 < -HOLD_MPS2,
    "hold": lambda mps2: mps2.abs() <= HOLD_MPS2,
    "go": lambda mps2: mps2 > HOLD_MPS2,
}
# First actions are equal but for the last digits, as of a vehicle that drove on the other side.
SAME_MPS2 = 1e-9


class GroupDriver(NamedTuple):
    """A driver of a group: in a mixed pair the one on a ``side`` (the ego is left), else both."""

    group: Group
    side: str = ""

    @property
    def name(self) -> str:
        """The group's label, or the name of one driver of a mixed pair."""
        group, side = self
        if not side:
            return group.label
        remark = group.remark if group.trials[f"{side}_scripted"].any() else group.caution
        driver = f"{group.models[SIDES.index(side)]} of {group.driver}"
        return f"{driver} ({remark})" if remark else driver


def drivers_of(group: Group) -> list[GroupDriver]:
    """Return the drivers of a group."""
    return (
        [GroupDriver(group)]
        if len(group.models) == 1
        else [GroupDriver(group, side) for side in SIDES]
    )


@remembered
def first_actions(study: StudyResults, driver: GroupDriver) -> pd.DataFrame:
    """Return a driver's first actions in trials that ended, one row each.

    Headway and velocity are the driver's own, minus the other's; ``cluster`` numbers trials or
    pairs.
    """
    rows = _stored(study, driver)
    if repeats_itself(study, driver):
        rows = rows.drop_duplicates(["condition", "side"])
    sign = rows["side"].map({"left": 1.0, "right": -1.0})
    cluster = rows["pair"].where(rows["pair"].notna(), rows["trial_id"] + rows["spec_hash"])
    return rows.assign(
        headway_m=sign * rows["projected_headway_m"] + 0.0,
        velocity_mps=sign * rows["relative_velocity_mps"] + 0.0,
        cluster=pd.factorize(cluster)[0],
    )


def repeats_itself(study: StudyResults, driver: GroupDriver) -> bool:
    """Return whether one driver of a mixed pair is deterministic and repeats its first actions."""
    rows = _stored(study, driver)
    sides = np.where(rows["ego"] == driver.side, *SIDES)
    known = set(zip(rows["spec_hash"], sides, strict=True))
    if not driver.side or any(
        has_chance(study.frames.specs.get(name, {}), [side]) for name, side in known
    ):
        return False
    ways = rows.groupby("condition")["first_mps2"]
    return bool((ways.size() > 1).any() and (ways.max() - ways.min() < SAME_MPS2).all())


@remembered
def _stored(study: StudyResults, driver: GroupDriver) -> pd.DataFrame:
    trials = driver.group.ended[[*KEYS, *CONDITION, "condition", "pair", "ego"]]
    rows = of_trials(study.read(QUERIES["first_actions"]), trials).merge(trials, on=KEYS)
    return rows[rows["side"] == driver.side] if driver.side else rows


def slope(rows: pd.DataFrame) -> Estimate | None:
    """Return the slope of the first action on the own relative velocity, in m/s² per m/s.

    None where the rows do not determine it or its error.
    """
    from statsmodels.regression.linear_model import OLS

    clusters = rows["cluster"].nunique()
    design = np.column_stack([np.ones(len(rows)), rows["velocity_mps"]])
    if clusters < 3 or np.linalg.matrix_rank(design) < 2:
        return None
    fit = OLS(rows["first_mps2"].to_numpy(float), design).fit(
        cov_type="cluster", cov_kwds={"groups": rows["cluster"].to_numpy()}, use_t=True
    )
    return estimate(float(fit.params[-1]), float(fit.bse[-1]), clusters - 1, len(rows))


def mean(rows: pd.DataFrame) -> Estimate | None:
    """Return the mean first action in m/s²; None where all are of one cluster."""
    actions, clusters = rows["first_mps2"].to_numpy(float), rows["cluster"].nunique()
    if clusters < 2:
        return None
    whole = float(actions.mean())
    # The clustered error of a regression on a constant (Liang and Zeger 1986), as statsmodels has.
    residuals = np.bincount(rows["cluster"], actions - whole)
    se = sqrt(clusters / (clusters - 1) * float(residuals @ residuals)) / len(rows)
    return estimate(whole, se, clusters - 1, len(rows))


def exchange_rate(rows: pd.DataFrame) -> Estimate | None:
    """Return the metres of headway that are worth 1 m/s in a logit of answering M."""
    spoken = rows[rows["tactical"].notna()]
    points = spoken[["headway_m", "velocity_mps"]].to_numpy(float)
    return _ratio(points, spoken["tactical"] == "M", spoken["cluster"])


@cache
def human_exchange_rate() -> Estimate | None:
    """Return the exchange rate of published humans, by who merged first: 3.304 / 1.111."""
    design, left = who_first_data(human_outcomes())
    return _ratio(design[:, 1:], left, np.arange(len(left)))


def _ratio(points: Array, chosen: ArrayLike, cluster: ArrayLike) -> Estimate | None:
    from statsmodels.discrete.discrete_model import Logit

    design, chosen = np.column_stack([np.ones(len(points)), points]), np.asarray(chosen, float)
    if unfit_for_logit(design, chosen):
        return None
    groups = np.asarray(cluster)
    fit = Logit(chosen, design).fit(disp=0, cov_type="cluster", cov_kwds={"groups": groups})
    _, headway, velocity = map(float, fit.params)
    rate, freedom = -velocity / headway, len(np.unique(groups)) - 1
    ends = fieller(headway, velocity, np.asarray(fit.cov_params())[1:, 1:], freedom)
    low, high = ends or (None, None)
    return Estimate(rate, low, high, len(points), freedom=freedom)


def fieller(
    headway: float, velocity: float, covariance: Array, freedom: float
) -> tuple[float, float] | None:
    """Return the interval of minus velocity / headway, two slopes with this covariance.

    By Fieller (1954); None if the slope on headway may be 0, as then no ratio is too large.
    """
    t = float(special.stdtrit(freedom, (1 + LEVEL) / 2)) ** 2
    squared = headway**2 - t * float(covariance[0, 0])
    if squared <= 0:
        return None
    middle = velocity * headway - t * float(covariance[0, 1])
    rest = velocity**2 - t * float(covariance[1, 1])
    half = sqrt(max(middle**2 - squared * rest, 0.0))
    return (-middle - half) / squared, (-middle + half) / squared
