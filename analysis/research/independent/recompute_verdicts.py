"""Each driver beside the humans, recomputed as docs/numbers.md says.

Nothing of the project is imported. I5 (``held``) is not recomputed.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy import stats

from analysis.research.independent import recompute_statistics as statistics
from analysis.research.independent import recompute_trials as measured

# arXiv 2604.09609, human rows of Table IV (n = 962) and of Table VII.
GAP_B, GAP_SE = np.array([3.54, 0.17, -0.20, 0.06]), (0.146, 0.034, 0.166, 0.029)
GAP_N, GAP_M, GAP_SD_M = 962, 3.85, 1.82
# The mean gaps of nine pairs scatter by so much: table S6 of the supplement to pgae420.
# Random intercepts of the gap by pair, as published with table S6.
INTERCEPTS_M = (-0.49, 1.21, 1.94, -0.01, -0.35, 1.07, -1.61, -1.86, 0.09)
PAIRS, PAIR_SD_M = 9, float(np.std(INTERCEPTS_M, ddof=1))
MARGIN_M = 1.0
ENOUGH = 20  # counted trials, and half of those that ended: fewer have no verdict
KEPT = ("estimate", "ci_low", "ci_high", "n")


def rows(trials: pd.DataFrame, humans: dict, indicators, i5_p: float | None) -> dict[str, dict]:
    """The rows of a driver and prompt by measure, of its trials in the humans' conditions.

    ``humans`` are two frames of trials: ``who`` and ``recorded``, the latter None without an
    import. ``indicators`` has by name whether I1 to I4 hold by the robust rules. ``held`` is the p
    of I5, which belongs to the same family.
    """
    by_measure = {}
    for name in ("headway", "velocity"):
        column = ("headway", "velocity").index(name) + 1
        by_measure[name] = _beside(
            _first(trials, column),
            _first(humans["who"], column),
            _firsts_apart(trials, humans["who"], column),
        )
    by_measure["collisions"], collisions = _collisions(trials, humans["who"])
    for name in ("gap", "gap-headway"):
        driver, human = _gap(trials, name), human_gap(humans["recorded"], trials, name)
        apart = {}
        if driver.get("se") is not None and human.get("se") is not None:
            parts = [
                (estimate["estimate"], estimate["se"], estimate["freedom"])
                for estimate in (driver, human)
            ]
            apart = statistics.difference(*parts)
        by_measure[name] = _beside(driver, human, apart)
    moved = Moved.of(trials)
    by_measure["gap-velocity"] = _beside(
        moved.row(0.95), human_moved(humans["recorded"], trials).row(0.95), {}
    )
    if moved.differences is not None:
        by_measure["gap-velocity"]["p"] = moved.beyond_p()
    _correct([*by_measure.values(), {"p": i5_p}])
    ended = int((trials["status"] != "failed").sum())
    for name, row in by_measure.items():
        row["state"] = _state(name, row, indicators, within=moved.within())
        if row["state"] is None or row["n"] < max(ENOUGH, ended / 2):
            row["detectable"] = None
        if row["p_holm"] is None:
            continue
        level = 0.9 if name == "gap-velocity" and row["state"] == "shown" else row["level"] / 100
        row["level"] = 100 * level
        ends = ("ci_low", "ci_high")
        if name == "gap-velocity":
            row |= {end: moved.row(level)[end] for end in ends}
            continue
        if name in ("headway", "velocity"):
            apart = _firsts_apart(
                trials, humans["who"], ("headway", "velocity").index(name) + 1, level
            )
        elif name == "collisions":
            low, high = statistics.agreeing(*collisions, row["p"], level)
            apart = {"ci_low": 100 * low, "ci_high": 100 * high}
        else:
            driver, human = _gap(trials, name), human_gap(humans["recorded"], trials, name)
            parts = [
                (estimate["estimate"], estimate["se"], estimate["freedom"])
                for estimate in (driver, human)
            ]
            apart = statistics.difference(*parts, level)
        row |= {f"difference_{end}": apart[end] for end in ends}
    return by_measure


def _correct(rows: list[dict]) -> None:
    """Holm's correction over a driver's measures, and the level of each interval.

    The smallest p of m is compared with .05 / m, the next with .05 / (m - 1), and so on up to the
    first that is not below; what comes after is compared with the same as that one.
    """
    order = sorted((row for row in rows if row["p"] is not None), key=lambda r: r["p"])
    m, rejected, largest = len(order), 0, 0.0
    for place, row in enumerate(order):
        largest = max(largest, (m - place) * row["p"])
        row["p_holm"] = min(1.0, largest)
        rejected += row["p_holm"] < 0.05
    for place, row in enumerate(order):
        row["level"] = 100 * (1 - 0.05 / (m - min(place, rejected)))


def of_humans(humans: dict) -> dict[str, dict]:
    """The rows of the humans themselves, over all conditions."""
    who = humans["who"]
    by_measure = {"headway": _first(who, 1), "velocity": _first(who, 2)}
    k, n = int(who["boxes"].sum()), len(who)
    low, high = statistics.wilson(k / n, n)
    by_measure["collisions"] = {"estimate": 100 * k / n, "ci_low": 100 * low, "ci_high": 100 * high}
    by_measure["collisions"]["n"] = n
    for name in ("gap", "gap-headway"):
        by_measure[name] = human_gap(humans["recorded"], None, name)
    played = who if humans["recorded"] is None else humans["recorded"]
    by_measure["gap-velocity"] = human_moved(humans["recorded"], played).row(0.95)
    return {name: {column: row.get(column) for column in KEPT} for name, row in by_measure.items()}


def _beside(driver: dict, human: dict, apart: dict) -> dict:
    row = {name: driver.get(name) for name in ("estimate", "ci_low", "ci_high", "n")}
    row |= {
        "k": driver.get("k"),
        "undecided": driver.get("undecided"),
        "human": human.get("estimate"),
    }
    row |= {f"human_{end}": human.get(end) for end in ("ci_low", "ci_high")}
    row |= {name: apart.get(name) for name in ("difference", "p", "detectable")}
    row |= {f"difference_{end}": apart.get(end) for end in ("ci_low", "ci_high")}
    return row | {"p_holm": None, "level": None}


def _profiled(x: np.ndarray, y: np.ndarray, column: int, level: float = 0.95) -> dict:
    """A coefficient of Firth's fit with its profile interval and likelihood-ratio test."""
    fit = statistics.Firth(x, y)
    low, high = fit.interval(column, level)
    estimate = {"estimate": fit.b[column], "se": fit.se[column], "ci_low": low, "ci_high": high}
    return estimate | {"p": fit.p(column)}


