"""The score interval of a proportion, for pages too: scipy would take a second to start."""

from __future__ import annotations

from math import sqrt

Z = 1.959963984540054  # for 95 %, as scipy has it; statistics.NormalDist rounds up


def wilson(p: float, n: float) -> tuple[float, float]:
    """Return the score interval of a proportion of ``n`` trials."""
    middle = (p + Z**2 / (2 * n)) / (1 + Z**2 / n)
    half = Z / (1 + Z**2 / n) * sqrt(p * (1 - p) / n + Z**2 / (4 * n**2))
    # The exact bounds at 0 and n are 0 and 1; rounding must not leave the estimate outside.
    return min(p, max(0.0, middle - half)), max(p, min(1.0, middle + half))
