"""Speeds whose control is known, and how far measures of I5 tell them apart.

``python -m analysis.research.controls`` prints what docs/numbers.md sums up.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from scipy import stats

from merge_runner_analysis.stats.held import (
    SAMPLE_S,
    at_5_hz,
    gains,
    without_resistance,
)

SECONDS = 10
CLOCK_SAMPLES = 5  # 1 s: the clock of the paper's drivers
PROFILES = 200
RATES_HZ = (5, 20)
NOISES_MPS = (0.0, 0.02, 0.03)
FINE_S = 0.05
LEVELS_MPS2 = np.array([-1.25, -0.5, 0.0, 0.5, 1.25])
HIGHEST_MPS2 = 2.5


def times(step_s: float) -> np.ndarray:
    return np.arange(round(SECONDS / step_s) + 1) * step_s


def driven(accelerations: np.ndarray, step_s: float) -> np.ndarray:
    """Speeds from 10 m/s on, each acceleration (n, steps) held for a step."""
    start = np.zeros((len(accelerations), 1))
    return 10 + np.concatenate([start, np.cumsum(accelerations, axis=1) * step_s], axis=1)


def clocked(velocity_mps: np.ndarray) -> np.ndarray:
    """Speeds at 5 Hz, (vehicles, samples), with one acceleration from each full second to the next.

    So drives whoever decides once a second and holds its acceleration, whatever it decides.
    """
    at = np.arange(velocity_mps.shape[1])
    knots = np.union1d(at[::CLOCK_SAMPLES], at[-1:])
    return np.stack([np.interp(at, knots, v[knots]) for v in velocity_mps])


def sizes(rng, n: int, low: float, high: float) -> np.ndarray:
    """Sizes of either sign, (n, 1)."""
    return rng.choice([-1.0, 1.0], (n, 1)) * rng.uniform(low, high, (n, 1))


def since(rng, n: int, step_s: float, latest_s: float = 2) -> np.ndarray:
    """The time since a beginning within the first seconds, (n, samples)."""
    return np.maximum(times(step_s) - rng.uniform(0, latest_s, (n, 1)), 0)


def levels(rng, n: int, step_s: float) -> np.ndarray:
    """Random accelerations, each held for 0.6 to 3 s, (n, steps)."""
    steps = round(SECONDS / step_s)
    accelerations, steps_left = np.zeros((n, steps)), np.zeros(n, int)
    level = np.zeros(n)
    for step in range(steps):
        level = np.where(steps_left == 0, rng.uniform(-1.5, 1.5, n), level)
        drawn = rng.integers(round(0.6 / step_s), round(3 / step_s) + 1, n)
        steps_left = np.where(steps_left == 0, drawn, steps_left) - 1
        accelerations[:, step] = level
    return accelerations


def constant_accelerations(rng, n, step_s):
    return driven(levels(rng, n, step_s), step_s)


def plan_of_few_levels(rng, n, step_s):
    """Re-planned each second: half of the plans go on, a quarter of them change within."""
    steps, second, tick = (round(s / step_s) for s in (SECONDS, 1, 0.2))
    accelerations, level = np.zeros((n, steps)), rng.choice(LEVELS_MPS2, n)
    for start in range(0, steps, second):
        first = np.where(rng.random(n) < 0.5, level, rng.choice(LEVELS_MPS2, n))
        level = np.where(rng.random(n) < 0.25, rng.choice(LEVELS_MPS2, n), first)
        change = rng.integers(1, 5, (n, 1)) * tick
        accelerations[:, start : start + second] = np.where(
            np.arange(second) < change, first[:, None], level[:, None]
        )
    return driven(accelerations, step_s)


def held_pedal(rng, n, step_s):
    """As the humans': moved within 0.2 s, against the simulator's resistance, then taken out."""
    accelerations = levels(rng, n, FINE_S)
    padded = np.concatenate([accelerations[:, :1]] * 3 + [accelerations], axis=1)
    pedal = np.lib.stride_tricks.sliding_window_view(padded, 4, axis=1).mean(axis=2)
    v = np.full((n, pedal.shape[1] + 1), 10.0)
    for step in range(pedal.shape[1]):
        slowed = 0.005 * (v[:, step] ** 2 - 10**2)  # the pedal also holds against the rest
        v[:, step + 1] = v[:, step] + FINE_S * (pedal[:, step] - slowed)
    return np.array([without_resistance(times(FINE_S), speeds) for speeds in v])[
        :, :: round(step_s / FINE_S)
    ]


def exponential(rng, n, step_s):
    decay = np.exp(-since(rng, n, step_s) / rng.uniform(0.5, 3, (n, 1)))
    return 10 + sizes(rng, n, 1, 3) * (1 - decay)


def acceleration_ramp(rng, n, step_s):
    return 10 + sizes(rng, n, 0.1, 0.3) * since(rng, n, step_s) ** 2 / 2


def minimum_jerk(rng, n, step_s):
    s = np.minimum(since(rng, n, step_s) / rng.uniform(2, 7, (n, 1)), 1)
    return 10 + sizes(rng, n, 1, 3) * (10 * s**3 - 15 * s**4 + 6 * s**5)


def logistic(rng, n, step_s):
    x = (times(step_s) - rng.uniform(2, 7, (n, 1))) / rng.uniform(0.3, 1.2, (n, 1))
    return 10 + sizes(rng, n, 1, 3) / (1 + np.exp(-x))


def half_sine(rng, n, step_s):
    s = np.minimum(since(rng, n, step_s) / rng.uniform(3, 8, (n, 1)), 1)
    return 10 + sizes(rng, n, 1, 3) * np.sin(np.pi * s)


def ornstein_uhlenbeck(rng, n, step_s):
    """An acceleration of 0.8 m/s^2 (SD) that forgets itself in 0.4 to 1.5 s."""
    kept = np.exp(-FINE_S / rng.uniform(0.4, 1.5, n))
    a = [rng.normal(0, 0.8, n)]
    for _ in range(round(SECONDS / FINE_S) - 1):
        a.append(kept * a[-1] + rng.normal(0, 0.8, n) * np.sqrt(1 - kept**2))
    return driven(np.column_stack(a), FINE_S)[:, :: round(step_s / FINE_S)]


def tracking(rng, n, step_s):
    """A PD controller that follows a smoothly moving speed."""
    frequency, phase = rng.uniform(0.4, 1.6, n), rng.uniform(0, 2 * np.pi, n)
    amplitude = rng.uniform(1, 2, n)
    gain, damping = rng.uniform(0.5, 1.5, n), rng.uniform(0, 0.3, n)
    v, before = [np.full(n, 10.0)], amplitude * np.sin(phase)
    for time in times(step_s)[:-1]:
        error = 10 + amplitude * np.sin(frequency * time + phase) - v[-1]
        a = gain * error + damping * (error - before) / step_s
        v.append(v[-1] + step_s * np.clip(a, -HIGHEST_MPS2, HIGHEST_MPS2))
        before = error
    return np.column_stack(v)


def following(rng, n, step_s):
    """The intelligent driver model (Treiber 2000) behind a leader whose speed moves smoothly."""
    desired, headway_s = rng.uniform(10, 13, n), rng.uniform(1, 1.5, n)
    a, b = rng.uniform(1, 1.5, n), rng.uniform(1.5, 2, n)
    frequency, phase = rng.uniform(0.3, 0.9, n), rng.uniform(0, 2 * np.pi, n)
    amplitude, gap = rng.uniform(0.5, 2, n), rng.uniform(8, 25, n)
    v = [np.full(n, 10.0)]
    for time in times(step_s)[:-1]:
        closing = v[-1] - 9.5 - amplitude * np.sin(frequency * time + phase)
        desired_gap = 2 + v[-1] * headway_s + v[-1] * closing / (2 * np.sqrt(a * b))
        acceleration = a * (1 - (v[-1] / desired) ** 4 - (desired_gap / np.maximum(gap, 0.5)) ** 2)
        v.append(v[-1] + step_s * np.clip(acceleration, -4, HIGHEST_MPS2))
        gap = gap - closing * step_s
    return np.column_stack(v)


HELD = (constant_accelerations, plan_of_few_levels, held_pedal)
MOVING = (
    exponential,
    acceleration_ramp,
    minimum_jerk,
    logistic,
    half_sine,
    ornstein_uhlenbeck,
    tracking,
    following,
)


def share_of_holds(v: np.ndarray) -> np.ndarray:
    """Share of the time with an acceleration above 0.1 m/s^2 that lies in holds of 0.6 s."""
    a = np.diff(v) / SAMPLE_S
    windows = np.lib.stride_tricks.sliding_window_view(a, 3, axis=1)
    same = np.ptp(windows, axis=2) < 0.1
    in_hold = np.zeros(a.shape, bool)
    for shift in range(3):
        in_hold[:, shift : shift + same.shape[1]] |= same
    acting = np.abs(a) > 0.1
    return (in_hold & acting).sum(axis=1) / np.maximum(acting.sum(axis=1), 1)


def largest_fifth(v: np.ndarray) -> np.ndarray:
    """Share of the total variation of the acceleration in the largest fifth of its steps."""
    changes = np.sort(np.abs(np.diff(v, 2)), axis=1)[:, ::-1]
    return changes[:, : changes.shape[1] // 5].sum(axis=1) / changes.sum(axis=1)


def gini(v: np.ndarray) -> np.ndarray:
    """Gini's coefficient of the changes of the acceleration."""
    changes = np.sort(np.abs(np.diff(v, 2)), axis=1)
    n = changes.shape[1]
    return changes @ (2 * np.arange(1, n + 1) - n - 1) / n / changes.sum(axis=1)


