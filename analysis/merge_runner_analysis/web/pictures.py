"""Still pictures: where their lines and marks lie, in the units of the SVG that a template writes.

Only the replay draws in the browser, since it moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, floor

from merge_runner.records import SIDES
from merge_runner_analysis.web.reading import Row
from merge_runner_analysis.wording import MINUS

SPARK_WIDTH, SPARK_HEIGHT = 96.0, 22.0


def speed_range(rows: Sequence[Row]) -> tuple[int, int]:
    """Return the whole m/s at the bottom and the top of all sparklines of these trials."""
    every = [end for row in rows for side in SIDES for end in row[f"{side}_range_mps"] or ()]
    ends = [end for end in every if end is not None]  # a vehicle may have no samples
    low = floor(min(ends, default=0.0))
    return low, max(ceil(max(ends, default=0.0)), low + 1)


def sparkline(row: Row, speeds: tuple[int, int]) -> dict[str, str] | None:
    """Return the speeds of both vehicles: points of two lines, and in words.

    None where a vehicle has none.
    """
    if not (row["left_mps"] and row["right_mps"]):
        return None
    (left_low, left_high), (right_low, right_high) = row["left_range_mps"], row["right_range_mps"]
    return {
        "left": _spark_points(row["left_mps"], speeds),
        "right": _spark_points(row["right_mps"], speeds),
        "words": f"speed of the left vehicle {left_low:.1f} to {left_high:.1f} m/s, "
        f"of the right one {right_low:.1f} to {right_high:.1f} m/s",
    }


def _spark_points(values: Sequence[float], speeds: tuple[int, int]) -> str:
    low, high = speeds  # of all, so that none lies beyond
    across, down = SPARK_WIDTH / max(len(values) - 1, 1), SPARK_HEIGHT / (high - low)
    return " ".join([f"{i * across:.0f},{(high - v) * down:.1f}" for i, v in enumerate(values)])


def step_points(values: Sequence[float], width: float, height: float, steps: int) -> str:
    """Return the points of a step line from -1 to 1, ``steps`` across the width."""
    across = [f"{width * min(i, steps) / steps:.1f}" for i in range(len(values) + 1)]
    down = [f"{height - height * (min(max(v, -1), 1) + 1) / 2:.1f}" for v in values]
    return " ".join([f"{across[i]},{y} {across[i + 1]},{y}" for i, y in enumerate(down)])


def accelerations(values: Sequence[float], most_mps2: float) -> str:
    """Return the accelerations of a plan in m/s², one after another."""
    return "".join([f"{value * most_mps2:+.2f} " for value in values]).replace("-", MINUS)
