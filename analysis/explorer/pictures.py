"""Still pictures: where their lines and marks lie, in the units of the SVG that a template writes.

Only the replay draws in the browser, since it moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, floor, log10

from merge_runner.records import SIDES
from merge_runner_analysis.explorer.reading import Row

SPARK_WIDTH, SPARK_HEIGHT = 96.0, 22.0


@dataclass(frozen=True, slots=True)
class Scale:
    """Where values lie in a picture: ``low`` at ``from_``, ``high`` at ``to``, others between.

    What lies beyond is drawn at the edge.
    """

    low: float
    high: float
    from_: float
    to: float

    def __call__(self, value: float) -> float:
        """The place of a value."""
        inside = min(max(value, self.low), self.high)
        return self.from_ + (self.to - self.from_) * (inside - self.low) / (self.high - self.low)

    def whole(self, values: Sequence[float]) -> list[int]:
        """The places of values that all lie between the ends, in whole units."""
        unit = (self.to - self.from_) / (self.high - self.low)
        return [round(self.from_ + unit * (value - self.low)) for value in values]


def speed_range(rows: Sequence[Row]) -> tuple[int, int]:
    """The whole m/s at the bottom and the top of all sparklines of these trials."""
    ranges = [row[f"{side}_range_mps"] for row in rows if _drawn(row) for side in SIDES]
    low = floor(min((low for low, _ in ranges), default=0.0))
    return low, max(ceil(max((high for _, high in ranges), default=0.0)), low + 1)


def _drawn(row: Row) -> bool:
    return bool(row["left_mps"] and row["right_mps"])


def sparkline(row: Row, speeds: tuple[int, int]) -> dict[str, str] | None:
    """The speeds of both vehicles: points of two lines, and in words.

    None where a vehicle has none.
    """
    if not _drawn(row):
        return None
    (left_low, left_high), (right_low, right_high) = row["left_range_mps"], row["right_range_mps"]
    return {
        "left": _spark_points(row["left_mps"], speeds),
        "right": _spark_points(row["right_mps"], speeds),
        "words": f"speed of the left vehicle {left_low:.1f} to {left_high:.1f} m/s, "
        f"of the right one {right_low:.1f} to {right_high:.1f} m/s",
    }


def _spark_points(values: Sequence[float], speeds: tuple[int, int]) -> str:
    x, y = Scale(0, max(len(values) - 1, 1), 0, SPARK_WIDTH), Scale(*speeds, SPARK_HEIGHT, 0)
    return " ".join([f"{x(i):.0f},{y(speed):.1f}" for i, speed in enumerate(values)])


def step_points(values: Sequence[float], width: float, height: float, steps: int) -> str:
    """Points of a step line from -1 to 1, ``steps`` across the width."""
    x, y = Scale(0, max(steps, 1), 0, width), Scale(-1, 1, height, 0)
    return " ".join(
        [f"{x(i):.1f},{y(v):.1f} {x(i + 1):.1f},{y(v):.1f}" for i, v in enumerate(values)]
    )


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis of a panel, and the values of its ticks."""

    scale: Scale
    ticks: Sequence[float]

    @classmethod
    def of(cls, ends: tuple[float, float], places: tuple[float, float]) -> Axis:
        """An axis between two places that shows at least these ends; see ``ends_and_ticks``."""
        low, high, ticks = ends_and_ticks(*ends)
        return cls(Scale(low, high, *places), ticks)

    @property
    def marks(self) -> list[tuple[float, str]]:
        """Where the ticks are drawn, and as what."""
        return [(self.y(tick), f"{tick:g}") for tick in self.ticks]

    def y(self, value: float) -> float:
        """Where a value is drawn."""
        return round(self.scale(value), 1)


def ends_and_ticks(low: float, high: float) -> tuple[float, float, list[float]]:
    """Both ends of an axis that holds these, and its ticks: round steps, with 0 in it."""
    low, high = min(low, 0.0), max(high, 0.0)
    high = high if high > low else low + 1.0
    rough = (high - low) / 4
    size = 10.0 ** floor(log10(rough))
    step = next(size * m for m in (1, 2, 2.5, 5, 10) if size * m >= rough * 0.999)
    # Against rounding: 0.3 / 0.1 is a little less than 3, and would make one step more.
    first, last = floor(low / step + 1e-9), ceil(high / step - 1e-9)
    last = max(last, first + 1)
    return first * step, last * step, [round(i * step, 6) for i in range(first, last + 1)]
