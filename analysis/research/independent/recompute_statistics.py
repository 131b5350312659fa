"""The tests and intervals that docs/numbers.md names, from their definitions.

Nothing of the project is imported.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
import statsmodels.api as sm
from scipy import optimize, special, stats

Z = stats.norm.ppf(0.975)


def separated(x: np.ndarray, y: np.ndarray) -> bool:
    """Return whether a hyperplane separates the successes, by a linear program (Konis 2007)."""
    signed = x * (2 * y - 1)[:, None]
    solution = optimize.linprog(
        -signed.sum(axis=0), A_ub=-signed, b_ub=np.zeros(len(y)), bounds=[(-1, 1)] * x.shape[1]
    )
    return -solution.fun > 1e-7


def logit(x: np.ndarray, y: np.ndarray) -> np.ndarray | None:
    """Maximum likelihood: a row (b, se, z, p) a term; None without a finite estimate."""
    if unidentified(x, y) or separated(x, y):
        return None
    fit = sm.GLM(y, x, family=sm.families.Binomial()).fit(tol=1e-12, maxiter=200)
    z = fit.params / fit.bse
    return np.column_stack([fit.params, fit.bse, z, 2 * stats.norm.sf(np.abs(z))])


def unidentified(x: np.ndarray, y: np.ndarray) -> bool:
    """Return whether trials are too few, in too few conditions, or all of one outcome."""
    few = len(y) <= x.shape[1] or np.linalg.matrix_rank(x) < x.shape[1]
    return few or len(np.unique(y)) < 2


class Firth:
    """Firth's penalised likelihood (1993), by Newton's steps, halved where they go too far."""

    def __init__(self, x: np.ndarray, y: np.ndarray):
        # Equal rows together: ``n`` trials, of which ``y`` are successes.
        self.x, row = np.unique(x, axis=0, return_inverse=True)
        self.n, self.y = np.bincount(row), np.bincount(row, y)
        self.b, self.se = np.zeros(x.shape[1]), np.zeros(x.shape[1])
        self.b = self.fitted()
        self.se = np.sqrt(np.diag(np.linalg.inv(self.parts(self.b)[1])))

    def parts(self, b):
        p = special.expit(self.x @ b)
        return p, self.x.T @ (self.x * (self.n * p * (1 - p))[:, None])

    def likelihood(self, b) -> float:
        eta = self.x @ b
        _, information = self.parts(b)
        fit = self.y @ eta - self.n @ np.logaddexp(0, eta)
        return fit + np.linalg.slogdet(information)[1] / 2

    def fitted(self, column: int | None = None, value: float = 0.0) -> np.ndarray:
        """Coefficients of the largest likelihood, one of them held at a value.

        A restricted fit keeps the penalty of the whole design (Heinze and Schemper 2002). Far out
        it may have several maxima, and a saddle where data are symmetric: it is begun anew at both
        sides of the whole fit.
        """
        maxima = []
        for side in (-1, 0, 1) if self.se.any() else (0,):
            start = self.b + side * self.se
            if column is not None:
                start[column] = value
            maxima.append(self._climbed(start, column))
        return max(maxima, key=self.likelihood)

    def _climbed(self, b: np.ndarray, column: int | None) -> np.ndarray:
        x, y, n = self.x, self.y, self.n
        free = np.setdiff1d(np.arange(x.shape[1]), [column])
        for _ in range(1000):
            p, information = self.parts(b)
            w = n * p * (1 - p)
            leverage = w * np.einsum("ij,ij->i", x @ np.linalg.inv(information), x)
            score = (x.T @ (y - n * p + leverage * (0.5 - p)))[free]
            step = np.zeros_like(b)
            step[free] = np.linalg.solve(information[np.ix_(free, free)], score)
            while self.likelihood(b + step) < self.likelihood(b) - 1e-12:
                step /= 2
            b = b + step
            if np.abs(step).max() < 1e-9:
                break
        return b

    def lost(self, column: int, value: float) -> float:
        """Twice the log-likelihood that is lost where a coefficient has this value."""
        best, restricted = (self.likelihood(b) for b in (self.b, self.fitted(column, value)))
        return max(0.0, 2 * (best - restricted))

    def p(self, column: int) -> float:
        """By the likelihood ratio."""
        return stats.chi2.sf(self.lost(column, 0.0), 1)

    def interval(self, column: int, level: float = 0.95) -> list[float]:
        """The values that a likelihood-ratio test does not reject."""
        level = stats.chi2.ppf(level, 1)
        b, ends = self.b[column], []
        for sign in (-1, 1):
            far = sign * 2 * self.se[column]
            while self.lost(column, b + far) < level:
                far *= 1.5
            end = optimize.brentq(lambda at: self.lost(column, at) - level, b, b + far)
            ends.append(end)
        return ends


def firth(x: np.ndarray, y: np.ndarray) -> np.ndarray | None:
    """Firth's fit: a row (b, se, p) a term, p of penalised likelihood ratios."""
    if unidentified(x, y):
        return None
    fit = Firth(x, y)
    return np.column_stack([fit.b, fit.se, [fit.p(k) for k in range(x.shape[1])]])


