"""Measures that compare a driver with the humans, and the sentences of verdicts.

Nothing here computes: sentences read the finished rows of the table ``verdicts``, so that a page, a
report and a terminal say the same. pandas is not needed to read them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from math import floor, log10
from typing import Any, NamedTuple

from merge_runner.prompts.blocks import BASELINE
from merge_runner_analysis.metrics import (
    BOXES,
    COLLISIONS,
    COST,
    DECIMALS,
    GAP,
    JOINT,
    LEFT_FIRST,
    RMSE,
    VALID,
)

TABLE = "verdicts"
# Kinds of drivers: language models are in the headline, scripts that pose as one are not.
HUMANS, LANGUAGE_MODEL, PROGRAM, MOCK = "humans", "language model", "program", "mock"
# States. A trait is shown by its own test; the others need a difference with a corrected p < .05.
SHOWN, WEAKER, STRONGER, UNLIKE, OPEN = "shown", "weaker", "stronger", "unlike", "inconclusive"
DIFFERS = frozenset({WEAKER, STRONGER, UNLIKE})
ENOUGH = 20  # trials with an outcome; fewer, or fewer than half of those that ended, say nothing
TOO_FEW = (
    f"Too few trials without a crash for a verdict (at least {ENOUGH}, and half of all, are needed)"
)
ALPHA = 0.05  # of all tests; importing it would load pandas, which no page needs
# Measures in which a difference has a direction, and the sign of more.
SIGNS = {"headway": 1, "velocity": -1, "collisions": 1, "gap": 1, "gap-headway": 1}
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
DIRECTIONS = {
    "headway": {
        SHOWN: TENDENCY,
        WEAKER: "depends less on who is ahead",
        STRONGER: "depends more on who is ahead",
    },
    "velocity": {
        SHOWN: TENDENCY,
        WEAKER: "depends less on who is slower",
        STRONGER: "depends more on who is slower",
    },
    "gap-headway": {
        SHOWN: TENDENCY,
        WEAKER: "depends less on who is ahead",
        STRONGER: "depends more on who is ahead",
    },
    "collisions": {WEAKER: "fewer than people's", STRONGER: "more than people's"},
    "gap": {WEAKER: "smaller than people's", STRONGER: "larger than people's"},
}
# The rule of a verdict, a line a state; ``{tests}`` is the number of a driver's tests, if known.
VERDICT_RULES = (
    "Like people (crashes, gap): the whole interval of the difference lies within 5 points, or 1 m",
    "Same tendency as people (who goes first): the one ahead or, side by side, the slower "
    "one goes first more often, with p below .05 in a logistic regression (Firth) over all trials "
    "without a crash, not by the counts; and no difference is shown",
    "More, fewer, larger, smaller, or depends more or less: a difference is shown, with p below "
    ".05, corrected (Holm) for a driver's {tests}tests; in who goes first, of that regression's "
    "slopes",
    f"Cannot tell: neither is shown. No verdict: fewer than {ENOUGH} trials are counted, or fewer "
    "than half of those that ended",
)
FITTED_RULE = (
    "Same tendency as people in the gap by headway: more headway, more gap, with p below .05 in a "
    "linear regression. Like people in the gap by relative velocity: it moves the gap by less than "
    "1 m; in accelerations held: within half a standard deviation of people. Unlike people's in "
    "either: a difference is shown"
)
VERDICT_RULE = ". ".join((*VERDICT_RULES, FITTED_RULE)).format(tests="")
# Measures that the first page shows, with its headings.
HEADINGS = {
    "collisions": "Crashes",
    "headway": "The one ahead goes first",
    "velocity": "Side by side, the slower goes first",
    "gap": "Gap at the merge point",
}
# What drivers that are like people do in them, and what there is no verdict on.
LIKENESS = {
    "collisions": ("crash as often as people", "crashes"),
    "headway": ("let the one ahead go first, as people do", "who goes first with one ahead"),
    "velocity": ("let the slower go first side by side, as people do",
                 "who goes first side by side"),
    "gap": ("leave gaps like people's", "the gap"),
}  # fmt: skip
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
# The collision rules that trials may be played by, as sentences name them, and their meaning.
PLAYED_RULES = {
    "euclid2d": "the paper's rule",
    "rectangle": "people's rule",
    "shared_lane": "the rule of the shared lane",
}
RULES_MEAN = {
    "euclid2d": "the vehicles' centres are closer than a vehicle length",
    "rectangle": "the vehicles' outlines overlap",
    "shared_lane": "the vehicles are less than a length apart once one is in the shared lane",
}
PEOPLES_RULE = "the vehicles' outlines overlap, checked every 0.05 s"
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
    "Where two equal drivers get the same, a trial counts half for each, so that their share is "
    "50 % by construction"
)
UNREADABLE = "the stored study cannot be read by this version"
# Note on levels that no driver reads.
SAME_TRIALS = "not tested: the same trials at both levels, as the drivers do not read what differs"
MISSING, MINUS = "–", "−"
FEW = 3  # of more levels or drivers than these the extremes alone are named
TIMES = " × "  # between the factors of an interaction

Values = Mapping[str, Any]


class Why(Enum):
    """Remarks on numbers, such as why one is missing, with placeholders for values."""

    # Fits; ``s`` makes a plural of the first value.
    NO_FIRST = "no trial in which one went first without a crash"
    NO_GAP = "no trial with a gap"
    FEW_FIRST = (
        "{} trial{s} in which one went first without a crash: too few, or in too few situations, "
        "to estimate effects of headway and speed"
    )
    FEW_GAPS = (
        "{} trial{s} with a gap: too few, or in too few situations, to estimate effects of headway "
        "and speed"
    )
    SAME_FIRST = "who merged first is the same in all {} trials: nothing to explain"
    SEPARATION = "separation: no finite estimate of {}; see Firth's fit"
    NO_LIKELIHOOD = "the maximum likelihood fit does not converge"
    NO_FIRTH = "Firth's penalised fit does not converge"
    NO_PROFILE = "no profile of Firth's likelihood converges"
    INFINITE_GAP = "a gap is not finite"
    STEADY_GAP = "the gaps vary by less than 1 cm: there is nothing to test"
    ONE_DECIDES = "a single trial decides a coefficient: no standard errors"
    FEW_PAIRS = "{} pairs are too few for errors by pair"
    WITHOUT_PAIR = "without {}: {}"
    BY_PAIRS = "errors by jackknife over {} pairs"
    NONE_APART = "no two played conditions differ in relative velocity alone"
    # Indicators.
    NO_ACTION = "no finished trial with control action"
    ONE_ACTION = "a single trial, or a single human pair, with control action"
    NO_TRACES = "as published, no human traces are imported"
    BY_EYE = "by eye, the paper"
    CAUTION = "{}"
    # Measures.
    CITED = "published, no human traces are imported ({})"
    PUBLISHED = "humans as published"
    NOT_PUBLISHED = "{}: no human value is published, and none is imported"
    OTHER_RULE = "{}: published human collisions are boxes that overlap"
    OUTCOMES = (
        "who merged first and {}: the {} published outcomes; the rest: {} imported trials, {} "
        "finished"
    )
    UNDECIDED = (
        "{}: {} of {} trials are undecided, since another collision rule ended them; between {} "
        "and {} %"
    )
    UNDECIDED_BOXES = (
        "by people's rule {0} to {1} of {2} trials crashed: {0} surely did, and of {3} that "
        "another crash rule ended it is not known. A study played by people's rule (collision_rule "
        '= "rectangle") decides them'
    )
    # Comparisons with humans.
    OF_HUMANS = "humans: {}"
    NONE_ENDED = "no trial ended: {}"
    ONE_GAP = "a single trial has no error"
    NO_GAP_THERE = "humans: no gap in {} of its conditions"
    NOBODY_THERE = "no human drove its conditions"
    NONE_ACTED = "accelerations held (I5) are not compared: no trial acted"
    FEW_HUMANS = (
        "accelerations held (I5) are not compared: no human recordings, or too few, are imported"
    )


class Fact(NamedTuple):
    """Remark of the statistics as a code with its values; as a text it is the sentence."""

    why: Why
    values: tuple[object, ...] = ()

    def __str__(self) -> str:
        texts = (number(v) if isinstance(v, float) else v for v in self.values)
        return self.why.value.format(*texts, s="" if self.values[:1] == (1,) else "s")


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

    ``trait`` names what humans do, ``label`` and ``unit`` head a column, ``rests_on`` is the column
    in which its trials have a value, or "finished", and ``rule`` says how its state is set.
    ``difference`` is a template of the headline, with the fields ``it`` (the driver's name),
    ``driver`` and ``people``: counts of trials, or values with their intervals. ``says`` has by
    state the driver's part of a sentence, with ``of``, ``humans`` and ``more`` or less. ``ends``
    are the limits of its axis. A driver is alike if it differs from the humans by less than
    ``margin``.
    """

    name: str
    trait: str
    label: str
    unit: str
    rests_on: str
    rule: str
    difference: str
    ends: tuple[float, float]
    says: Mapping[str, str] = field(default_factory=dict)
    margin: float | None = None


