"""First actions with planted slopes."""

import numpy as np
import pandas as pd
from scipy.special import expit

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS

SLOPE, SPREAD = -0.34, 0.63
HEADWAY, VELOCITY = 1.11, -3.30
# The correlation of two humans' first actions in a trial is about 0.3.
TOGETHER = 0.3


def drawn(rng, trials=198):
    """First actions with a planted slope and words with a planted rate, of both drivers."""
    conditions = list(HUMAN_CONDITIONS.values())
    headway = np.resize([one.projected_headway_m for one in conditions], trials)
    velocity = np.resize([one.relative_velocity_mps for one in conditions], trials)
    errors = rng.multivariate_normal([0, 0], [[1, TOGETHER], [TOGETHER, 1]], trials)
    sides = [
        pd.DataFrame(
            {
                "cluster": np.arange(trials),
                "headway_m": sign * headway,
                "velocity_mps": sign * velocity,
                "first_mps2": SLOPE * sign * velocity + SPREAD * errors[:, side],
            }
        )
        for side, sign in enumerate((1, -1))
    ]
    rows = pd.concat(sides, ignore_index=True)
    odds = HEADWAY * rows["headway_m"] + VELOCITY * rows["velocity_mps"]
    return rows.assign(tactical=np.where(rng.random(len(rows)) < expit(odds), "M", "Y"))