def _first(trials: pd.DataFrame, column: int) -> dict:
    """The slope of who goes first on headway (1) or relative velocity (2)."""
    x, y, _ = measured.who_first_data(trials)
    if statistics.unidentified(x, y):
        return {"n": len(y)}
    return _profiled(x, y, column) | {"n": len(y)}


def _firsts_apart(
    driver: pd.DataFrame, human: pd.DataFrame, column: int, level: float = 0.95
) -> dict:
    """Compare two slopes: an interaction in one model in which every term may differ."""
    x, x_left, _ = measured.who_first_data(driver)
    y, y_left, _ = measured.who_first_data(human)
    if statistics.unidentified(x, x_left):
        return {}
    design = np.block([[x, x], [y, 0 * y]])
    interaction = _profiled(design, np.r_[x_left, y_left], 3 + column, level)
    needed = stats.norm.ppf(0.975) + stats.norm.ppf(0.8)
    return interaction | {
        "difference": interaction["estimate"],
        "detectable": needed * interaction["se"],
    }


def _collisions(driver: pd.DataFrame, human: pd.DataFrame) -> tuple[dict, tuple]:
    """The row in percent, and both rates; with undecided trials both worst cases (Manski 1989)."""
    ended = driver[driver["status"] != "failed"]
    cut_off = int(ended["boxes"].isna().sum())
    n, k = len(ended) - cut_off, int(ended["boxes"].fillna(value=False).astype(bool).sum())
    if not len(ended):
        return _beside({"n": 0}, {}, {}), ()
    low = statistics.wilson(k / len(ended), len(ended))[0]
    high = statistics.wilson((k + cut_off) / len(ended), len(ended))[1]
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
    humans = sum(int(counts["size"][cell]) for cell in weights.index)
    ends = statistics.wilson(rate, as_good_as)
    human_row = {"estimate": 100 * rate, "ci_low": 100 * ends[0], "ci_high": 100 * ends[1]}
    if cut_off:
        return _beside(row, human_row, {}), ()
    p = statistics.exact_p(
        *(frame["boxes"].astype(float) for frame in (ended, human)), (ended["cell"], human["cell"])
    )
    apart = {"difference": 100 * (k / n - rate), "p": p}
    apart["detectable"] = statistics.detectable_rate(n, humans, rate)
    return _beside(row, human_row, apart), ((k / n, n), (rate, as_good_as))


