"""Sentences that compare two drivers with each other, of finished tables."""

from __future__ import annotations

from collections.abc import Mapping

from merge_runner_analysis.metrics import COLLISIONS, COST, GAP, JOINT, LEFT_FIRST, RMSE, VALID
from merge_runner_analysis.wording import (
    ALPHA,
    CHANGED,
    ENOUGH,
    Values,
    brackets,
    equal_p,
    joined,
    money,
    number,
)

# Where two equal drivers met, who goes first is counted for the left vehicle.
LEFT_GOES_FIRST = "left vehicle goes first"
# Sentence parts: a driver has more than another, has less, or no difference is shown in it.
COMPARED = {
    LEFT_FIRST.name: ("goes first more often", "goes first less often", "how often it goes first"),
    LEFT_GOES_FIRST: (
        *(f"lets the left vehicle go first {often} often" for often in ("more", "less")),
        "how often the left vehicle goes first",
    ),
    GAP.name: ("leaves a larger gap", "leaves a smaller gap", CHANGED[GAP.name]),
    RMSE.name: (
        "departs more from its initial speed",
        "keeps closer to its initial speed",
        CHANGED[RMSE.name],
    ),
    JOINT.name: (
        *(f"has both drivers change their speed {often} often" for often in ("more", "less")),
        CHANGED[JOINT.name],
    ),
    VALID.name: ("has more valid replies", "has fewer valid replies", CHANGED[VALID.name]),
    COST.name: ("costs more", "costs less", CHANGED[COST.name]),
}


def apart(driver: str, other: str, rows: Mapping[str, Values], *, of_left: bool) -> tuple[str, str]:
    """Return the headline that compares two drivers, and other differences; ``rows`` by metric.

    ``A crashed in 12 of 110 trials, B in 33 of 110. In the same situations A crashed less often, by
    19.09 points [8.41, 29.78]; corrected p = 0.004.`` With ``of_left``, who goes first is the left
    vehicle.
    """
    crashed = rows.get(COLLISIONS.name, {})
    others = _others(driver, other, rows, of_left=of_left)
    counts = [crashed.get(f"{name}{of}") for of in ("", "_reference") for name in ("k", "n")]
    if any(count is None for count in counts):
        return f"{driver} against {other}.", others
    k, n, k_other, n_other = counts
    claim = f"{driver} crashed in {k} of {n} trials, {other} in {k_other} of {n_other}"
    difference, p, ci = (crashed.get(name) for name in ("difference", "p_corrected", "ci"))
    if min(n or 0, n_other or 0) < ENOUGH:
        return f"{claim}: too few to say more.", ""
    if difference is None or p is None or is_constant(crashed):
        return f"{claim}.", others
    corrected = f"corrected p {equal_p(p)}"
    if p >= ALPHA:
        result = f"No difference is shown: {number(difference)} points {brackets(ci)}"
        return f"{claim}. {result}; {corrected}.", others
    # Of a driver that crashed less often, both ends change their signs and their places.
    ends = ci and sorted(end if difference > 0 else -end for end in ci)
    result = f"{number(abs(difference))} points {brackets(ends)}".rstrip()
    often = "more" if difference > 0 else "less"
    same = f"In the same situations {driver} crashed {often} often, by {result}"
    return f"{claim}. {same}; {corrected}.", others


def is_constant(values: Values) -> bool:
    """Return whether a measure counts no trial, or every trial, of both drivers."""
    k, n = ([values.get(name + of) for of in ("", "_reference")] for name in "kn")
    return None not in k and k in ([0, 0], n)


def _others(driver: str, other: str, rows: Mapping[str, Values], *, of_left: bool) -> str:
    """Return the measures besides crashes in which a driver is shown to differ, and the others."""
    shown, unshown = [], []
    for name, (more, less, what) in COMPARED.items():
        is_unasked = name == (LEFT_FIRST.name if of_left else LEFT_GOES_FIRST)
        values = rows.get(LEFT_FIRST.name if name == LEFT_GOES_FIRST else name, {})
        if is_unasked or is_constant(values) or (p := values.get("p_corrected")) is None:
            continue
        if p >= ALPHA:
            unshown.append(what)
            continue
        unit = str(values["measure"]).rpartition("(")[2].rstrip(")")
        form = money if unit == "USD" else number
        sides = (form(values[f"value{of}"]) for of in ("", "_reference"))
        shown.append(
            f"{more if values['difference'] > 0 else less} ({' against '.join(sides)} {unit})"
        )
    against = f"Compared with {other}, with situations weighted alike for both,"
    parts = [f"{against} {driver} {joined(shown)}."] if shown else []
    parts += [f"No difference is shown in {joined(unshown)}."] if unshown else []
    return " ".join(parts)
