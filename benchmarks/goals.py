"""Goals for the figures: ratios of cases that were measured in one run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from statistics import median

Samples = Mapping[str, list[dict[str, float]]]


@dataclass(frozen=True, slots=True)
class Goal:
    """A figure with its bound; ``of`` computes it from the medians."""

    what: str
    bound: float
    of: Callable[[Medians], float]
    at_most: bool = True
    unit: str = ""

    def met(self, value: float) -> bool:
        """Return whether the figure keeps its bound."""
        return value <= self.bound if self.at_most else value >= self.bound


@dataclass(frozen=True, slots=True)
class Medians:
    """The medians over the rounds of every figure of every case."""

    samples: Samples

    def __call__(self, case: str, figure: str) -> float:
        """A median; raises KeyError for what was not measured."""
        return median(sample[figure] for sample in self.samples[case])

    def cpu_per_call(self, case: str) -> float:
        """CPU time in s for each call of the case, its start included."""
        return self(case, "cpu_s") / self(case, "calls")

    def ratio(self, figure: str, case: str, floor: str) -> float:
        """The median over the rounds of a figure's ratio: what disturbs both is left out."""
        return median(
            ours[figure] / theirs[figure]
            for ours, theirs in zip(self.samples[case], self.samples[floor], strict=True)
        )


def judged(samples: Samples) -> Iterator[tuple[Goal, float]]:
    """Every goal that was measured, with its figure."""
    medians = Medians(samples)
    for goal in GOALS:
        try:
            yield goal, goal.of(medians)
        except KeyError:
            continue


def _of_large_cache(medians: Medians, what: str) -> float:
    large, small = f"{what} of 11, 88,000 replies", f"{what} of 11, 88 replies"
    return medians.ratio("wall_s", large, small)


# The longest trials of the workload decide 11 times, and wait for the server each time. Before, the
# first decision of a model is waited for, until it is valid.
LATENCY_S = 12 * 0.2

