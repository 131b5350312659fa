"""Each driver beside the humans, recomputed as docs/reference/analysis.md says.

Nothing of the project is imported. I5 (``held``) is not recomputed.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy import optimize, stats

from tests.independent import recompute_statistics as statistics
from tests.independent import recompute_trials as measured

# arXiv 2604.09609, human rows of Table IV (n = 962) and of Table VII.
GAP_SLOPES = {"gap-headway": (0.17, 0.034), "gap-velocity": (-0.20, 0.166)}
GAP_N, GAP_M = 962, 3.85
# The mean gaps of nine pairs scatter by so much: table S6 of the supplement to pgae420.
# Random intercepts of the gap by pair, as published with table S6.
INTERCEPTS_M = (-0.49, 1.21, 1.94, -0.01, -0.35, 1.07, -1.61, -1.86, 0.09)
PAIRS, PAIR_SD_M = 9, float(np.std(INTERCEPTS_M, ddof=1))
VELOCITY_MPS = 0.8  # of the gap's slope on relative velocity
MARGIN_M = 1.0
KEPT = ("estimate", "ci_low", "ci_high", "n")


def rows(trials: pd.DataFrame, humans: dict, indicators) -> dict[str, dict]:
    """The rows of a driver and prompt by measure, of its trials in the humans' conditions.

    ``humans`` are two frames of trials: ``who`` and ``recorded``, the latter None without an
    import. ``indicators`` has by name whether I1 to I4 hold by the robust rules.
    """
    found = {}
    for name in ("headway", "velocity"):
        column = ("headway", "velocity").index(name) + 1
        found[name] = _beside(
            _first(trials, column),
            _first(humans["who"], column),
            _firsts_apart(trials, humans["who"], column),
        )
    found["collisions"] = _collisions(trials, humans["who"])
    for name in ("gap", "gap-headway", "gap-velocity"):
        own, other = _gap(trials, name), human_gap(humans["recorded"], trials, name)
        apart = {}
        if own.get("se") is not None and other.get("se") is not None:
            parts = [(each["estimate"], each["se"], each["freedom"]) for each in (own, other)]
            apart = statistics.difference(*parts)
        found[name] = _beside(own, other, apart)
    tested = [row for row in found.values() if row["p"] is not None]
    corrected = statistics.holm([row["p"] for row in tested]) if tested else ()
    for row, p in zip(tested, corrected, strict=True):
        row["p_holm"] = p
    for name, row in found.items():
        row["state"] = _state(name, row, indicators)
    return found


def of_humans(humans: dict) -> dict[str, dict]:
    """The rows of the humans themselves, over all conditions."""
    who = humans["who"]
    found = {"headway": _first(who, 1), "velocity": _first(who, 2)}
    k, n = int(who["boxes"].sum()), len(who)
    low, high = statistics.wilson(k / n, n)
    found["collisions"] = {"estimate": 100 * k / n, "ci_low": 100 * low, "ci_high": 100 * high}
    found["collisions"]["n"] = n
    for name in ("gap", "gap-headway", "gap-velocity"):
        found[name] = human_gap(humans["recorded"], who, name)
    return {name: {column: row.get(column) for column in KEPT} for name, row in found.items()}


def _beside(own: dict, other: dict, apart: dict) -> dict:
    row = {name: own.get(name) for name in ("estimate", "ci_low", "ci_high", "n")}
    row |= {"k": own.get("k"), "undecided": own.get("undecided"), "human": other.get("estimate")}
    row |= {f"human_{end}": other.get(end) for end in ("ci_low", "ci_high")}
    row |= {name: apart.get(name) for name in ("difference", "p", "detectable")}
    row |= {f"difference_{end}": apart.get(end) for end in ("ci_low", "ci_high")}
    return row | {"p_holm": None}


def _first_data(trials: pd.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    used = trials[(trials["status"] == "finished") & trials["first"].notna()]
    x = np.column_stack([np.ones(len(used)), used[["h", "dv"]].to_numpy(float)])
    return x, (used["first"] == "left").to_numpy(float)


def _profiled(x: np.ndarray, y: np.ndarray, column: int) -> dict:
    """A coefficient of Firth's fit with its profile interval and likelihood-ratio test."""
    fit = statistics.Firth(x, y)
    low, high = fit.interval(column)
    found = {"estimate": fit.b[column], "se": fit.se[column], "ci_low": low, "ci_high": high}
    return found | {"p": fit.p(column)}