MEASURES = {
    measure.name: measure
    for measure in (
        Measure(
            "headway",
            "The one who is ahead goes first (I1)",
            "who goes first, by who is ahead",
            "log-odds per m",
            LEFT_FIRST.column,
            "Firth's fit: above 0, likelihood-ratio test at 5 %",
            "with {it} the one ahead went first in {driver} trials, with people in {people}",
            (-0.25, 2.5),
            {
                SHOWN: "the one ahead goes first, as with people",
                WEAKER: "who goes first depends less on who is ahead than with people",
                STRONGER: "who goes first depends more on who is ahead than with people",
            },
        ),
        Measure(
            "velocity",
            "The faster one yields (I2)",
            "who goes first, by who is faster",
            "log-odds per m/s",
            LEFT_FIRST.column,
            "Firth's fit: below 0, likelihood-ratio test at 5 %",
            "with {it} the slower one went first in {driver} trials side by side, with people in "
            "{people}",
            (-6.5, 3.0),
            {
                SHOWN: "the faster one yields, as with people",
                WEAKER: "who goes first depends less on who is slower than with people",
                STRONGER: "who goes first depends more on who is slower than with people",
            },
        ),
        Measure(
            "collisions",
            "Crashes by people's rule",
            "crashes",
            "% of trials",
            BOXES.column,
            "difference within 5 points by its interval; else corrected p below .05",
            "{it} crashed in {driver} trials, people in {people}",
            (0.0, 30.0),
        ),
        Measure(
            "gap",
            "Gap at the merge point",
            "mean gap",
            "m",
            GAP.column,
            "difference within 1 m by its interval; else corrected p below .05",
            "{it} left a gap of {driver} m, people of {people} m",
            (0.0, 8.0),
            {
                SHOWN: "leaves a gap of {of} m, like people ({humans} m)",
                WEAKER: "leaves a gap of {of} m, smaller than people ({humans} m)",
                STRONGER: "leaves a gap of {of} m, larger than people ({humans} m)",
            },
        ),
        Measure(
            "gap-headway",
            "More headway, more gap (I3)",
            "gap, by headway",
            "m per m",
            GAP.column,
            "HC3 errors: above 0 at 5 %",
            "with {it} each metre that one is ahead adds {driver} m to the gap, with people "
            "{people} m",
            (-0.6, 1.0),
            {
                WEAKER: "each metre that one is ahead adds less to its gap than to people's",
                STRONGER: "each metre that one is ahead adds more to its gap than to people's",
            },
        ),
        Measure(
            "gap-velocity",
            "Relative velocity leaves the gap as it is (I4)",
            "gap, by who is faster",
            "m at most",
            GAP.column,
            "HC3 errors: largest difference of predicted gaps within 1 m, two one-sided tests at "
            "5 %; not as with people: corrected p of being within below .05",
            "with {it} who is faster moves the gap by up to {driver} m, with people by {people} m",
            (0.0, 3.0),
            {UNLIKE: "who is faster moves its gap by {of} m"},
            margin=1.0,
        ),
        Measure(
            "held",
            "Accelerations are held, then jump (I5)",
            "accelerations held",
            "SD from humans",
            "finished",
            "within 0.5 SD, two one-sided tests at 5 %; not as with people: corrected p of being "
            "within below .05",
            "{it} holds its accelerations otherwise than people do, by {driver} of their SD",
            (-2.0, 3.0),
            {UNLIKE: "holds accelerations {more} than people"},
            margin=0.5,
        ),
    )
}
# The vehicle whose first mergers are counted, by measure.
FIRST = {"headway": "the one ahead", "velocity": "side by side, the slower one"}
# Measures that a person sees at once come first in a headline, fitted ones last.
SEEN_FIRST = ("collisions", "headway", "velocity", "gap", "gap-headway", "gap-velocity", "held")


