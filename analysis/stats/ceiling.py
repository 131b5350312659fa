"""The noise ceiling: how often human data of a driver's size pass the indicators.

It is a shipped curve over the number of trials per condition, which ``benchmarks/ceiling.py``
computed once from the published counts, and the published regression of the gap with normal
residuals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from merge_runner_analysis.data.reference_data import published


@dataclass(frozen=True, slots=True)
class Ceiling:
    """Shares of human data sets that pass each indicator, and I1 to I4 together (``I1-I4``)."""

    paper: dict[str, float]
    robust: dict[str, float]


def ceiling(sizes: tuple[int, ...]) -> Ceiling:
    """Return the ceiling for ``sizes`` trials in the conditions of the humans.

    It is that of their mean, linear between the sizes of the curve, and constant beyond its
    largest. Without a trial in some condition there is no share.
    """
    if not min(sizes):
        return Ceiling({}, {})
    curves = published("human_ceiling").groupby(["rule", "indicator"], sort=False)
    shares: dict[str, dict[str, float]] = {"paper": {}, "robust": {}}
    for (rule, indicator), curve in curves:
        shares[rule][indicator] = float(np.interp(np.mean(sizes), curve["n"], curve["share"]))
    return Ceiling(**shares)
