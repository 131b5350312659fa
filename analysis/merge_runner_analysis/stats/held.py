"""Is the acceleration held and then changed at once? The measure behind indicator I5.

What the paper sees in its Figure 2 are speeds made of straight lines: the acceleration is held, and
then jumps. A vehicle's speed under control, brought to 5 Hz, is therefore cut into pieces in two
ways: into straight lines (held accelerations), and into cubics (accelerations that move). The
*gain* is the advantage of lines over cubics per sample, at equal numbers of parameters:

    gain = (min BIC(cubics) - min BIC(lines)) / n
    BIC(k pieces) = n ln(RSS / RSS of one line + sigma^2) + numbers ln n

A piece has its coefficients, and all but the first a place where it begins (Schwarz 1978). Above 0
the acceleration is rather held, below 0 it rather moves. The best pieces are found by dynamic
programming (Bellman 1961; exact). The residual is taken relative to how far the speed leaves one
straight line, so that driving twice as hard changes nothing; the tolerance sigma keeps the last
digits of a simulation from ruling.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from merge_runner_analysis.stats.estimate import Array

SAMPLE_S = 0.2
TOLERANCE = 0.04
LINE_COEFFICIENTS, CUBIC_COEFFICIENTS = 2, 4
LINE_SAMPLES, CUBIC_SAMPLES = 3, 5  # one more than coefficients; 3 are 0.6 s
MOST_LINES, MOST_CUBICS = 14, 8  # 41 and 39 numbers; enough for holds of 0.6 to 3 s over 20 s
STEADY_MPS = 0.1
SHORTEST_SAMPLES = 11  # 2 s
AT_ONCE = 512  # vehicles whose sums stay in the processor
KEY = ["trial_id", "spec_hash", "side"]


def measure_profiles(speeds: pd.DataFrame) -> pd.DataFrame:
    """Measure vehicles: rows with KEY, lists time_s and velocity_mps, and whether ``resisted``.

    Adds ``steady``, no control action, and ``gain``, NaN where steady or under control for < 2 s.
    """
    steady = np.zeros(len(speeds), bool)
    gain = np.full(len(speeds), np.nan)
    sampled: dict[int, Array] = {}
    columns = (speeds[name] for name in ("time_s", "velocity_mps", "resisted"))
    for row, (time_s, velocity_mps, resisted) in enumerate(zip(*columns, strict=True)):
        time, v = np.asarray(time_s, dtype=float), np.asarray(velocity_mps, dtype=float)
        driven = without_resistance(time, v) if resisted else v
        apart = [np.abs(speeds - speeds.mean()).max() for speeds in (v, driven) if len(speeds)]
        steady[row] = min(apart, default=np.inf) <= STEADY_MPS
        at = at_5_hz(time - time[:1], driven)
        if not steady[row] and len(at) >= SHORTEST_SAMPLES:
            sampled[row] = at
    gain[[*sampled]] = gains([*sampled.values()])
    return speeds[KEY].reset_index(drop=True).assign(steady=steady, gain=gain)


def at_5_hz(time_s: Array, velocity_mps: Array) -> Array:
    """Return the speeds at multiples of 0.2 s, linear between samples where they lie closer."""
    samples = int(np.floor(time_s[-1] / SAMPLE_S + 1e-9)) + 1 if len(time_s) else 0
    return np.asarray(np.interp(np.arange(samples) * SAMPLE_S, time_s, velocity_mps))


def without_resistance(time_s: Array, velocity_mps: Array) -> Array:
    """Return the speeds without the human simulator's resistance of 0.5 + 0.005 v^2 in m/s^2.

    A pedal that is held gives a straight line here, and an exponential with it.
    """
    moves = velocity_mps[1:] > 0
    lost = moves * (0.5 + 0.005 * velocity_mps[:-1] ** 2) * np.diff(time_s)
    return np.asarray(velocity_mps + np.concatenate([[0.0], np.cumsum(lost)]))


def gains(velocity_mps: Sequence[Array]) -> Array:
    """Return the gains of vehicles, (vehicles,), by their samples at 5 Hz."""
    lengths = np.array([len(speeds) for speeds in velocity_mps])
    by_length, gain = np.argsort(lengths), np.empty(len(lengths))
    for start in range(0, len(lengths), AT_ONCE):
        chosen = by_length[start : start + AT_ONCE]
        n = lengths[chosen]
        lines, cubics = residuals([velocity_mps[vehicle] for vehicle in chosen])
        # One acceleration from beginning to end leaves nothing to explain.
        whole = np.maximum(lines[0], n * STEADY_MPS**2)
        moving = _criterion(cubics / whole, CUBIC_COEFFICIENTS, n)
        gain[chosen] = (moving - _criterion(lines / whole, LINE_COEFFICIENTS, n)) / n
    return gain


def _criterion(left: Array, coefficients: int, n: NDArray[np.int_]) -> Array:
    """Return the lowest criterion of 1, 2, ... pieces: ``left`` of 1 is (pieces, vehicles)."""
    pieces = np.arange(1, len(left) + 1)[:, None]
    numbers = pieces * coefficients + pieces - 1
    return np.asarray((n * np.log(left + TOLERANCE**2) + numbers * np.log(n)).min(axis=0))


def residuals(velocity_mps: Sequence[Array]) -> tuple[Array, Array]:
    """Return (pieces, vehicles) least sums of squares of 1, 2, ... lines, and of cubics; or inf."""
    lengths = [len(speeds) for speeds in velocity_mps]
    # Sums over the first samples do not depend on those after a vehicle's own.
    n, vehicles = max(lengths), len(lengths)
    y = np.zeros((n, vehicles))
    for vehicle, speeds in enumerate(velocity_mps):
        y[: len(speeds), vehicle] = speeds - speeds[0]
    i = np.arange(n)[:, None]
    nothing = np.zeros((1, vehicles))
    terms = (y**2, y, i * y, i**2 * y, i**3 * y)
    sums = [np.concatenate([nothing, np.cumsum(term, axis=0)]) for term in terms]
    # By number of pieces: the least sum over the first samples, 0 to n of them.
    lines = np.full((MOST_LINES + 1, n + 1, vehicles), np.inf)
    cubics = np.full((MOST_CUBICS + 1, n + 1, vehicles), np.inf)
    lines[0, 0] = cubics[0, 0] = 0
    for end in range(LINE_SAMPLES, n + 1):
        line, cubic = _last_piece(sums, end)
        _extend(lines, end, line)
        _extend(cubics, end, cubic)
    return lines[1:, lengths, range(vehicles)], cubics[1:, lengths, range(vehicles)]


def _last_piece(sums: list[Array], end: int) -> tuple[Array, Array]:
    """Return a last piece's sums of squares, by orthogonal polynomials (Gram 1883)."""
    start = np.arange(end - LINE_SAMPLES + 1)
    n = (end - start)[:, None].astype(float)
    middle = (end - 1 + start)[:, None] / 2
    squares, m0, m1, m2, m3 = (s[end] - s[start] for s in sums)
    m3 = m3 - 3 * middle * m2 + 3 * middle**2 * m1 - middle**3 * m0
    m2 = m2 - 2 * middle * m1 + middle**2 * m0
    m1 = m1 - middle * m0
    line = squares - m0**2 / n - m1**2 / (n * (n**2 - 1) / 12)
    long = slice(max(0, end - CUBIC_SAMPLES + 1))
    n, m0, m1, m2, m3 = n[long], m0[long], m1[long], m2[long], m3[long]
    bend = (m2 - m0 * (n**2 - 1) / 12) ** 2 / (n * (n**2 - 1) * (n**2 - 4) / 180)
    turn = (m3 - m1 * (3 * n**2 - 7) / 20) ** 2 / (n * (n**2 - 1) * (n**2 - 4) * (n**2 - 9) / 2800)
    # Rounding leaves residuals of exact pieces below 0.
    return np.maximum(line, 0), np.maximum(line[long] - bend - turn, 0)


def _extend(best: Array, end: int, last: Array) -> None:
    """Fill in the best ways to cover ``end`` samples, given the errors of their last piece."""
    shortest = end + 1 - len(last)
    for pieces in range(1, min(len(best) - 1, end // shortest) + 1):
        first = shortest * (pieces - 1)
        best[pieces, end] = (best[pieces - 1, first : len(last)] + last[first:]).min(axis=0)