def by_group(rows: Iterable[Any]) -> dict[str, dict[str, Values]]:
    """Return the values of a table's rows by the id of their driver and prompt, and by measure.

    ``row`` and ``note`` are added. A group that is not judged has one entry, without a measure.
    """
    groups: dict[str, dict[str, Values]] = {}
    for row in rows:
        values = {**row.values, "note": row.note, "row": row.id}
        groups.setdefault(row.groups[0], {})[row.values.get("measure") or ""] = values
    return groups


def sentences(rows: Iterable[Any]) -> list[str]:
    """Return the headline of a table's rows, then a sentence on each driver and prompt."""
    groups = by_group(rows)
    suffix = f"/{BASELINE}"
    drivers = {name: of for name, of in groups.items() if _kind(of) != HUMANS}
    answering = _models(drivers) or drivers
    # A study may call its first prompt otherwise.
    shown = {n.removesuffix(suffix): of for n, of in answering.items() if n.endswith(suffix)}
    return [
        " ".join(filter(None, headline(shown or answering))),
        *(f"{name}: {sentence(of)}" for name, of in drivers.items()),
    ]


def _kind(verdicts: Mapping[str, Values]) -> str:
    return str(next(iter(verdicts.values()))["kind"])


def _models(drivers: Mapping[str, Mapping[str, Values]]) -> dict[str, Mapping[str, Values]]:
    """Return the language models that are judged."""
    return {n: of for n, of in drivers.items() if _kind(of) == LANGUAGE_MODEL and "" not in of}