def _gap(trials: pd.DataFrame, name: str) -> dict:
    """The mean gap, or a slope with HC3 errors."""
    x, gaps, _ = measured.gap_data(trials)
    if name == "gap":
        if len(gaps) < 2:
            return {"estimate": gaps[0] if len(gaps) else None, "n": len(gaps)}
        return _by_t(gaps.mean(), gaps.std(ddof=1) / len(gaps) ** 0.5, len(gaps) - 1, len(gaps))
    fit = statistics.least_squares(x, gaps)[1]
    if fit is None:
        return {"n": len(gaps)}
    return _by_t(*fit[1, :2], len(gaps) - x.shape[1], len(gaps))


class Moved:
    """Differences of the predicted gap between played conditions that differ in velocity alone."""

    def __init__(self, b, covariance, freedom, n, conditions):
        self.n, self.freedom, self.differences = n, freedom, None
        if b is None:
            return
        rows = [
            _designed(h, dv) - _designed(h, other)
            for h, dv in conditions
            for same, other in conditions
            if h == same and dv > other
        ]
        if rows:
            rows = np.array(rows)
            self.rank = np.linalg.matrix_rank(rows)
            self.differences = np.abs(rows @ b)
            self.se = np.sqrt(np.maximum([row @ covariance @ row for row in rows], 0.0))

    @classmethod
    def of(cls, trials: pd.DataFrame) -> Moved:
        x, gaps, _ = measured.gap_data(trials)
        _, fit, covariance = statistics.least_squares(x, gaps)
        b = None if fit is None else fit[:, 0]
        conditions = {*zip(trials["h"], trials["dv"], strict=True)}
        return cls(b, covariance, len(gaps) - 4, len(gaps), conditions)

    def row(self, level: float) -> dict:
        """The largest difference: below a bound if all are, above one if any is for sure.

        The lower ends are simultaneous ones (Scheffé 1953).
        """
        if self.differences is None:
            return {"n": self.n}
        t = stats.t.ppf((1 + level) / 2, self.freedom)
        f = np.sqrt(self.rank * stats.f.ppf(level, self.rank, self.freedom))
        low, high = self.differences - f * self.se, self.differences + t * self.se
        ends = {"ci_low": max(low.max(), 0.0), "ci_high": high.max()}
        return {"estimate": self.differences.max(), "n": self.n} | ends

    def within(self) -> bool | None:
        return None if self.differences is None else self.row(0.9)["ci_high"] < MARGIN_M

    def beyond_p(self) -> float:
        """The level at which the lower end is the margin."""
        apart = zip(self.differences - MARGIN_M, self.se, strict=True)
        return min(
            (
                stats.f.sf((d / se) ** 2 / self.rank, self.rank, self.freedom) if se else 0.0
                for d, se in apart
                if d > 0
            ),
            default=1.0,
        )