def _first(trials: pd.DataFrame, column: int) -> dict:
    """The slope of who goes first on headway (1) or relative velocity (2)."""
    x, y = _first_data(trials)
    if statistics.unidentified(x, y):
        return {"n": len(y)}
    return _profiled(x, y, column) | {"n": len(y)}


def _firsts_apart(own: pd.DataFrame, other: pd.DataFrame, column: int) -> dict:
    """How two slopes differ: an interaction in one model in which every term may differ."""
    (x, x_left), (y, y_left) = _first_data(own), _first_data(other)
    if statistics.unidentified(x, x_left):
        return {}
    design = np.block([[x, x], [y, 0 * y]])
    found = _profiled(design, np.r_[x_left, y_left], 3 + column)
    needed = stats.norm.ppf(0.975) + stats.norm.ppf(0.8)
    return found | {"difference": found["estimate"], "detectable": needed * found["se"]}


def _collisions(own: pd.DataFrame, human: pd.DataFrame) -> dict:
    """Rates in percent; with undecided trials both worst cases (Manski 1989)."""
    ended = own[own["status"] != "failed"]
    n, k = len(ended), int(ended["boxes"].fillna(value=False).astype(bool).sum())
    cut_off = int(ended["boxes"].isna().sum())
    if not n:
        return _beside({"n": 0}, {}, {})
    cases = [((k + more) / n, n) for more in (0, cut_off)]
    low, high = statistics.wilson(*cases[0])[0], statistics.wilson(*cases[1])[1]
    row = {
        "estimate": None if cut_off else 100 * k / n,
        "n": n,
        "k": k,
        "undecided": cut_off or None,
    }
    row |= {"ci_low": 100 * low, "ci_high": 100 * high}
    # The humans in the conditions of the driver, which weigh as they do there.
    weights = ended["cell"].value_counts(normalize=True)
    counts = human["boxes"].astype(float).groupby(human["cell"]).agg(["mean", "size"])
    rate = float(sum(w * counts["mean"][cell] for cell, w in weights.items()))
    as_good_as = 1 / sum(w**2 / counts["size"][cell] for cell, w in weights.items())
    there = sum(int(counts["size"][cell]) for cell in weights.index)
    ends = statistics.wilson(rate, as_good_as)
    other = {"estimate": 100 * rate, "ci_low": 100 * ends[0], "ci_high": 100 * ends[1]}
    apart = [_rates_apart(one, (rate, as_good_as)) for one in cases]
    value = min((one["difference"] for one in apart), key=abs)
    found = {"difference": value, "p": max(one["p"] for one in apart)}
    found |= {"ci_low": apart[0]["ci_low"], "ci_high": apart[1]["ci_high"]}
    found["detectable"] = statistics.detectable_rate(n, there, rate)
    return _beside(row, other, found)


def _rates_apart(one: tuple[float, float], other: tuple[float, float]) -> dict:
    """Newcombe's interval (1998) in percent, and the level at which it leaves 0 out."""
    value = one[0] - other[0]

    def ends(z: float) -> tuple[float, float]:
        (low, high), (other_low, other_high) = (_score(*each, z) for each in (one, other))
        below = np.hypot(one[0] - low, other_high - other[0])
        return value - below, value + np.hypot(high - one[0], other[0] - other_low)

    def nearest(z: float) -> float:
        return ends(z)[0] if value > 0 else -ends(z)[1]

    z = 0.0
    if value:
        z = 30.0 if nearest(30.0) > 0 else optimize.brentq(nearest, 0.0, 30.0)
    low, high = ends(statistics.Z)
    p = 2 * stats.norm.sf(z)
    return {"difference": 100 * value, "ci_low": 100 * low, "ci_high": 100 * high, "p": p}