def sentence(verdicts: Mapping[str, Values]) -> str:
    """Return a few sentences that compare a driver with people: crashes, then measures."""
    if "" in verdicts:
        return f"{capital(verdicts['']['note'])}."
    parts = [crashes(verdicts["collisions"]), *map(_part, verdicts.values())]
    unclear = [
        MEASURES[name].label
        for name in ("headway", "velocity", "collisions", "gap")
        if shown_state(verdicts[name]) == OPEN
    ]
    if unclear:
        parts.append(f"cannot tell: {'; '.join(unclear)}")
    text = ". ".join(capital(part) for part in parts if part)
    return f"{text or 'Nothing can be compared with people'}."


def _part(values: Values) -> str:
    """Return the sentence part on a measure's state; empty where there is none."""
    says = MEASURES[str(values["measure"])].says.get(shown_state(values), "")
    of, humans = (number(values.get(name)) for name in ("estimate", "human"))
    counted, people = values.get("counted"), values.get("human_counted")
    says = says.format(of=of, humans=humans, more=_more(values))
    if not (says and counted and people):
        return says
    return f"{says} ({FIRST[str(values['measure'])]} in {counted} trials, people in {people})"


def _apart(values: Values) -> float:
    apart = values.get("difference")
    return (values.get("estimate") if apart is None else apart) or 0.0