def least_squares(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray | None, ...]:
    """Rows (b, se, t, p) of the usual errors and of HC3's, whose covariance comes third.

    None where there are no such.
    """
    freedom = len(y) - x.shape[1]
    if freedom < 1 or np.linalg.matrix_rank(x) < x.shape[1] or np.ptp(y) < 0.01:
        return None, None, None
    bread = np.linalg.inv(x.T @ x)
    b = bread @ x.T @ y
    rest = y - x @ b
    hat = np.einsum("ij,jk,ik->i", x, bread, x)
    plain = bread * (rest @ rest) / freedom
    results = [wald(b, np.sqrt(np.diag(plain)), freedom), None, None]
    if hat.max() < 1 - 1e-9:
        meat = x.T @ (x * ((rest / (1 - hat)) ** 2)[:, None])
        results[2] = bread @ meat @ bread
        results[1] = wald(b, np.sqrt(np.diag(results[2])), freedom)
    return tuple(results)


def ordinary(x: np.ndarray, y: np.ndarray) -> np.ndarray | None:
    """Rows (b, se, t, p) of the usual errors."""
    return least_squares(x, y)[0]


def equivalence_p(b: np.ndarray, covariance: np.ndarray, rows: np.ndarray, freedom: int) -> float:
    """The largest p, over differences ``rows`` of two designs, against one of 1 m or more.

    Each is tested by two one-sided t tests (Schuirmann 1987); one without an error is sure.
    """
    p = []
    for row in rows:
        inside, se = 1 - abs(row @ b), np.sqrt(max(row @ covariance @ row, 0.0))
        p.append(stats.t.sf(inside / se, freedom) if se else float(inside <= 0))
    return max(p)


def joint_p(b: np.ndarray, covariance: np.ndarray, freedom: int) -> float | None:
    """The F test that all of these coefficients are 0; None where their errors are one."""
    if np.linalg.matrix_rank(covariance) < len(b):
        return None
    return stats.f.sf(b @ np.linalg.solve(covariance, b) / len(b), len(b), freedom)


def wald(b, se, freedom=np.inf) -> np.ndarray:
    return np.column_stack([b, se, b / se, 2 * stats.t.sf(np.abs(b / se), freedom)])


def by_pairs(fit, x: np.ndarray, y: np.ndarray, pair: np.ndarray) -> np.ndarray | None:
    """Coefficients of humans with the errors of a jackknife over their pairs (CV3): (b, se)."""
    parts = [fit(x[pair != name], y[pair != name]) for name in np.unique(pair)]
    whole = fit(x, y)
    if whole is None or any(part is None for part in parts):
        return None
    moved = sum((part[:, 0] - whole[:, 0]) ** 2 for part in parts)
    return np.column_stack([whole[:, 0], np.sqrt(moved * (len(parts) - 1) / len(parts))])


