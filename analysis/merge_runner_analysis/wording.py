"""Measures that compare a driver with the humans, verdicts in words, and numbers as texts.

pandas is not needed to read them.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import floor, log10
from pathlib import Path
from typing import Any

from merge_runner_analysis.metrics import (
    BOXES,
    COLLISIONS,
    COST,
    DECIMALS,
    GAP,
    JOINT,
    LEFT_FIRST,
    METRICS,
    RMSE,
    VALID,
)

TABLE = "verdicts"
# Kinds of drivers: language models are in the headline, scripts that pose as one are not.
HUMANS, LANGUAGE_MODEL, PROGRAM, MOCK = "humans", "language model", "program", "mock"
# States. A trait is shown by its own test; the others need a difference with a corrected p < .05.
SHOWN, WEAKER, STRONGER, UNLIKE, OPEN = "shown", "weaker", "stronger", "unlike", "inconclusive"
# Of a slope that is unlike people's: its interval lies on the other side of 0, or includes 0.
OPPOSITE, UNDIRECTED = "opposite", "undirected"
DIFFERS = frozenset({WEAKER, STRONGER, UNLIKE, OPPOSITE, UNDIRECTED})
ENOUGH = 20  # trials with an outcome; fewer, or fewer than half of those that ended, say nothing
ALPHA = 0.05  # of all tests; importing it would load pandas, which no page needs
# Measures in which a difference has a direction, and the sign of more.
SIGNS = {"headway": 1, "velocity": -1, "collisions": 1, "gap": 1, "gap-headway": 1}
SLOPES = frozenset({"headway", "velocity", "gap-headway"})
# So far from people, in points and in m, a driver still is like them.
MARGINS = {"collisions": 5.0, "gap": 1.0}
# States in words, on every page and in every table for people; of MARGINS with a direction.
VERDICTS = {
    SHOWN: "like people",
    WEAKER: "less than people's",
    STRONGER: "more than people's",
    UNLIKE: "unlike people's",
    OPEN: "cannot tell",
}
TENDENCY = "same tendency as people"  # its sign alone, and no difference in size is shown
OF_TRAIT = {
    SHOWN: TENDENCY,
    WEAKER: "weaker than people's",
    STRONGER: "stronger than people's",
    OPPOSITE: "opposite to people's",
    UNDIRECTED: "unlike people's, in no clear direction",
}
DIRECTIONS = {
    **dict.fromkeys(SLOPES, OF_TRAIT),
    "collisions": {WEAKER: "fewer than people's", STRONGER: "more than people's"},
    "gap": {WEAKER: "smaller than people's", STRONGER: "larger than people's"},
}
# The rule of a verdict, a line a state; ``{tests}`` is the number of a driver's tests, if known.
VERDICT_RULES = (
    "Like people (crashes, gap): the whole interval of the difference, at the level of its "
    "corrected test, lies within 5 points, or 1 m",
    "Same tendency as people (who goes first): the one ahead or, side by side, the slower "
    "one goes first more often, with p below .05 in a logistic regression (Firth) over all trials "
    "that finished, not by the counts; and no difference from people is shown",
    "More, fewer, larger, smaller, weaker or stronger: a difference is shown, with p below .05, "
    "corrected (Holm) for all tests of a driver{tests}; of a tendency, in that regression's slope. "
    "A slope with such a difference is opposite if its interval lies on the other side of 0, and "
    "in no clear direction if it includes 0",
    "Cannot tell: neither is shown",
    f"No verdict: fewer than {ENOUGH} trials are counted, or fewer than half of those that ended",
)
FITTED_RULE = (
    "Same tendency as people in the gap by headway: more headway, more gap, with p below .05 in a "
    "linear regression. Like people in the gap by relative velocity: it moves the gap by less than "
    "1 m. Like people in how accelerations are held (I5): within half a standard deviation of "
    "people. Unlike people's in the last two: a value beyond these bounds is shown"
)
VERDICT_RULE = ". ".join((*VERDICT_RULES, FITTED_RULE)).format(tests="")
# Measures that the first page shows, with its headings.
HEADINGS = {
    "collisions": "Crashes",
    "headway": "The one ahead goes first",
    "velocity": "Side by side, the slower goes first",
    "gap": "Gap at the merge point",
}
# Before a difference in a measure without such a heading.
IN_ANOTHER = "in another measure ({})"
# Names of metrics in sentences and pages; others keep the label of the table.
METRIC_NAMES = {
    LEFT_FIRST.name: "goes first",
    COLLISIONS.name: "crashes",
    GAP.name: "gap at the merge point",
    RMSE.name: "deviation from the initial speed",
    BOXES.name: "crashes by people's rule",
    JOINT.name: "both change their speed by 0.5 m/s or more",
    COST.name: "cost of a trial",
}
# A change of the measure, as a claim names it; others are called as above.
CHANGED = {
    LEFT_FIRST.name: "who goes first",
    COLLISIONS.name: "how many trials end in a crash",
    GAP.name: "the gap at the merge point",
    RMSE.name: "the deviation from the initial speed",
    BOXES.name: "how many trials end in a crash by people's rule",
    JOINT.name: "how often both change their speed",
    VALID.name: "how many replies are valid",
    COST.name: "the cost of a trial",
}
# The collision rules that trials may be played by, as sentences name them, and their meaning.
PLAYED_RULES = {
    "euclid2d": "the rule of centres",
    "rectangle": "people's rule",
    "shared_lane": "the rule of the shared lane",
}
RULES_MEAN = {
    "euclid2d": "the vehicles' centres are closer than a vehicle length",
    "rectangle": "the vehicles' outlines overlap",
    "shared_lane": "the vehicles are less than a length apart once one is in the shared lane",
}
PEOPLES_RULE = "the vehicles' outlines overlap, checked every 0.05 s"
# How outlines overlap in a trial that is no crash by the rule that was played.
NO_CRASH_YET = {
    "euclid2d": "vehicles at an angle touch with a corner while their centres are still a length "
    "apart",
    "shared_lane": "outlines can overlap before the shared lane begins",
}
CORRECTED = "p is corrected (Holm) for"
# Of a rehearsal, with the planted effects.
PLANTED = "planted in the mock model for this rehearsal"
# Of a level, with its words.
WORDS = "words of "
# The vehicle that going first is counted for: (subject of a sentence, its meaning).
LEFT = (
    "the left driver",
    "goes first is counted for the left driver, as both drivers are equal and get the same",
)
EGO = (
    "the driver under study",
    "goes first is counted for the driver under study",
)
HALVES = (
    "Where two equal drivers get the same, a trial counts half for each: the share in these trials "
    "is 50 %, but for a half whose situation the other level lacks"
)
UNREADABLE = "the stored study cannot be read by this version"
# Note on levels that no driver reads.
SAME_TRIALS = "not tested: the same trials at both levels, as the drivers do not read what differs"
MISSING, MINUS = "–", "−"
FEW = 3  # of more levels or drivers than these the extremes alone are named
TIMES = " × "  # between the factors of an interaction

Values = Mapping[str, Any]


def note_of(*remarks: object) -> str:
    """Return a note of all remarks that are not empty."""
    return "; ".join(map(str, filter(None, remarks)))


INDICATORS = {
    "I1": "The probability of merging first increases with projected headway advantage.",
    "I2": "The probability of merging first decreases with relative velocity advantage.",
    "I3": "The safety gap is moderately positively affected by projected headway.",
    "I4": "The safety gap is not affected by initial relative velocity difference.",
    "I5": "Conflicts are resolved with intermittent, piecewise-linear velocity profiles.",
}


@dataclass(frozen=True, slots=True)
class Measure:
    """A measure by which a driver is compared with the humans.

    ``trait`` names what humans do, ``label`` and ``unit`` head a column, ``metric`` is the one that
    its trials have, or none for all finished ones, and ``rule`` says how its state is set.
    ``difference`` is a template of the headline, with the fields ``it`` (the driver's name),
    ``driver`` and ``people``: counts of trials, or values with their intervals. ``says`` has by
    state the driver's part of a sentence, with ``of``, ``humans`` and ``more`` or less. ``ends``
    are the limits of its axis. A driver is alike if it differs from the humans by less than
    ``margin``. Those of HEADINGS say what drivers like people do, ``alike``, and have a ``topic``.
    """

    name: str
    trait: str
    label: str
    unit: str
    metric: str
    rule: str
    difference: str
    ends: tuple[float, float]
    says: Mapping[str, str] = field(default_factory=dict)
    margin: float | None = None
    alike: str = ""
    topic: str = ""

    @property
    def rests_on(self) -> str:
        """The column in which its trials have a value, or ``finished``."""
        return METRICS[self.metric].column if self.metric else "finished"


MEASURES = {
    name: Measure(name, **fields)
    for name, fields in tomllib.loads(
        Path(__file__).with_name("measures.toml").read_text(encoding="utf-8")
    ).items()
}


def crash_text(rules: Sequence[tuple[str, Sequence[float]]]) -> str:
    """Return the meaning of a crash by the collision rules that were played, with their steps."""
    texts = []
    for rule, steps_s in rules:
        every = "simulation step, " * (len(steps_s) > 1) + " or ".join(map("{:g}".format, steps_s))
        text = f"{RULES_MEAN[rule]}, checked every {every} s"
        texts.append(text if rule == "rectangle" else f"{text} ({PLAYED_RULES[rule]})")
    return " or, by the scenario of the trial, ".join(texts)


def by_group(rows: Iterable[Any]) -> dict[str, dict[str, Values]]:
    """Return the values of a table's rows by the id of their driver and prompt, and by measure.

    ``row`` and ``note`` are added. A group that is not judged has one entry, without a measure.
    """
    groups: dict[str, dict[str, Values]] = {}
    for row in rows:
        values = {**row.values, "note": row.note, "row": row.id}
        groups.setdefault(row.groups[0], {})[row.values.get("measure") or ""] = values
    return groups


def distance(values: Values) -> float:
    """Return a driver's difference from people, or its value where no difference is stored."""
    apart = values.get("difference")
    return (values.get("estimate") if apart is None else apart) or 0.0


def suffice(trials: int, ended: int) -> bool:
    """Return whether this number of counted trials is enough for a verdict."""
    return trials >= ENOUGH and 2 * trials >= ended


def shown_state(values: Values) -> str:
    """Return a state as sentences and marks show it: too few trials are inconclusive.

    A difference that surely lies within its margin is like people's; one in a measure of SIGNS has
    a direction. A slope has that of people, the opposite one, or none that its interval shows.
    """
    state = str(values.get("state") or "")
    if state and not suffice(values.get("n") or 0, values.get("ended") or 0):
        return OPEN
    if _is_within(values):
        return SHOWN
    if state == UNLIKE and (sign := SIGNS.get(measure := str(values["measure"]))):
        if measure in SLOPES and (ci := values.get("ci")):
            low, high = sorted(sign * end for end in ci)
            if low <= 0:
                return OPPOSITE if high < 0 else UNDIRECTED
        return STRONGER if sign * distance(values) > 0 else WEAKER
    return state


def has_verdict(values: Values) -> bool:
    """Return whether a measure has a state that rests on enough trials."""
    n, ended = values.get("n") or 0, values.get("ended") or 0
    return bool(values.get("state")) and (suffice(n, ended) or bool(values.get("undecided")))


def _is_within(values: Values) -> bool:
    """Return whether the interval of crashes or of a gap is within MARGINS of people's."""
    margin, ci = MARGINS.get(str(values.get("measure"))), values.get("difference_ci")
    return margin is not None and ci is not None and max(-ci[0], ci[1]) <= margin


def differs(values: Values) -> bool:
    """Return whether the driver is shown to differ from humans in a measure, beyond its margin."""
    return values.get("state") in DIFFERS and not _is_within(values)


def with_interval(value: float | None, ci: Sequence[float] | None) -> str:
    """Return ``68.18 [47.32, 83.64]``, or an en dash without a value."""
    return number(value) if value is None else f"{number(value)} {brackets(ci)}".rstrip()


def number(value: float | None, decimals: int = DECIMALS, unit: str = "") -> str:
    """Return a number as pages print it: with a true minus sign, and never minus zero."""
    return MISSING if value is None else f"{value:z.{decimals}f}{unit}".replace("-", MINUS)


def ends_of(values: Values) -> str:
    """Return an estimate's interval, with a margin also its level if not 95: ``[99 %: 2, 7]``."""
    level, ends = values.get("level"), brackets(values.get("ci"))
    has_level = level is not None and MEASURES[str(values["measure"])].margin is not None
    return ends.replace("[", f"[{level:.4g} %: ") if has_level and f"{level:.4g}" != "95" else ends


def brackets(ci: Sequence[float] | None, form: Callable[[float], str] = number) -> str:
    """Return ``[47.32, 83.64]``, or nothing."""
    return "" if ci is None else f"[{', '.join(map(form, ci))}]"


def money(value: float | None, unit: str = "") -> str:
    """Return a price with two decimals, or with two digits that are not 0: ``0.0012``."""
    if value is None or not 0 < abs(value) < 1:
        return number(value, unit=unit)
    return number(value, max(DECIMALS, 1 - floor(log10(abs(value)))), unit)


def p_value(p: float | None) -> str:
    """Return a p of three decimals, or that it is smaller."""
    return "<0.001" if p is not None and p < 0.001 else number(p, 3)


def equal_p(p: float) -> str:
    """Return ``= 0.012``, or ``< 0.001``."""
    text = p_value(p)
    return f"< {text[1:]}" if text.startswith("<") else f"= {text}"


def verdict_word(values: Values) -> str:
    """Return a state in words, as it stands in a list of verdicts."""
    n = values.get("n") or 0
    if values.get("state") and not has_verdict(values):
        return f"fewer than {ENOUGH} trials" if n < ENOUGH else "too few finished"
    words = VERDICTS | DIRECTIONS.get(str(values.get("measure")), {})
    return words.get(shown_state(values), "not compared")


def joined(items: Sequence[str]) -> str:
    """Return items as ``a, b and c``."""
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}"


def capital(text: str) -> str:
    """Return the text with a capital letter at its beginning."""
    return text[:1].upper() + text[1:]
