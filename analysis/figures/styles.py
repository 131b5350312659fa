"""How drivers are told apart in figures: by a colour and a marker each; humans are black."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

# The palette of Okabe and Ito (2008), safe for the colour-blind.
BLUE, VERMILION, GREEN, PURPLE = "#0072b2", "#d55e00", "#009e73", "#cc79a7"
SKY_BLUE, ORANGE = "#56b4e9", "#e69f00"
COLOURS = (BLUE, VERMILION, GREEN, PURPLE, SKY_BLUE, ORANGE)
MARKERS = "s^DvPX"


@dataclass(frozen=True, slots=True)
class Style:
    """A colour, and a marker as matplotlib names it."""

    colour: str
    marker: str


HUMAN_STYLE = Style("#000000", "o")


def driver_style(number: int) -> Style:
    """The style of a driver, counted from 0."""
    return turned(number, COLOURS, MARKERS)


def turned(number: int, colours: Sequence[str], markers: str) -> Style:
    """A style, counted from 0; once the colours are used up, each comes with another marker."""
    turn = number + number // len(colours)
    return Style(colours[number % len(colours)], markers[turn % len(markers)])