def difference(first: tuple, second: tuple, level: float = 0.95) -> dict:
    """Compare two estimates (b, se, freedom) by t with Satterthwaite's freedom (1946)."""
    value, se = first[0] - second[0], np.hypot(first[1], second[1])
    spread = sum(part[1] ** 4 / part[2] for part in (first, second))
    freedom = se**4 / spread if spread else np.inf
    t = stats.t(freedom)
    half = t.ppf((1 + level) / 2) * se
    return {
        "difference": value,
        "ci_low": value - half,
        "ci_high": value + half,
        "p": 2 * t.sf(abs(value) / se),
        "freedom": freedom if np.isfinite(freedom) else None,
        "detectable": (t.ppf(0.975) + t.ppf(0.8)) * se,
    }


def wilson(rate: float, n: float) -> tuple[float, float]:
    """The score interval of a rate of ``n`` trials (Wilson 1927)."""
    middle = (rate + Z**2 / (2 * n)) / (1 + Z**2 / n)
    half = Z / (1 + Z**2 / n) * np.sqrt(rate * (1 - rate) / n + Z**2 / (4 * n**2))
    return max(middle - half, 0.0), min(middle + half, 1.0)


def mean_interval(values: np.ndarray) -> tuple[float | None, float | None]:
    """Student's t interval of a mean."""
    if len(values) < 2:
        return None, None
    half = stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values))
    return values.mean() - half, values.mean() + half


def mean_by_pairs(
    trials: pd.DataFrame, column: str, weights: pd.Series
) -> tuple[float, float, int]:
    """A mean of human trials with its error and degrees of freedom: a jackknife over pairs.

    Conditions weigh as ``weights`` says.
    """

    def weighed(rows):
        means = rows.groupby("cell")[column].mean()
        return float((weights[means.index] * means).sum() / weights[means.index].sum())

    whole, names = weighed(trials), trials["pair"].unique()
    apart = [weighed(trials[trials["pair"] != name]) - whole for name in names]
    se = np.sqrt(np.square(apart).sum() * (len(names) - 1) / len(names))
    return whole, se, len(names) - 1


def by_pair_interval(trials: pd.DataFrame, column: str) -> tuple[float | None, float | None]:
    """The interval of a mean of human trials, conditions weighing alike."""
    if trials["pair"].nunique() < 2:
        return None, None
    value, se, freedom = mean_by_pairs(trials, column, trials["cell"].value_counts())
    half = stats.t.ppf(0.975, freedom) * se
    return value - half, value + half


def median_interval(values: np.ndarray) -> tuple[float | None, float | None]:
    """The order statistics that enclose a median with 95 %."""
    k = max(k for k in range(len(values)) if stats.binom.cdf(k - 1, len(values), 0.5) <= 0.025)
    ordered = np.sort(values)
    return (ordered[k - 1], ordered[len(values) - k]) if k else (None, None)


def rates_within(first: pd.Series, second: pd.Series, cells: tuple[pd.Series, pd.Series]) -> dict:
    """Two rates in the cells that both have: Mantel and Haenszel, Miettinen and Nurminen.

    Empty where there is no such cell.
    """
    a, n, b, m = _counts(first, second, cells)
    if not len(a):
        return {}
    w = n * m / (n + m)
    apart = (w @ (a / n - b / m)) / w.sum()
    every, hits = n + m, a + b
    chance = (n * m * hits * (every - hits) / (every**2 * (every - 1.0))).sum()
    p = 2 * stats.norm.sf(abs((a - n * hits / every).sum()) / np.sqrt(chance)) if chance else 1.0

    def error(at: float) -> float:
        at_level, at_reference = _given_difference(a, n, b, m, at)
        of_cells = at_level * (1 - at_level) / n + at_reference * (1 - at_reference) / m
        return np.sqrt((w**2 * of_cells * every / (every - 1)).sum()) / w.sum()

    ends = []
    for sign in (-1, 1):
        # From the far end on: the first difference that the test does not reject.
        steps = np.concatenate([np.linspace(sign, apart, 400)[:-1], [apart + sign * 1e-9]])
        missing = [sign * (at - apart) - 1.959963984540054 * error(at) for at in steps]
        at = next((k for k, value in enumerate(missing) if value <= 0), len(steps) - 1)
        ends.append(
            steps[0]
            if at == 0
            else optimize.brentq(
                lambda d, sign=sign: sign * (d - apart) - 1.959963984540054 * error(d),
                *sorted(steps[at - 1 : at + 1]),
                xtol=1e-13,
            )
        )
    enough = stats.norm.ppf(0.975) + stats.norm.ppf(0.8)
    sizes = [
        optimize.brentq(lambda size, sign=sign: enough * error(sign * size) - size, 1e-9, 1)
        for sign in (-1, 1)
    ]
    surest = w.sum() / np.sqrt((n**2 * m**2 / (every**2 * (every - 1.0))).sum())
    return {
        "difference": 100 * apart,
        "ci_low": 100 * ends[0],
        "ci_high": 100 * ends[1],
        "p": p,
        "detectable": 100 * min(sizes) if surest > 1.959963984540054 else None,
    }


