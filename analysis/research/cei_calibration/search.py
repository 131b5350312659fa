"""The search for thresholds: seeded, so that it finds the same again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from analysis.research.cei_calibration.design import TRIALS_OF_A_PAIR, design, model_of
from analysis.research.cei_calibration.outcomes import measured, summary
from analysis.research.cei_calibration.simulation import simulate
from merge_runner.config import ScenarioConfig
from merge_runner.drivers.cei.parameters import RISKS, ThresholdSet
from merge_runner_analysis.published import published

# How far the first candidates are from the start: one standard deviation of each number.
STEPS = ThresholdSet(
    *(0.05, 0.05, 0.03, 0.03),
    *(0.01, 0.03, 0.01, 0.01, 0.03, 0.01),
)
BEST_SHARE = 1 / 3
# Spreads shrink by at most this factor in a generation: a lucky one does not end the search.
SLOWEST = 0.7
# Trials of a generation have a sample set of their own, from here on: those that a set is judged by
# are others.
FIRST_SAMPLE_SET = 1000
# What a number counts that no fit could give, in tolerances.
MISSING = 10.0

Numbers = Mapping[tuple[str, str], float]


@dataclass(frozen=True, slots=True)
class Target:
    """A published number; a miss by ``tolerance`` costs 1. ``std_error`` is None if not known."""

    measure: str
    term: str
    value: float
    std_error: float | None
    tolerance: float
    origin: str


@dataclass(frozen=True, slots=True)
class Generation:
    """A step of the search: where it stands, and the cost of its best candidate."""

    number: int
    thresholds: ThresholdSet
    cost: float


def targets() -> list[Target]:
    """Return the published numbers of the model, and those of the humans' first action."""
    return [
        Target(
            row.measure,
            row.term,
            row.value,
            float(row.std_error) if row.std_error else None,
            row.tolerance,
            row.origin,
        )
        for row in published("cei_targets").itertuples()
    ]


def numbers_of(
    thresholds: ThresholdSet,
    scenario: ScenarioConfig,
    sample_set: int,
    trials_of_a_pair: int = TRIALS_OF_A_PAIR,
    *,
    tunnel: bool = False,
) -> Numbers:
    """Return the numbers of the targets for a sample set; counts are scaled to 990."""
    trials = design(thresholds, scenario, sample_set, trials_of_a_pair)
    model = model_of(thresholds, scenario)
    numbers = summary(measured(model.task, trials, simulate(model, trials, tunnel=tunnel)))
    scale = {"count": TRIALS_OF_A_PAIR / trials_of_a_pair}
    return {key: value * scale.get(key[1], 1.0) for key, value in numbers.items()}


def compared(sets: Sequence[Numbers]) -> pd.DataFrame:
    """One row a target: its value, the mean and the spread of what was found, the miss.

    The miss is in the tolerances of the search.
    """
    rows = []
    for target in targets():
        key = (target.measure, target.term)
        values = [numbers[key] for numbers in sets if key in numbers]
        mean = float(np.mean(values)) if values else None
        rows.append(
            {
                "measure": target.measure,
                "term": target.term,
                "published": target.value,
                "std_error": target.std_error,
                "found": mean,
                "spread": float(np.std(values, ddof=1)) if len(values) > 1 else None,
                "tolerance": target.tolerance,
                "off": None if mean is None else (mean - target.value) / target.tolerance,
            }
        )
    return pd.DataFrame(rows).astype({"std_error": float, "spread": float})


def cost(numbers: Numbers, expected: list[Target]) -> float:
    """Return the sum of squared misses, in tolerances."""
    return sum(
        ((numbers[key] - target.value) / target.tolerance) ** 2
        if (key := (target.measure, target.term)) in numbers
        else MISSING**2
        for target in expected
    )


def search(
    start: ThresholdSet,
    scenario: ScenarioConfig,
    expected: list[Target],
    *,
    generations: int,
    size: int,
    seed: int,
    trials_of_a_pair: int = TRIALS_OF_A_PAIR,
) -> Iterator[Generation]:
    """Search by the cross-entropy method (Rubinstein 1999) with independent normal candidates.

    All candidates of a generation play the same trials; the best third makes the next one.
    """
    random = np.random.default_rng(seed)
    mean, spread = np.array(start), np.array(STEPS)
    for number in range(generations):
        candidates = mean + spread * random.standard_normal((size, mean.size))
        candidates[0] = mean
        risks = candidates[:, : len(RISKS)]
        risks.clip(0, 1, out=risks)
        costs = [
            cost(
                numbers_of(
                    ThresholdSet(*candidate), scenario, FIRST_SAMPLE_SET + number, trials_of_a_pair
                ),
                expected,
            )
            for candidate in candidates
        ]
        best = candidates[np.argsort(costs)[: max(2, round(size * BEST_SHARE))]]
        mean = best.mean(axis=0)
        spread = np.maximum(best.std(axis=0), SLOWEST * spread)
        yield Generation(number + 1, ThresholdSet(*mean.round(4)), min(costs))
