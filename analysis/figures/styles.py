"""How drivers are told apart in every picture: by a colour and a shape each; humans are black.

The figures are drawn with matplotlib. The pages have SVG of their own, since their points are links
with words for a screen reader, and exported pages have no other pictures. Both use these styles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

# The palette of Okabe and Ito (2008), safe for the colour-blind.
BLUE, VERMILION, GREEN, PURPLE = "#0072b2", "#d55e00", "#009e73", "#cc79a7"
SKY_BLUE, ORANGE = "#56b4e9", "#e69f00"
COLOURS = (BLUE, VERMILION, GREEN, PURPLE, SKY_BLUE, ORANGE)
SHAPES = ("square", "triangle", "diamond", "down", "plus", "cross")
MARKERS = {
    "circle": "o",
    "square": "s",
    "triangle": "^",
    "diamond": "D",
    "down": "v",
    "plus": "P",
    "cross": "X",
}


@dataclass(frozen=True, slots=True)
class Style:
    """A colour, and a shape by its name."""

    colour: str
    shape: str

    @property
    def marker(self) -> str:
        """The shape as matplotlib names it."""
        return MARKERS[self.shape]


HUMAN_STYLE = Style("#000000", "circle")


def driver_style(number: int) -> Style:
    """The style of a driver, counted from 0."""
    return turned(number, COLOURS, SHAPES)


def turned(number: int, colours: Sequence[str], shapes: Sequence[str]) -> Style:
    """A style, counted from 0; once the colours are used up, each comes with another shape."""
    turn = number + number // len(colours)
    return Style(colours[number % len(colours)], shapes[turn % len(shapes)])