def _given_difference(a, n, b, m, apart: float) -> tuple[np.ndarray, np.ndarray]:
    """The likeliest rates of each cell that are so far apart, by bisection."""
    low = np.full(len(a), max(0.0, -apart))
    high = np.full(len(a), min(1.0, 1.0 - apart))
    for _ in range(60):
        q = (low + high) / 2
        p = q + apart
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = (
                np.where(a > 0, a / p, 0) - np.where(a < n, (n - a) / (1 - p), 0)
                + np.where(b > 0, b / q, 0) - np.where(b < m, (m - b) / (1 - q), 0)
            )  # fmt: skip
        low, high = np.where(slope > 0, q, low), np.where(slope > 0, high, q)
    return np.clip((low + high) / 2 + apart, 0, 1), (low + high) / 2


def _counts(at_level: pd.Series, at_reference: pd.Series, cells: tuple) -> list[np.ndarray]:
    """Successes and trials of the one, and of the other, in each cell that both have."""
    first, second = (
        v.astype(float).groupby(c).agg(["sum", "size"])
        for v, c in zip((at_level, at_reference), cells, strict=True)
    )
    both = first.join(second, how="inner", suffixes=("1", "2"))
    return [both[name].to_numpy(int) for name in ("sum1", "size1", "sum2", "size2")]


def exact_p(first: pd.Series, second: pd.Series, cells: tuple[pd.Series, pd.Series]) -> float:
    """Fisher's exact test within the cells that both have, two-sided by probability."""
    a, n, b, m = _counts(first, second, cells)
    # The distribution of the successes of the first, all margins of all cells given.
    chances, least = np.ones(1), 0
    for k in range(len(a)):
        total = a[k] + b[k]
        hits = np.arange(max(0, total - m[k]), min(n[k], total) + 1)
        chances = np.convolve(chances, stats.hypergeom(n[k] + m[k], total, n[k]).pmf(hits))
        least += hits[0]
    return min(1.0, chances[chances <= chances[a.sum() - least] * (1 + 1e-7)].sum())


def agreeing(first: tuple, second: tuple, p: float, level: float = 0.95) -> tuple[float, float]:
    """The interval of one rate less another, (rate, trials) each, that excludes 0 by this p.

    Each end leaves out (1 - level) / 2 of the melded chances of Fay, Proschan and Brittain (2015):
    of the lowest belief of one rate less the highest of the other. Where that would contradict p,
    the end beside 0 leaves out its own share of p.
    """
    alpha = 1 - level
    sides = [_melded(first, second, 0.0), _melded(second, first, 0.0)]
    parts = [alpha / 2, alpha / 2]
    near = int(sides[1] < sides[0])
    by_half, by_p = sides[near] < alpha / 2, p < alpha
    share = min(alpha * sides[near] / max(p, 1e-300), (1 + sides[near]) / 2)
    if by_p != by_half or (share > alpha / 2) == by_p:
        parts[near] = share
    ends = []
    for part, pair in zip(parts, ((first, second), (second, first)), strict=True):
        if _melded(*pair, -1.0) >= part:
            ends.append(-1.0)
        else:
            ends.append(
                optimize.brentq(lambda at, p=pair, q=part: _melded(*p, at) - q, -1, 1, xtol=1e-12)
            )
    return ends[0], -ends[1]


