"""What two drivers do first in each of many trials, and what is known of the humans' first actions.

A first action is the net acceleration of a vehicle over the first step that its driver controls.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from analysis.data.reference_data import published
from merge_runner.records import SIDES

Array = NDArray[np.float64]

# One row a vehicle, its side as the ego sees it, which is on the left everywhere. The first second
# ends within a step, in which the acceleration is constant. Where each driver takes control at its
# own exit the other one cruises yet: that is no first action.
FIRST_ACTIONS = """
SELECT trial_id, spec_hash, if(side = ego, 'left', 'right') AS side,
    arg_min(acceleration_mps2, step) FILTER (time_s > 0) AS first_mps2,
    arg_min(velocity_mps - acceleration_mps2 * (time_s - 1), step) FILTER (time_s > 1 - 1e-9)
        - arg_min(velocity_mps, step) AS first_second_mps2
FROM states JOIN trial_drivers USING (trial_id, spec_hash)
ANTI JOIN (FROM specs WHERE spec->>'$.scenario.control_start' = 'own_exit') USING (spec_hash)
WHERE time_s >= 0 GROUP BY ALL ORDER BY ALL
"""
# The imported ones: one row a vehicle, without the trial's pair.
HUMAN_FIRST_ACTIONS = "FROM human_first_actions ORDER BY trial, side"
FULL_THROTTLE_MPS2 = 1.5
"""Net, at 10 m/s under the drag of the human experiment."""
# Shares of slow and go begin here: a human pedal seldom holds a speed exactly.
HOLD_MPS2 = 0.2


@dataclass(frozen=True, eq=False)
class Acts:
    """First actions, in m/s², of ``n`` trials.

    ``relative_velocity`` (n,) is that of the trial, left minus right, in m/s. ``first`` and
    ``second`` (n, 2) are of the left and the right vehicle: the first action, and the mean over the
    first second, NaN where it is not known. ``unit`` (n,) numbers what is independent: trials, or
    the pairs of humans. ``sides`` are the columns that count: both, or that of one driver.
    """

    relative_velocity: Array
    first: Array
    second: Array
    unit: NDArray[np.int_]
    sides: tuple[int, ...] = (0, 1)

    @cached_property
    def own(self) -> Array:
        """The own relative velocity of each counted vehicle, (n, sides)."""
        return (self.relative_velocity[:, None] * [1.0, -1.0])[:, list(self.sides)] + 0.0

    @cached_property
    def velocities(self) -> tuple[float, ...]:
        """The own relative velocities that there are, slowest first."""
        return tuple(float(v) for v in np.unique(self.own.round(6) + 0.0))

    def at(self, velocity: float) -> NDArray[np.bool_]:
        """Which of the counted vehicles have this own relative velocity, (n, sides)."""
        return np.abs(self.own - velocity) < 1e-6

    def within(self, velocities: tuple[float, ...]) -> Acts:
        """The trials whose relative velocity is among these, or its opposite is."""
        kept = np.isin(np.abs(self.relative_velocity).round(6), np.abs(velocities))
        return replace(
            self,
            relative_velocity=self.relative_velocity[kept],
            first=self.first[kept],
            second=self.second[kept],
            unit=self.unit[kept],
        )


def acts_of(rows: pd.DataFrame, unit: str, sides: tuple[int, ...] = (0, 1)) -> Acts:
    """From rows of vehicles: trial, side, relative_velocity_mps, both actions, and the unit."""
    wide = rows.pivot_table(
        index="trial", columns="side", values=["first_mps2", "first_second_mps2"], dropna=False
    ).reindex(columns=pd.MultiIndex.from_product([["first_mps2", "first_second_mps2"], SIDES]))
    wide = wide[wide["first_mps2"].notna().all(axis=1)]
    of_trial = rows.drop_duplicates("trial").set_index("trial").loc[wide.index]
    return Acts(
        of_trial["relative_velocity_mps"].to_numpy(float),
        wide["first_mps2"].to_numpy(float),
        wide["first_second_mps2"].to_numpy(float),
        pd.factorize(of_trial[unit])[0] if unit in of_trial else np.arange(len(wide)),
        sides,
    )


@dataclass(frozen=True, slots=True)
class HumanClass:
    """The published first actions of humans of one own relative velocity, in m/s².

    Shares are parts of 1. ``knots`` are probabilities and quantiles, from 0 to 1: between them the
    distribution is linear.
    """

    n: int
    mean: float
    se: float
    sd: float
    slow: float
    hold: float
    go: float
    knots: tuple[Array, Array]


def published_classes() -> Mapping[float, HumanClass]:
    """The shipped aggregates by own relative velocity in m/s."""
    return {
        row.relative_velocity_mps: HumanClass(
            n=row.n,
            mean=row.mean_mps2,
            se=row.se_mps2,
            sd=row.sd_mps2,
            slow=row.slow_percent / 100,
            hold=row.hold_percent / 100,
            go=row.go_percent / 100,
            knots=_knots(row._asdict()),
        )
        for row in published("human_first_actions").itertuples(index=False)
    }


def _knots(row: Mapping[str, float]) -> tuple[Array, Array]:
    """The published quantiles and shares as one line of pieces.

    It ends at full throttle, and begins where its mean is the published one.
    """
    points = [(int(name[1:3]) / 100, row[name]) for name in row if name.startswith("q")]
    points += [(row["slow_percent"] / 100, -HOLD_MPS2), (1 - row["go_percent"] / 100, HOLD_MPS2)]
    at, value = np.array([*sorted(points), (1.0, FULL_THROTTLE_MPS2)]).T
    above = float(((value[1:] + value[:-1]) / 2 * np.diff(at)).sum())
    lowest = 2 * (row["mean_mps2"] - above) / at[0] - value[0]
    return np.array([0.0, *at]), np.array([lowest, *value])