GOALS = (
    Goal(
        "cold sweep: CPU per call, of the floor's",
        1.5,
        lambda m: m.cpu_per_call("cold, 0 ms") / m.cpu_per_call("floor, 0 ms"),
        unit="x",
    ),
    Goal(
        "cold sweep: CPU for each further call, of the floor's",
        1.3,
        lambda m: m.cpu_per_call("cold, further calls") / m.cpu_per_call("floor, further calls"),
        unit="x",
    ),
    Goal(
        "1,000 in flight: CPU per call, of that with 50",
        1.3,
        lambda m: m.cpu_per_call("1,000 in flight, 1 s") / m.cpu_per_call("50 in flight"),
        unit="x",
    ),
    Goal(
        "cold sweep at 200 ms: wall, of latency alone and the start",
        1.25,
        lambda m: m("cold, 200 ms", "wall_s") / (LATENCY_S + m("sweep --dry-run", "wall_s")),
        unit="x",
    ),
    Goal(
        "1,000 in flight at 1 s: throughput, of the bare client's",
        1.1,
        lambda m: (
            (m("1,000 in flight, 1 s", "calls") / m("1,000 in flight, 1 s", "wall_s"))
            / (
                m("floor, 1,000 in flight, 1 s", "calls")
                / m("floor, 1,000 in flight, 1 s", "wall_s")
            )
        ),
        at_most=False,
        unit="x",
    ),
    Goal(
        "replay of one trial: CPU, of Python with duckdb, httpx and pydantic",
        2.6,
        lambda m: m.ratio("cpu_s", "replay of 1", "floor, imports"),
        unit="x",
    ),
    Goal(
        "replay of 110 trials: wall, of the floor's",
        2.6,
        lambda m: m.ratio("wall_s", "replay", "floor, cached"),
        unit="x",
    ),
    Goal(
        "inspect-ai: its CPU cold, of ours",
        12.0,
        lambda m: m("inspect-ai, 0 ms", "cpu_s") / m("cold, 0 ms", "cpu_s"),
        at_most=False,
        unit="x",
    ),
    Goal(
        "inspect-ai: its cached run, of our replay",
        11.0,
        lambda m: m("inspect-ai, cached", "wall_s") / m("replay", "wall_s"),
        at_most=False,
        unit="x",
    ),
    Goal(
        "answered calls asked again after kill -9",
        0,
        lambda m: m("killed at half, resumed", "asked_again"),
    ),
    Goal(
        "11,000 trials replayed: wall for each decision, of the cached floor's for a call",
        0.9,
        lambda m: (
            m("replay of 11,000", "wall_s")
            / m("replay of 11,000", "calls")
            / (m("floor, cached", "wall_s") / m("floor, cached", "calls"))
        ),
        unit="x",
    ),
    Goal(
        "11,000 trials replayed: peak memory",
        300,
        lambda m: m("replay of 11,000", "peak_mb"),
        unit="MB",
    ),
    *(
        Goal(
            f"{what} of 11 trials on 88,000 replies: wall, of that on 88",
            1.3,
            partial(_of_large_cache, what=what),
            unit="x",
        )
        for what in ("sweep", "replay")
    ),
    Goal(
        "2,000 in flight: worst stall of the event loop",
        0.1,
        lambda m: m("2,000 in flight", "stall_s"),
        unit="s",
    ),
    Goal(
        "limiter: achieved, of the limit",
        0.98,
        lambda m: m("limiter and store", "limiter_achieved"),
        at_most=False,
        unit="x",
    ),
    Goal(
        "limiter: worst sliding window, of the limit",
        1.02,
        lambda m: m("limiter and store", "limiter_worst_window"),
        unit="x",
    ),
    Goal(
        "limiter: waiters served out of order",
        0,
        lambda m: m("limiter and store", "limiter_displaced"),
    ),
    Goal(
        "limiter: share of a core with 2,000 waiters",
        0.06,
        lambda m: m("limiter and store", "limiter_cpu_share"),
        unit="x",
    ),
    Goal(
        "store: time per row, of the Appender's",
        3.0,
        lambda m: m("limiter and store", "store_ratio"),
        unit="x",
    ),
    Goal(
        "longest wait of a reader while a sweep writes",
        0.1,
        lambda m: m("2,000 in flight", "reader_wait_s"),
        unit="s",
    ),
    Goal(
        "tables of 3,300 trials, cold: wall, relative to 110 trials",
        2.0,
        lambda m: m("tables of 3,300, cold", "wall_s") / m("tables of 110, cold", "wall_s"),
        unit="x",
    ),
    Goal(
        "tables of 11,000 trials, cold: peak memory",
        400,
        lambda m: m("tables of 11,000, cold", "peak_mb"),
        unit="MB",
    ),
    Goal(
        "tables of 11,000 trials, warm",
        0.6,
        lambda m: m("tables of 11,000, warm", "wall_s"),
        unit="s",
    ),
    Goal(
        "tables of 110 trials, cold: wall, of Python with pandas, scipy and statsmodels",
        3.0,
        lambda m: m("tables of 110, cold", "wall_s") / m("floor, libraries", "wall_s"),
        unit="x",
    ),
    Goal(
        "report of 110 trials whose tables are finished: wall, of cold tables",
        1.2,
        lambda m: m("report of 110, cold", "wall_s") / m("tables of 110, cold", "wall_s"),
        unit="x",
    ),
    Goal(
        "report of 110 trials whose tables are finished",
        5.0,
        lambda m: m("report of 110, cold", "wall_s"),
        unit="s",
    ),
    Goal(
        "report of 11,000 trials, warm",
        10.0,
        lambda m: m("report of 11,000, warm", "wall_s"),
        unit="s",
    ),
    Goal(
        "explorer of 11,000 trials: the list, of its floor",
        10.0,
        lambda m: m("explorer of 11,000", "list_ms") / m("floor, explorer of 11,000", "list_ms"),
        unit="x",
    ),
    Goal(
        "explorer of 11,000 trials: the list, filtered and sorted",
        100,
        lambda m: m("explorer of 11,000", "filtered_ms"),
        unit="ms",
    ),
    Goal(
        "explorer of 11,000 trials: a trial with a decision",
        150,
        lambda m: m("explorer of 11,000", "trial_ms"),
        unit="ms",
    ),
    Goal(
        "first page of 2,200 trials whose tables are finished: complete after a cold start",
        1.5,
        lambda m: m("first page of 2,200", "complete_s"),
        unit="s",
    ),
    Goal(
        "first page of 11,000 trials whose tables are finished: complete after a cold start",
        5.0,
        lambda m: m("first page of 11,000", "complete_s"),
        unit="s",
    ),
    Goal(
        "first page of 11,000 trials that nothing is computed of: first bytes",
        1.0,
        lambda m: m("first page of 11,000", "first_bytes_s"),
        unit="s",
    ),
    Goal(
        "export of 660 trials whose tables are finished",
        25.0,
        lambda m: m("export of 660", "wall_s"),
        unit="s",
    ),
    Goal(
        "soak: answered calls asked again",
        0,
        lambda m: m("soak of 10,000", "answered_asked_again"),
    ),
    Goal(
        "soak: attempts made twice",
        0,
        lambda m: m("soak of 10,000", "attempts_made_twice"),
    ),
    Goal(
        "soak: billed beyond the ledger",
        0,
        lambda m: m("soak of 10,000", "beyond_ledger_usd"),
        unit="USD",
    ),
    Goal("--help", 0.08, lambda m: m("--help", "wall_s"), unit="s"),
)