def _more(values: Values) -> str:
    return "more" if _apart(values) > 0 else "less"


def crashes(values: Values) -> str:
    """Return the crashes by the rule that was played, then by the humans' where they differ.

    ``crashed in 15 of 22 trials; people in 28 of 990``, or empty where no trial ended.
    """
    k, undecided = values.get("k") or 0, values.get("undecided") or 0
    ended = (values["n"] or 0) + undecided
    if not ended:
        return ""
    seen = values.get("counted") or f"{k} of {ended}"
    text = f"crashed in {seen} trials"
    if undecided:
        rule = values.get("counted_by") or PLAYED_RULES["shared_lane"]
        text += f" by {rule}, in {k} to {k + undecided} by people's rule"
    people = values.get("human_counted")
    if shown_state(values) in DIFFERS:
        than = f" ({people})" if people else ""
        return f"{text}, {_more(values)} often than people{than}"
    return f"{text}; people in {people}" if people else text


def crash_text(rules: Sequence[tuple[str, Sequence[float]]]) -> str:
    """Return the meaning of a crash by the collision rules that were played, with their steps."""
    texts = []
    for rule, steps_s in rules:
        every = "simulation step, " * (len(steps_s) > 1) + " or ".join(map("{:g}".format, steps_s))
        text = f"{RULES_MEAN[rule]}, checked every {every} s"
        texts.append(text if rule == "rectangle" else f"{text} ({PLAYED_RULES[rule]})")
    return " or, by the scenario of the trial, ".join(texts)


def _percent(collisions: Values, count: int) -> float:
    ended = _ended(collisions)
    return 100 * count / ended if ended else 0.0


def apart(driver: str, other: str, rows: Mapping[str, Values], *, of_left: bool) -> tuple[str, str]:
    """Return the headline of a driver less another, and other differences, of rows by their metric.

    ``A crashed in 12 of 110 trials, B in 33 of 110. In the same situations A crashed less often, by
    19.09 points [8.41, 29.78]; corrected p = 0.004.`` Who goes first is said ``of_left`` vehicles.
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
    # Where trials are fewer, the ends change their signs and their places.
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
    parts = [f"Compared with {other}, {driver} {joined(shown)}."] if shown else []
    parts += [f"No difference is shown in {joined(unshown)}."] if unshown else []
    return " ".join(parts)


def share(collisions: Values) -> str:
    """Return a rate in percent, or ``13.64 to 68.18`` where trials are undecided."""
    k, undecided = collisions.get("k") or 0, collisions.get("undecided") or 0
    least = number(_percent(collisions, k))
    return f"{least} to {number(_percent(collisions, k + undecided))}" if undecided else least


def _suffice(trials: int, ended: int) -> bool:
    """Return whether this number of counted trials is enough for a verdict."""
    return trials >= ENOUGH and 2 * trials >= ended


def shown_state(values: Values) -> str:
    """Return a state as sentences and marks show it: too few trials are inconclusive.

    A difference that surely lies within its margin is like people's; one in a measure of SIGNS has
    a direction.
    """
    state = str(values.get("state") or "")
    if state and not _suffice(values.get("n") or 0, values.get("ended") or 0):
        return OPEN
    if _is_within(values):
        return SHOWN
    if state == UNLIKE and (sign := SIGNS.get(str(values["measure"]))):
        return STRONGER if sign * _apart(values) > 0 else WEAKER
    return state


def has_verdict(values: Values) -> bool:
    """Return whether a measure has a state that rests on enough trials."""
    n, ended = values.get("n") or 0, values.get("ended") or 0
    return bool(values.get("state")) and (_suffice(n, ended) or bool(values.get("undecided")))


def _is_within(values: Values) -> bool:
    """Return whether the interval of crashes or of a gap is within MARGINS of people's."""
    margin, ci = MARGINS.get(str(values.get("measure"))), values.get("difference_ci")
    return margin is not None and ci is not None and max(-ci[0], ci[1]) <= margin