def _designed(h: float, dv: float) -> np.ndarray:
    return np.array([1.0, abs(h), abs(dv), h * dv])


def _by_t(value: float, se: float, freedom: int, n: int) -> dict:
    half = stats.t.ppf(0.975, freedom) * se
    ends = {"ci_low": value - half, "ci_high": value + half}
    return {"estimate": value, "se": se, "freedom": freedom, "n": n} | ends


def human_gap(recorded: pd.DataFrame | None, driven: pd.DataFrame | None, name: str) -> dict:
    """The humans' gap beside a driver, or over all: with errors by pairs, or as published."""
    if recorded is None:
        if name == "gap-headway":
            return _by_t(GAP_B[1], GAP_SE[1], GAP_N - 4, GAP_N)
        moved = np.zeros(4)
        design = measured.gap_data(driven)[0] if driven is not None else ()
        if len(design):
            moved = design.mean(axis=0) - _human_design().mean(axis=0)
        se = np.sqrt(PAIR_SD_M**2 / PAIRS + moved @ _human_covariance() @ moved)
        return _by_t(GAP_M + moved @ GAP_B, se, PAIRS - 1, GAP_N)
    x, gaps, used = measured.gap_data(recorded)
    if name == "gap":
        finished = used if driven is None else measured.gap_data(driven)[2]
        weights = (used if finished.empty else finished)["cell"].value_counts()
        used = used[used["cell"].isin(weights.index)]
        return _by_t(*statistics.mean_by_pairs(used, "gap", weights), len(used))
    pair = used["pair"].to_numpy()
    fit = statistics.by_pairs(statistics.ordinary, x, gaps, pair)
    return _by_t(*fit[1, :2], len(np.unique(pair)) - 1, len(gaps))


def human_moved(recorded: pd.DataFrame | None, driven: pd.DataFrame) -> Moved:
    """Return the humans' differences in the conditions of a driver."""
    conditions = {*zip(driven["h"], driven["dv"], strict=True)}
    if recorded is None:
        return Moved(GAP_B, _human_covariance(), GAP_N - 4, GAP_N, conditions)
    x, gaps, used = measured.gap_data(recorded)
    pair = used["pair"].to_numpy()

    def b(rows):
        return np.linalg.lstsq(x[rows], gaps[rows], rcond=None)[0]

    whole, names = b(slice(None)), np.unique(pair)
    apart = np.array([b(pair != name) - whole for name in names])
    covariance = apart.T @ apart * (len(names) - 1) / len(names)
    return Moved(whole, covariance, len(names) - 1, len(gaps), conditions)


def _human_design() -> np.ndarray:
    """The published human trials that finished."""
    return measured.gap_design(measured.published_humans().query("status == 'finished'"))


def _human_covariance() -> np.ndarray:
    """Return the covariance that the published residual standard deviation implies."""
    x = _human_design()
    return GAP_SD_M**2 * np.linalg.inv(x.T @ x)


def _state(name: str, row: dict, indicators, *, within: bool | None) -> str | None:
    """The verdict; None where a measure is not judged.

    A difference is one whose p, corrected over the measures of the driver, is below .05.
    """
    if row["p"] is None:
        return "inconclusive" if row["undecided"] else None
    differs = row["p_holm"] < 0.05
    if name == "gap-velocity":
        return "shown" if within else "unlike" if differs else "inconclusive"
    tests = {"headway": "I1", "velocity": "I2", "gap-headway": "I3"}
    if name not in tests or not indicators[tests[name]]:
        return "unlike" if differs else "inconclusive"
    if not differs:
        return "shown"
    return "weaker" if abs(row["estimate"]) < abs(row["human"]) else "stronger"
