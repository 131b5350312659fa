"""Published values that ship with the project; ``data/sources.csv`` cites each file."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pandas as pd

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.data.human_counts import human_counts

DATA = Path(__file__).parent
# Standard deviation in m of the human gaps about their regression: what the four standard errors of
# arXiv 2604.09609 (Table IV, human rows, n = 962) imply.
HUMAN_GAP_SD_M = 1.82
HUMAN_TRIALS = 990
# The experiments whose pairs the publications number 1 to 9.
PAIRS = {
    experiment: f"pair{number}"
    for number, experiment in enumerate((4, 5, 6, 8, 9, 10, 11, 12, 13), start=1)
}
HUMAN_DOI = "10.4121/19550377"


@cache
def published(name: str) -> pd.DataFrame:
    """One shipped file, by its name without ``.csv``; texts stay texts, gaps become NaN."""
    return pd.read_csv(DATA / f"{name}.csv", keep_default_na=False, na_values={})


def printed_value(value: str | float) -> str | float:
    """A printed number; a bound of p such as ``<0.001`` stays text."""
    return float(value) if isinstance(value, str) and not value.startswith("<") else value


@cache
def citation(name: str) -> str:
    """Where the values of a shipped file come from."""
    sources = pd.read_csv(DATA / "sources.csv", index_col="file")
    return str(sources.loc[f"{name}.csv", "citation"])


def human_gap_pair_sd_m() -> float:
    """Standard deviation in m of the mean gap between the nine human pairs.

    It is that of their published random intercepts, which are shrunken: rather too small.
    """
    return float(published("human_gap_intercepts")["intercept_m"].std())


def human_outcomes() -> pd.DataFrame:
    """The 990 human trials as far as they are published.

    Columns as in ``trials``: condition, projected_headway_m, relative_velocity_mps, status,
    merged_first. ``collided_boxes``: the experiment's collisions are boxes that overlap.
    """
    rows = []
    for name, counts in human_counts().items():
        condition = HUMAN_CONDITIONS[name]
        outcomes = (
            [("finished", "left")] * counts.left_first
            + [("finished", "right")] * counts.right_first
            + [("collided", None)] * counts.collided
        )
        rows += [
            (
                name,
                condition.projected_headway_m,
                condition.relative_velocity_mps,
                *outcome,
            )
            for outcome in outcomes
        ]
    names = ["condition", "projected_headway_m", "relative_velocity_mps", "status", "merged_first"]
    trials = pd.DataFrame(rows, columns=names)
    return trials.assign(collided_boxes=trials["status"] == "collided")
