"""How often a perfect copy of the humans is called different from them, by each test.

``python -m tests.analysis.stats.copies_of_humans`` prints the table of docs/reference/analysis.md.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from functools import cache

import numpy as np
import pandas as pd
from scipy.special import expit, logit

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.data.human_counts import human_counts
from merge_runner_analysis.stats.against_humans import contrast_by_pairs
from merge_runner_analysis.stats.contrasts import contrast_means
from merge_runner_analysis.stats.regressions import (
    Regression,
    by_pairs,
    differences,
    gap_ols,
    who_first_logit,
)

SEED = 260409609
COPIES = 500
PAIRS = 9
HUMAN_REPS, REPS = 10, 10  # trials of a pair, and of the copy, in each condition
HEADWAY, VELOCITY = np.array(
    [(c.projected_headway_m, c.relative_velocity_mps) for c in HUMAN_CONDITIONS.values()]
).T
COLLIDED = np.array([of.collided / of.trials for of in human_counts().values()])
JOINT = 0.53
# Between pairs: SD of logits and of the gap in m, as published (S4, S6); within: SD in m.
LOGIT_SD, GAP_SD_M, NOISE_M = 0.5, 1.3, 1.3
RMSE_SD_MPS = 0.2
Test = Callable[[pd.DataFrame, pd.DataFrame], dict[str, float]]
RATES = ("collided", "joint")
MEASURES = (*RATES, "gap_m", "rmse_mps")
# How far the pairs differ: as published, and not at all.
WORLDS = {"nine pairs": 1.0, "pooled": 0.0}


def driven(rng: np.random.Generator, reps: int, *, differ: float, pairs: int) -> pd.DataFrame:
    """Trials of ``pairs`` who ``differ`` from each other; 0 pairs: each trial is of a new one."""
    cells = np.tile(np.arange(len(COLLIDED)), reps * max(pairs, 1))
    pair = np.repeat(np.arange(pairs), len(COLLIDED) * reps) if pairs else np.arange(len(cells))
    crash, joint, bold, close, strong = differ * rng.normal(size=(5, int(pair[-1]) + 1))[:, pair]
    h, v = HEADWAY[cells], VELOCITY[cells]
    collided = rng.random(len(cells)) < expit(logit(COLLIDED[cells]) + LOGIT_SD * crash)
    left = rng.random(len(cells)) < expit(-0.3 + LOGIT_SD * bold + 1.11 * h - 3.3 * v)
    # Where pairs do not differ, single trials vary as much as all of them do elsewhere.
    noise, rmse_noise = np.hypot(
        ((NOISE_M,), (RMSE_SD_MPS,)), (1 - differ) * np.array(((GAP_SD_M,), (RMSE_SD_MPS,)))
    ) * rng.normal(size=(2, len(cells)))
    gap = 4.1 + GAP_SD_M * close + 0.15 * abs(h) - 0.18 * abs(v) + 0.06 * h * v + noise
    trials = pd.DataFrame(
        {
            "condition": np.array(list(HUMAN_CONDITIONS))[cells],
            "pair": np.char.add("pair", pair.astype(str)) if pairs else None,
            "projected_headway_m": h,
            "relative_velocity_mps": v,
            "status": np.where(collided, "collided", "finished"),
            "collided": collided,
            "merged_first": np.where(left, "left", "right"),
            "joint": (rng.random(len(cells)) < expit(logit(JOINT) + LOGIT_SD * joint)).astype(
                float
            ),
            "gap_m": gap,
            "rmse_mps": 0.66 + RMSE_SD_MPS * strong + 0.05 * abs(v) + rmse_noise,
        }
    )
    trials.loc[collided, ["joint", "gap_m", "rmse_mps"]] = np.nan
    trials.loc[collided, "merged_first"] = None
    return trials


def samples(differ: float, copies: int) -> Iterator[tuple[pd.DataFrame, pd.DataFrame]]:
    """Humans and a copy of them, each drawn anew."""
    rng = np.random.default_rng(SEED)
    for _ in range(copies):
        yield (
            driven(rng, HUMAN_REPS, differ=differ, pairs=PAIRS),
            driven(rng, REPS, differ=differ, pairs=0),
        )


def contrasted(human: pd.DataFrame, copy: pd.DataFrame) -> dict[str, float]:
    """The p of each measure of ``contrasts``, clustered by pair."""
    found = {name: contrast_by_pairs(copy, human, name, rate=name in RATES) for name in MEASURES}
    return {name: one.p for name, one in found.items() if not isinstance(one, str)}


def differing(human: pd.DataFrame, copy: pd.DataFrame) -> dict[str, float]:
    """The p of each term of ``differences``."""
    who_first = _tested(who_first_logit(copy), by_pairs(who_first_logit, human, "merged_first"))
    gap = _tested(gap_ols(copy, robust=True), by_pairs(gap_ols, human, "gap_m"))
    return {f"left first: {name}": p for name, p in who_first.items()} | {
        f"gap: {name}": p for name, p in gap.items()
    }


def _tested(copy: Regression, human: Regression) -> dict[str, float]:
    """By term; none where a fit is separated: such a copy is not called different."""
    return {name: one.p for name, one in differences(copy, human, "").items()}


def independent(human: pd.DataFrame, copy: pd.DataFrame) -> dict[str, float]:
    """The p of a contrast of the gap that takes all trials as independent."""
    return {"gap_m": contrast_means(copy, human, "gap_m").p}


def called_different(test: Test, world: str, copies: int = COPIES) -> dict[str, float]:
    """The share of copies in percent for which a p is below .05, by test."""
    found = [test(*both) for both in samples(WORLDS[world], copies)]
    names = max(found, key=len)
    return {name: 100 * float(np.mean([p.get(name, 1.0) < 0.05 for p in found])) for name in names}


@cache
def shares(world: str) -> dict[str, float]:
    """That of all that the program tests by pairs."""
    return called_different(lambda *both: contrasted(*both) | differing(*both), world)


def shares_table() -> str:
    """A row a test, a column a world."""
    found = [shares(world) for world in WORLDS]
    rows = [[name, *(f"{by[name]:.1f}" for by in found)] for name in found[0]]
    head = [["called different (%)", *WORLDS], ["---"] * (1 + len(WORLDS))]
    return "\n".join(f"| {' | '.join(row)} |" for row in [*head, *rows])


if __name__ == "__main__":
    sys.stdout.write(f"{shares_table()}\n")