CANDIDATES = {
    "share of the time in holds of 0.6 s": share_of_holds,
    "share of \\|Δa\\| in the largest fifth of its steps": largest_fifth,
    "Gini's coefficient of \\|Δa\\|": gini,
    "gain of lines over cubics": gains,
}
CELLS = [(rate, noise) for rate in RATES_HZ for noise in NOISES_MPS]


@cache
def at_one_rate(control: Callable, rate_hz: int, noise_mps: float) -> np.ndarray:
    """PROFILES of a control, recorded at a rate with white noise, and brought to 5 Hz."""
    rng = np.random.default_rng([260409609, (HELD + MOVING).index(control), rate_hz])
    v = control(rng, PROFILES, 1 / rate_hz)
    v = v + noise_mps * rng.standard_normal(v.shape)
    return np.array([at_5_hz(times(1 / rate_hz), speeds) for speeds in v])


@cache
def measured(measure: Callable, control: Callable, rate_hz: int, noise_mps: float) -> np.ndarray:
    return measure(at_one_rate(control, rate_hz, noise_mps))


def separation(measure, holds, moving, cell) -> float:
    """The area under the ROC curve: how often a held profile has the larger value."""
    first, second = (
        np.concatenate([measured(measure, control, *cell) for control in controls])
        for controls in (holds, moving)
    )
    return stats.mannwhitneyu(first, second).statistic / (len(first) * len(second))


