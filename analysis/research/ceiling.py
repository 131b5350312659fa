"""Compute the human ceiling, ``human_ceiling.csv`` of the analysis: about ten minutes.

``python -m analysis.research.ceiling`` writes it anew, with equal seeds an equal file.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.published import (
    DATA,
    HUMAN_GAP_SD_M,
    human_outcomes,
    published,
)
from merge_runner_analysis.stats.indicators import judge
from merge_runner_analysis.stats.regressions import (
    gap_design,
    gap_ols,
    who_first_firth,
    who_first_logit,
)

SEED = 260409609
DATA_SETS = 1000
SIZES = (*range(1, 13), 15, 20, 25, 30, 40, 50, 70, 90, 100, 150, 200)
TOGETHER = "I1-I4"


def data_sets(n: int) -> Iterator[pd.DataFrame]:
    """Yield human data sets of ``n`` trials per condition, drawn with replacement.

    Outcomes are those published, gaps the published regression with normal residuals.
    """
    rng = np.random.default_rng(SEED)
    b = published("paper_gap").query("driver == 'human'")["b"].to_numpy(float)
    outcomes, columns = human_outcomes(), []
    for name in HUMAN_CONDITIONS:
        humans = outcomes[outcomes["condition"] == name]
        h, dv = (humans[c].to_numpy(float)[:1] for c in list(humans)[1:3])
        drawn = humans.iloc[rng.integers(0, len(humans), (DATA_SETS, n)).ravel()]
        noise = HUMAN_GAP_SD_M * rng.standard_normal((DATA_SETS, n)).ravel()
        gap_m = (gap_design(h, dv) @ b)[0] + noise
        columns.append(drawn.assign(gap_m=gap_m, data_set=np.arange(DATA_SETS).repeat(n)))
    for _, trials in pd.concat(columns).groupby("data_set"):
        yield trials


def shares(n: int, first: int = DATA_SETS) -> dict[tuple[str, str], float]:
    """Return the share of the ``first`` data sets that pass, by indicator and rule."""
    passed: dict[tuple[str, str], int] = {}
    for _, trials in zip(range(first), data_sets(n), strict=False):
        rules = {
            "paper": judge(who_first_logit(trials), gap_ols(trials), robust=False),
            "robust": judge(who_first_firth(trials), gap_ols(trials, robust=True), robust=True),
        }
        for rule, judged in rules.items():
            passes = {name: verdict.passed is True for name, verdict in judged.items()}
            for name, is_passed in (passes | {TOGETHER: all(passes.values())}).items():
                passed[name, rule] = passed.get((name, rule), 0) + is_passed
    return {key: count / first for key, count in passed.items()}


def main() -> None:
    """Write the file."""
    rows = [(n, *key, f"{share:g}") for n in SIZES for key, share in shares(n).items()]
    curve = pd.DataFrame(rows, columns=["n", "indicator", "rule", "share"])
    curve.to_csv(DATA / "human_ceiling.csv", index=False)


if __name__ == "__main__":
    main()
