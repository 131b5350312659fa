"""A chart of levels: a line for each, and on it a point with its interval for each driver."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil, floor, log10

from merge_runner.prompts.blocks import title_of
from merge_runner.study.arms import MODEL, PROMPT
from merge_runner_analysis.metrics import LEFT_FIRST
from merge_runner_analysis.web.effect_rows import Measured
from merge_runner_analysis.wording import TIMES, brackets, number

# The shapes that tell drivers apart in a chart, and more of them are not drawn.
SHAPES = ("dot", "square", "diamond", "triangle")
# Parts of a chart, and a letter of a name, in units of its drawing.
LEFT, WIDTH, HEAD, ROW, APART, INDENT, LETTER = 90.0, 480.0, 12, 20, 14, 84.0, 7.5


@dataclass(frozen=True, slots=True)
class Point:
    """A value of a driver in a chart, with its interval."""

    shape: str
    x: float
    ends: tuple[float, float] | None
    y: float
    says: str


@dataclass(frozen=True, slots=True)
class Line:
    """A level of a chart; the first one of a factor is headed by it."""

    y: float
    head: str
    name: str
    points: list[Point]


@dataclass(frozen=True, slots=True)
class Chart:
    """Levels below each other, and the drivers of each by their shapes."""

    title: str
    lines: list[Line]
    ticks: list[tuple[float, str]]
    even: float | None
    height: float
    indent: float
    width: float = WIDTH


def level_chart(
    title: str, rows: Sequence[Measured], shapes: dict[str, str], metric: str
) -> Chart | None:
    """Return a chart of the levels of these rows, a point for each driver, on one axis."""
    drawn = [
        row
        for row in rows
        if row.values["factor"] != MODEL
        and row.values["value"] is not None
        and (row.values["driver"] or "") in (shapes or {""})
    ]
    if not drawn:
        return None
    percent = metric.endswith("_percent")
    ends = [end for row in drawn for end in (row.values.get("ci") or (row.values["value"],))]
    low, high, step = _axis(min(ends), max(ends))
    if percent:  # the interval of a difference may end beyond
        low, high = max(low, 0.0), min(high, 100.0)

    levels: dict[tuple[str, str], list[Measured]] = {}
    for row in drawn:
        levels.setdefault((row.values["factor"], row.values["level"]), []).append(row)
    names = {(f, name): title_of(name) if f == PROMPT else name for f, name in levels}
    indent = 0.0 if TIMES in next(iter(levels))[0] else INDENT
    left = min(WIDTH / 2, indent + max(LEFT, LETTER * max(map(len, names.values()))))

    def x(value: float) -> float:
        value = min(max(value, low), high)
        return round(left + (WIDTH - left) * (value - low) / (high - low), 1)

    lines: list[Line] = []
    y, heads = float(HEAD), set[str]()
    for (factor, name), of_level in levels.items():
        y += ROW if factor in heads or not lines else 1.5 * ROW
        points = [_point(row, shapes, x, y + APART * place) for place, row in enumerate(of_level)]
        height = APART * (len(points) - 1)
        head = "" if factor in heads or TIMES in factor else factor
        lines.append(Line(y + height / 2, head, names[factor, name], points))
        heads.add(factor)
        y += height
    ticks = [low + step * place for place in range(round((high - low) / step) + 1)]
    even = 50.0 if metric == LEFT_FIRST.name and low < 50 < high else None
    return Chart(
        title,
        lines,
        [(x(tick), f"{tick:g} %" if percent else f"{tick:g}") for tick in ticks],
        None if even is None else x(even),
        y + ROW + 16,
        indent,
    )


def _point(row: Measured, shapes: dict[str, str], x: Callable[[float], float], y: float) -> Point:
    ci, value = row.values.get("ci"), row.values["value"]
    driver, k, n = (row.values[name] for name in ("driver", "k", "n"))
    counts = "" if k is None else f"{k} of {n}, "
    says = f"{driver or 'all drivers'}: {counts}{number(value)} {brackets(ci)}".rstrip()
    ends = None if ci is None else (x(ci[0]), x(ci[1]))
    return Point(shapes.get(driver, SHAPES[0]), x(value), ends, y, says)


def _axis(low: float, high: float) -> tuple[float, float, float]:
    """Return round ends around these values, and the step of four or so ticks between."""
    width = (high - low) or 1.0
    power = 10 ** floor(log10(width / 4))
    step = next(power * of for of in (1, 2, 5, 10) if power * of >= width / 5)
    return step * floor(low / step), step * ceil(high / step), step
