"""What a study's tables ask of its trials, each as a test of many simulated data sets at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy import stats

from analysis.power.samples import Sample
from analysis.power.truths import SPEED, Truth
from analysis.stats.indicators import ALPHA, GAP_MARGIN_M, ROBUST
from analysis.stats.many_fits import Holds, firth_differences, mean_gap_differences
from analysis.stats.regressions import WHO_FIRST_TERMS

HEADWAY = WHO_FIRST_TERMS.index("projected_headway")
INTERCEPT, OF_HEADWAY = 0, 1  # of the gap


@dataclass(frozen=True, slots=True)
class Effect:
    """A number of a truth that trials can show.

    ``furthest`` is the largest that is looked for, of the sign that is looked for; a ``factor``
    turns it into the ``unit`` that is printed.
    """

    name: str
    unit: str
    of: Callable[[Truth], float]
    put: Callable[[Truth, float], Truth]
    furthest: float
    factor: float = 1.0


@dataclass(frozen=True, slots=True)
class Question:
    """Whether an effect is found in a sample, perhaps as a difference from another one.

    ``found`` says in which data sets. Where no effect is named, there is none to vary. A
    ``supposed`` difference is what is looked for between two arms of which nothing is known.
    ``of_who_first``: it depends on who merges first.
    """

    table: str
    asked: str
    found: Callable[[Sample, Sample | None], Holds]
    effect: Effect | None = None
    supposed: Callable[[Truth], Truth] | None = None
    of_who_first: bool = True

    def distinct(self, truths: Iterable[Truth]) -> list[Truth]:
        """Those of the truths that are not the same to it."""
        kept: dict[Truth, Truth] = {}
        for truth in truths:
            who_first = truth.who_first if self.of_who_first else ()
            kept.setdefault(replace(truth, name="", who_first=who_first), truth)
        return list(kept.values())


def _with_collisions(truth: Truth, share: float) -> Truth:
    return replace(truth, collided=share)


HEADWAY_CUE = Effect(
    "projected headway",
    "per m",
    lambda truth: truth.who_first[HEADWAY],
    lambda truth, value: truth.with_who_first(HEADWAY, value),
    furthest=5.0,
)
SPEED_CUE = Effect(
    "relative velocity",
    "per m/s",
    lambda truth: truth.who_first[SPEED],
    lambda truth, value: truth.with_who_first(SPEED, value),
    furthest=-8.0,
)
GAP_SLOPE = Effect(
    "|projected headway|",
    "m per m",
    lambda truth: truth.gap[OF_HEADWAY],
    lambda truth, value: truth.with_gap(OF_HEADWAY, value),
    furthest=2.0,
)
GAP = Effect(
    "gap",
    "m",
    lambda truth: truth.gap[INTERCEPT],
    lambda truth, value: truth.with_gap(INTERCEPT, value),
    furthest=5.0,
)
COLLISIONS = Effect(
    "collisions",
    "%",
    lambda truth: truth.collided,
    _with_collisions,
    furthest=0.6,
    factor=100.0,
)


def _of_who_first(name: str) -> Callable[[Sample, Sample | None], Holds]:
    return lambda sample, _: sample.firth.passes(ROBUST[name])


def _of_gap(name: str) -> Callable[[Sample, Sample | None], Holds]:
    return lambda sample, _: sample.gap.passes(ROBUST[name])


def _all_hold(sample: Sample, _: Sample | None) -> Holds:
    found = [
        (sample.firth if criterion.of_who_first else sample.gap).passes(criterion)
        for criterion in ROBUST.values()
    ]
    return np.asarray(np.logical_and.reduce(found))


def _speed_cue_differs(sample: Sample, other: Sample | None) -> Holds:
    assert other is not None
    fit = firth_differences(sample.draws, other.draws, WHO_FIRST_TERMS[SPEED])
    return fit.sound & (fit.p[:, SPEED] < ALPHA)


def _gap_differs(sample: Sample, other: Sample | None) -> Holds:
    assert other is not None
    _, p = mean_gap_differences(sample.draws, other.draws)
    return p < ALPHA


def _collisions_differ(sample: Sample, other: Sample | None) -> Holds:
    assert other is not None
    p = [
        _fisher_p(int(a), sample.trials, int(b), other.trials)
        for a, b in zip(sample.collided, other.collided, strict=True)
    ]
    return np.array(p) < ALPHA


@cache
def _fisher_p(a: int, n: int, b: int, m: int) -> float:
    return float(stats.fisher_exact([[a, n - a], [b, m - b]]).pvalue)


OF_AN_ARM = (
    Question("who-first", "projected headway (I1)", _of_who_first("I1"), HEADWAY_CUE),
    Question("who-first", "relative velocity (I2)", _of_who_first("I2"), SPEED_CUE),
    Question("gap", "|projected headway| (I3)", _of_gap("I3"), GAP_SLOPE, of_who_first=False),
    Question("gap", "effect of relative velocity small (I4)", _of_gap("I4"), of_who_first=False),
    Question("indicators", "I1 to I4 all hold", _all_hold),
)
BESIDE_HUMANS = (
    Question(
        "differences",
        "relative velocity",
        _speed_cue_differs,
        replace(SPEED_CUE, furthest=8.0),
    ),
    Question("contrasts", "collisions", _collisions_differ, COLLISIONS, of_who_first=False),
)
OF_TWO_ARMS = (
    Question(
        "contrasts",
        "gap",
        _gap_differs,
        GAP,
        lambda truth: GAP.put(truth, GAP.of(truth) + GAP_MARGIN_M),
        of_who_first=False,
    ),
    Question(
        "contrasts",
        "collisions",
        _collisions_differ,
        COLLISIONS,
        lambda truth: COLLISIONS.put(truth, 2 * COLLISIONS.of(truth)),
        of_who_first=False,
    ),
)