def _score(rate: float, n: float, z: float) -> tuple[float, float]:
    """Wilson's interval as the roots of (rate - x)² n = z² x (1 - x)."""
    if not z:
        return rate, rate
    low, high = sorted(np.roots([n + z**2, -(2 * n * rate + z**2), n * rate**2]).real)
    return max(low, 0.0), min(high, 1.0)


def _gap(trials: pd.DataFrame, name: str) -> dict:
    """The mean gap, or a slope with HC3 errors."""
    used = trials[(trials["status"] == "finished") & trials["gap"].notna()]
    gaps = used["gap"].to_numpy(float)
    if name == "gap":
        if len(gaps) < 2:
            return {"estimate": gaps[0] if len(gaps) else None, "n": len(gaps)}
        return _by_t(gaps.mean(), gaps.std(ddof=1) / len(gaps) ** 0.5, len(gaps) - 1, len(gaps))
    x = _gap_design(used)
    fit = statistics.least_squares(x, gaps)[1]
    if fit is None:
        return {"n": len(gaps)}
    return _gap_slope(fit, name, len(gaps) - x.shape[1], len(gaps))


def _gap_design(trials: pd.DataFrame) -> np.ndarray:
    h, dv = trials["h"].to_numpy(float), trials["dv"].to_numpy(float)
    return np.column_stack([np.ones(len(h)), np.abs(h), np.abs(dv), h * dv])


def _gap_slope(fit: np.ndarray, name: str, freedom: int, n: int) -> dict:
    column, factor = (1, 1.0) if name == "gap-headway" else (2, VELOCITY_MPS)
    return _by_t(factor * fit[column, 0], factor * fit[column, 1], freedom, n)


def _by_t(value: float, se: float, freedom: int, n: int) -> dict:
    half = stats.t.ppf(0.975, freedom) * se
    ends = {"ci_low": value - half, "ci_high": value + half}
    return {"estimate": value, "se": se, "freedom": freedom, "n": n} | ends


def human_gap(recorded: pd.DataFrame | None, driven: pd.DataFrame, name: str) -> dict:
    """The humans' gap beside a driver: over the means of pairs, or as published."""
    if recorded is not None:
        used = recorded[(recorded["status"] == "finished") & recorded["gap"].notna()]
        if name == "gap":
            used = used[used["cell"].isin(driven["cell"])]
            means = used.groupby("pair")["gap"].mean()
            return _by_t(means.mean(), means.sem(), len(means) - 1, len(used))
        gaps, pair = used["gap"].to_numpy(float), used["pair"].to_numpy()

        def plain(x, y):
            return statistics.least_squares(x, y)[0]

        fit = statistics.by_pairs(plain, _gap_design(used), gaps, pair)
        return _gap_slope(fit, name, len(np.unique(pair)) - 1, len(gaps))
    if name == "gap":
        if set(measured.OUTCOMES) - set(driven["cell"]):
            return {"n": GAP_N}  # what is published is the mean of all conditions
        return _by_t(GAP_M, PAIR_SD_M / PAIRS**0.5, PAIRS - 1, GAP_N)
    factor = VELOCITY_MPS if name == "gap-velocity" else 1.0
    value, se = GAP_SLOPES[name]
    return _by_t(factor * value, factor * se, GAP_N - 4, GAP_N)


def _state(name: str, row: dict, indicators) -> str | None:
    """The verdict; None where a measure is not judged."""
    tests = {"headway": "I1", "velocity": "I2", "gap-headway": "I3", "gap-velocity": "I4"}
    if row["ci_low"] is None or (row["estimate"] is None and not row["undecided"]):
        return None
    holds = indicators.get(tests[name]) if name in tests else False
    if name == "gap-velocity":
        beyond = max(row["ci_low"], -row["ci_high"]) > MARGIN_M
        return "shown" if holds else "unlike" if beyond else "inconclusive"
    if row["difference_ci_low"] is None or row["human"] is None or holds is None:
        return None
    differs = not row["difference_ci_low"] <= 0 <= row["difference_ci_high"]
    if not holds:
        return "unlike" if differs else "inconclusive"
    if not differs:
        return "shown"
    return "weaker" if abs(row["estimate"]) < abs(row["human"]) else "stronger"
