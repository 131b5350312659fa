"""Names of drivers and of pairs, and the side of the ego."""

from __future__ import annotations

import re
from collections.abc import Container, Iterable, Mapping

from merge_runner.records import Side


def driver_name(model: str, endpoint: str | None) -> str:
    """Return a driver's name, with its endpoint unless that is the provider's own.

    The macro of this name in schema.sql is equal.
    """
    host = re.search("://([^/]+)", endpoint or "")
    return f"{model} at {host[1]}" if host else model


def without_endpoint(driver: str) -> str:
    """Return a driver's name without its endpoints.

    >>> without_endpoint("bold at localhost:8123 [temperature=0.2]")
    'bold [temperature=0.2]'
    >>> without_endpoint("bold at localhost:8123/set1")
    'bold/set1'
    """
    return re.sub(r" at [^\s+]+?(?=/set\d+(?: |$)|[\s+]|$)", "", driver)


def both_sides(model: str) -> dict[Side, str]:
    """Return the driver of each side by a value of ``--model``: a name, or ``LEFT+RIGHT``."""
    left, _, right = model.partition("+")
    return {"left": left, "right": right or left}


def ego_side(sides: Mapping[Side, str], asking: Container[str], opponent: str = "") -> Side:
    """Return the side of the ego: the focal driver, whose odds ratio is reported, named first.

    The ego is the driver that is not the study's opponent; else a language model before a program
    (``asking`` has the models), else the first in the alphabet. For two equal drivers it is the
    left one. The view ``trial_drivers`` is equal.
    """
    left, right = sides["left"], sides["right"]
    if left == right or opponent in (left, right):
        return "right" if opponent == left != right else "left"
    if (left in asking) != (right in asking):
        return "left" if left in asking else "right"
    return "left" if left < right else "right"


def pair_name(pair: Iterable[str], endpoints: Mapping[str, str]) -> str:
    """Return the name of a pair, the ego first, as ``trial_drivers`` without the sample set."""
    ego, other = (driver_name(model, endpoints.get(model)) for model in pair)
    return ego if ego == other else f"{ego}+{other}"