def differs(values: Values) -> bool:
    """Return whether the driver is shown to differ from humans in a measure, beyond its margin."""
    return values.get("state") in DIFFERS and not _is_within(values)


def headline(drivers: Mapping[str, Mapping[str, Values]]) -> tuple[str, str]:
    """Return how drivers compare with people: the claim, and what else is seen at once.

    It is of the language models that are judged or, without one, of all ``drivers``, by name.
    Drivers with too few outcomes get only counts.
    """
    models = _models(drivers)
    if not models:
        return _without_models(drivers)
    compared = {name: of for name, of in models.items() if any(v.get("state") for v in of.values())}
    if not compared:
        return "No language model can be compared with people yet.", ""
    enough = {name: of for name, of in compared.items() if _enough(of)}
    few = {name: of for name, of in compared.items() if name not in enough}
    too_few = [_too_few(few, alone=len(models) == 1)] if few else []
    untold = [f"{name} {crashes(of['collisions'])}." for name, of in few.items()]
    if not enough:
        return " ".join(too_few), " ".join(untold)
    claim, because = _likeness(enough, every=len(enough) == len(models))
    return claim, " ".join(filter(None, [because, *too_few, *untold]))


def _without_models(drivers: Mapping[str, Mapping[str, Values]]) -> tuple[str, str]:
    """Return how many drivers are like people in each measure, and the extremes of several."""
    kinds = {_kind(of) for of in drivers.values()}
    who = f"No language model {'is judged' if LANGUAGE_MODEL in kinds else 'drove'} here."
    compared = {name: of for name, of in drivers.items() if "" not in of}
    if len(compared) < 2:
        return who, ""
    claims = [_tally([*compared.values()]), _extremes(compared), _few_trials(compared), who]
    if kinds == {PROGRAM}:
        claims.insert(0, _most_alike(compared))
    claim, *others = filter(None, claims)
    return claim, " ".join(others)


def _most_alike(drivers: Mapping[str, Mapping[str, Values]]) -> str:
    """Return which of several programs are most like people, and which one crashes most."""
    ranks = {
        name: (
            sum(shown_state(of[measure]) == SHOWN for measure in LIKENESS if measure in of),
            -sum(shown_state(of[measure]) in DIFFERS for measure in LIKENESS if measure in of),
        )
        for name, of in drivers.items()
        if any(map(has_verdict, of.values()))
    }
    like, unlike = best = max(ranks.values(), default=(0, 0))
    names = [name for name, rank in ranks.items() if rank == best]
    if not like or len(names) == len(ranks):
        return ""
    some = f"the {len(ranks)} programs with enough trials"
    which = some if len(ranks) < len(drivers) else f"{len(drivers)} programs"
    is_one = len(names) == 1
    named = [
        f"{name} (it was made from the human data)" if _is_from_humans(drivers[name]) else name
        for name in names
    ]
    claim = (
        f"Of {which} {joined(named)} {'is' if is_one else 'are'} most like people: "
        f"{'it agrees' if is_one else 'each agrees'} with them in {like} of {len(LIKENESS)} "
        f"measures, and is shown to differ in {-unlike or 'none'}."
    )
    rates = _crash_rates({name: of for name, of in drivers.items() if _is_judged(of)})
    most = [name for name, rate in rates.items() if rate == max(rates.values()) > 0]
    if len(most) != 1:
        return claim
    return f"{claim} Most crashes: {most[0]} {crashes(drivers[most[0]]['collisions'])}."


def _is_from_humans(verdicts: Mapping[str, Values]) -> bool:
    return any(values.get("from_humans") for values in verdicts.values())


def _is_judged(verdicts: Mapping[str, Values]) -> bool:
    """Return whether a driver has a verdict on crashes."""
    return "collisions" in verdicts and has_verdict(verdicts["collisions"])