def candidates_table() -> str:
    """The area under the ROC curve of each candidate, by recording."""
    rows = [
        [name, *(f"{separation(measure, HELD, MOVING, cell):.2f}" for cell in CELLS)]
        for name, measure in CANDIDATES.items()
    ]
    return markdown(["measure", *map(recording, CELLS)], rows)


def controls_table() -> str:
    """Median and quartiles of the gain of each control, and how far it is from its opposites."""
    cells = [cell for cell in CELLS if cell[1] in NOISES_MPS[:2]]
    rows = []
    for control in HELD + MOVING:
        row = [control.__name__.replace("_", " ")]
        for cell in cells:
            low, middle, high = np.percentile(measured(gains, control, *cell), [25, 50, 75])
            holds, moving = ([control], MOVING) if control in HELD else (HELD, [control])
            area = separation(gains, holds, moving, cell)
            row.append(f"{middle:.2f} ({low:.2f} to {high:.2f}), {area:.2f}")
        rows.append(row)
    return markdown(["control", *map(recording, cells)], rows)


def clock_table() -> str:
    """The gain of each control as it is, and with one acceleration a second (5 Hz, exactly)."""
    rows = []
    for control in HELD + MOVING:
        speeds = at_one_rate(control, 5, 0.0)
        row = [control.__name__.replace("_", " ")]
        for v in (speeds, clocked(speeds)):
            gain = gains(v)
            row.append(f"{gain.mean():.2f}, {100 * (gain > 0).mean():.0f} %")
        rows.append(row)
    return markdown(["control", "as it is", "one acceleration a second"], rows)


def recording(cell: tuple[int, float]) -> str:
    rate_hz, noise_mps = cell
    return f"{rate_hz} Hz" + (f", noise {noise_mps} m/s" if noise_mps else "")


def markdown(headings: list[str], rows: list[list[str]]) -> str:
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


if __name__ == "__main__":
    print(candidates_table(), controls_table(), clock_table(), sep="\n\n")