def _melded(first: tuple, second: tuple, at: float) -> float:
    """The chance that the lowest belief of one rate exceeds the highest of the other by so much."""
    k, n = first[0] * first[1], first[1]
    missed, m = second[1] * (1 - second[0]), second[1]
    highest = stats.beta(m - missed + 1, missed) if missed > 1e-9 else None
    if k < 1e-9:
        return 1.0 if highest is None else highest.sf(-at)
    lowest = stats.beta(k, n - k + 1)
    if highest is None:
        return lowest.cdf(1 + at)
    # By parts of equal chance of the other, each with Simpson's rule.
    u = np.linspace(0.0, 1.0, 20001)
    y = lowest.cdf(highest.ppf(u) + at)
    return float((y[0] + y[-1] + 4 * y[1:-1:2].sum() + 2 * y[2:-1:2].sum()) / 3 / 20000)


def detectable_rate(n: int, m: int, rate: float) -> float | None:
    """The smallest difference from ``rate`` that Fisher's test finds with a power of 0.8."""
    rejects = np.zeros((n + 1, m + 1))
    for total in range(n + m + 1):
        hits = np.arange(max(0, total - m), min(n, total) + 1)
        chance = stats.hypergeom(n + m, total, n).pmf(hits)
        p = [chance[chance <= limit * (1 + 1e-7)].sum() for limit in chance]
        rejects[hits, total - hits] = np.array(p) < 0.05
    by_first = rejects @ stats.binom.pmf(np.arange(m + 1), m, rate)

    def lacking(other):
        return stats.binom.pmf(np.arange(n + 1), n, other) @ by_first - 0.8

    ends = [end for end in (0.0, 1.0) if lacking(end) >= 0]
    return min((100 * abs(optimize.brentq(lacking, rate, e) - rate) for e in ends), default=None)


def means_within(first: pd.Series, second: pd.Series, cells: tuple[pd.Series, pd.Series]) -> dict:
    """Two means by least squares with a level for each cell that both have, by Welch's test.

    Errors are HC2's, degrees of freedom those of Bell and McCaffrey (2002) for two variances. Empty
    where no cell has both, or a single trial is all that decides.
    """
    shared = set(cells[0]) & set(cells[1])
    if not shared:
        return {}
    kept = [v[c.isin(shared).to_numpy()] for v, c in zip((first, second), cells, strict=True)]
    y = np.concatenate([v.to_numpy(float) for v in kept])
    group = np.repeat([1.0, 0.0], [len(v) for v in kept])
    cell = pd.factorize(pd.concat([c[c.isin(shared)] for c in cells]))[0]
    x = np.column_stack([group, cell[:, None] == np.unique(cell)]).astype(float)
    projection = np.linalg.inv(x.T @ x) @ x.T
    b = projection @ y
    left = np.eye(len(y)) - x @ projection
    if np.diag(left).min() < 1e-9:
        return {}
    squared = (left @ y) ** 2 / np.diag(left)
    se = np.sqrt(projection[0] ** 2 @ squared)
    freedom = len(y) - x.shape[1]
    if se > 1e-12:
        variance = np.where(group == 1, squared[group == 1].mean(), squared[group == 0].mean())
        form = (projection[0] ** 2 / np.diag(left))[:, None] * ((left * variance) @ left)
        freedom = np.trace(form) ** 2 / (form * form.T).sum()
    if se <= 1e-12 and abs(b[0]) < 1e-12:
        return {"difference": 0.0}
    t = stats.t(freedom)
    return {
        "difference": b[0],
        "ci_low": b[0] - t.ppf(0.975) * se,
        "ci_high": b[0] + t.ppf(0.975) * se,
        "p": 1.0 if abs(b[0]) < 1e-12 else 2 * t.sf(abs(b[0]) / se if se else np.inf),
        "detectable": (t.ppf(0.975) + t.ppf(0.8)) * se,
    }


def holm(p: list[float]) -> np.ndarray:
    """A family's p by Holm (1979)."""
    p, m = np.array(p), len(p)
    order, corrected = np.argsort(p, kind="stable"), np.empty(len(p))
    corrected[order] = np.minimum(np.maximum.accumulate(p[order] * (m - np.arange(m))), 1)
    return corrected