def _few_trials(drivers: Mapping[str, Mapping[str, Values]]) -> str:
    """Return the counts of crashes of drivers without a verdict on them, beside others with one."""
    counts = [
        f"{name} crashed in {of['collisions']['counted']} trials"
        for name, of in drivers.items()
        if not _is_judged(of) and of.get("collisions", {}).get("counted")
    ]
    return f"Without a verdict: {'; '.join(counts)}." if 0 < len(counts) < len(drivers) else ""


def _crash_rates(drivers: Mapping[str, Mapping[str, Values]]) -> dict[str, float]:
    """Return the share of trials with a crash, of drivers of which both are counted."""
    counts = {name: of.get("collisions", {}).get("counted") for name, of in drivers.items()}
    parts = {name: text.split(" of ") for name, text in counts.items() if text}
    return {name: int(k) / int(n) for name, (k, n) in parts.items()}


def _tally(drivers: Sequence[Mapping[str, Values]]) -> str:
    """Return how many of the drivers with a verdict are like people, by measure."""
    like, unclear, unjudged = list[str](), list[str](), list[str]()
    for name, (does, what) in LIKENESS.items():
        states = [shown_state(of[name]) for of in drivers if name in of and has_verdict(of[name])]
        if not states:
            unjudged.append(what)
        elif {*states} == {OPEN}:
            unclear.append(what)
        else:
            who = " drivers" * (not like)
            few = " with enough trials" * (not like and len(states) < len(drivers))
            like.append(f"{states.count(SHOWN) or 'none'} of {len(states)}{who}{few} {does}")
    if not (like or unclear):
        return f"For {len(drivers)} drivers no verdict on likeness to people is possible."
    parts = [f"{'; '.join(like)}."] if like else []
    parts += [f"cannot tell: {joined(unclear)}."] if unclear else []
    parts += [f"no verdict on {joined(unjudged)}."] if unjudged else []
    return " ".join(map(capital, parts))


def _extremes(drivers: Mapping[str, Mapping[str, Values]]) -> str:
    """Return the fewest and most crashes, and the smallest and largest gap, of many drivers.

    Drivers without a verdict are left out.
    """
    drivers = {name: of for name, of in drivers.items() if _is_judged(of)}
    crashed = {
        f"{drivers[name]['collisions']['counted']} trials ({name})": rate
        for name, rate in _crash_rates(drivers).items()
    }
    gaps = {}
    for name, of in drivers.items():
        values = of.get("gap", {})
        gap = values.get("estimate")
        if gap is not None and has_verdict(values):
            gaps[f"{number(gap)} m ({name})"] = gap
    parts = [
        f"{what} from {min(of, key=lambda text: of[text])} to {max(of, key=lambda text: of[text])}"
        for what, of in (("crashes range", crashed), ("mean gaps", gaps))
        if len(of) > FEW and len({*of.values()}) > 1
    ]
    return f"{capital(', '.join(parts))}." if parts else ""


def _likeness(drivers: Mapping[str, Mapping[str, Values]], *, every: bool) -> tuple[str, str]:
    """Return both parts of a headline on drivers with enough trials; ``every``: on all drivers."""
    unlike = {name: differences for name, of in drivers.items() if (differences := _differing(of))}
    untold = [
        f"{name} {crashes(of['collisions'])}."
        for name, of in drivers.items()
        if of["collisions"].get("undecided")
    ]
    alike = [name for name in drivers if name not in unlike]
    if not unlike:
        return f"No difference from people is shown for {joined(alike)}.", " ".join(untold)
    names = sorted(unlike, key=lambda name: _seen_first(unlike[name][0]))
    if len(names) == 1:
        claim = f"{names[0]} differs from people: {difference_sentence(unlike[names[0]][0], 'it')}."
    else:
        is_all = every and not alike
        count = "Both" if len(names) == 2 else f"All {len(names)}"
        who = f"{count} language models here" if is_all else joined(names)
        reasons = [difference_sentence(unlike[name][0], name) for name in names[:FEW]]
        most = " most visibly" * (len(names) > FEW)
        claim = f"{who} differ from people:{most} {'; '.join(reasons)}."
    if alike:
        untold.insert(0, f"No difference from people is shown for {joined(alike)}.")
    return claim, " ".join(untold)


def _seen_first(values: Values) -> tuple[int, float]:
    """Return the place of a difference among others: what is seen at once, then what is surest."""
    return SEEN_FIRST.index(str(values["measure"])), values["p_holm"]


def _differing(verdicts: Mapping[str, Values]) -> list[Values]:
    """Return the differing measures that rest on most trials, what is seen at once first."""
    unlike = [values for values in verdicts.values() if differs(values) and _most(values, verdicts)]
    return sorted(unlike, key=_seen_first)


def _most(values: Values, verdicts: Mapping[str, Values]) -> bool:
    """Return whether a measure has enough trials, and at least half of those that ended."""
    return _suffice(values["n"] or 0, _ended(verdicts["collisions"]))


def _ended(collisions: Values) -> int:
    """Return the number of trials that ended, also undecided ones."""
    return (collisions["n"] or 0) + (collisions.get("undecided") or 0)


def _finished(verdicts: Mapping[str, Values]) -> int:
    return verdicts["gap"]["n"] or 0


def _enough(verdicts: Mapping[str, Values]) -> bool:
    """Return whether enough trials finished, or collided by the humans' rule, for a headline.

    A driver that differs in measures of too few trials alone is not said to be alike.
    """
    outcomes = _finished(verdicts) + (verdicts["collisions"].get("k") or 0)
    if not _suffice(outcomes, _ended(verdicts["collisions"])):
        return False
    return bool(_differing(verdicts)) or not any(map(differs, verdicts.values()))


def _too_few(drivers: Mapping[str, Mapping[str, Values]], *, alone: bool) -> str:
    """Return how many trials of each driver had no crash, of those that ended."""
    counts = [
        f"{'' if alone else name} {_finished(of)} of {_ended(of['collisions'])}".strip()
        for name, of in drivers.items()
    ]
    return f"{TOO_FEW}: {joined(counts)}."


def difference_sentence(values: Values, it: str) -> str:
    """Return a difference as ``it crashed in 24 of 110 trials, people in 28 of 990``.

    Without counts of who goes first it is the sentence part of the state. A driver's interval
    beside a margin has the level of its row, which is named if not 95 %.
    """
    measure = MEASURES[str(values["measure"])]
    driver, people = values.get("counted"), values.get("human_counted")
    if driver is None or people is None:
        if measure.name in {"headway", "velocity"}:
            return _part(values)
        driver = with_interval(values["estimate"], values["ci"])
        people = with_interval(values["human"], values["human_ci"])
        if measure.name == "collisions":
            driver, people = f"{driver} % of its", f"{people} %"
    level = values.get("level") if measure.margin is not None and values["ci"] else None
    at = "" if level is None or f"{level:.4g}" == "95" else f" (interval at {level:.4g} %)"
    return f"{measure.difference.format(it=it, driver=driver, people=people)}{at}"


def with_interval(value: float | None, ci: Sequence[float] | None) -> str:
    """Return ``68.18 [47.32, 83.64]``, or an en dash without a value."""
    return number(value) if value is None else f"{number(value)} {brackets(ci)}".rstrip()


def number(value: float | None, decimals: int = DECIMALS, unit: str = "") -> str:
    """Return a number as pages print it: with a true minus sign, and never minus zero."""
    return MISSING if value is None else f"{value:z.{decimals}f}{unit}".replace("-", MINUS)


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
        return f"fewer than {ENOUGH} trials" if n < ENOUGH else "too few without a crash"
    words = VERDICTS | DIRECTIONS.get(str(values.get("measure")), {})
    return words.get(shown_state(values), "not compared")


def joined(items: Sequence[str]) -> str:
    """Return items as ``a, b and c``."""
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}"


def capital(text: str) -> str:
    """Return the text with a capital letter at its beginning."""
    return text[:1].upper() + text[1:]
