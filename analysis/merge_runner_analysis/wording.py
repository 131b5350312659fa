"""What is judged of a driver beside the humans, and the sentences that verdicts are told in.

Nothing here computes: sentences read the finished rows of the table ``verdicts``, so that a page, a
report and a terminal say the same. pandas is not needed to read them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, NamedTuple

from merge_runner.study.file import BASELINE
from merge_runner_analysis.metrics import BOXES, DECIMALS, GAP, LEFT_FIRST

TABLE = "verdicts"
# Kinds of drivers: language models are in the headline, scripts that pose as one are not.
HUMANS, LANGUAGE_MODEL, PROGRAM, MOCK = "humans", "language model", "program", "mock"
# States. A trait is shown by its own test; the others need a difference with a corrected p < .05.
SHOWN, WEAKER, STRONGER, UNLIKE, OPEN = "shown", "weaker", "stronger", "unlike", "inconclusive"
DIFFERS = frozenset({WEAKER, STRONGER, UNLIKE})
ENOUGH = 20  # trials with an outcome; with fewer of them a headline says nothing of likeness
MOST_COLLISIONS = 25.0  # percent; with more of them collisions come first in a sentence
MISSING, MINUS = "–", "−"

Values = Mapping[str, Any]


class Why(Enum):
    """Why a number is missing, or what is to be known of it, with places for its values."""

    # Fits; ``s`` makes a plural of the first value.
    NO_FIRST = "no finished trial with a first merger"
    NO_GAP = "no finished trial with a gap"
    FEW_FIRST = (
        "{} finished trial{s} with a first merger, too few or in too few conditions to tell the "
        "terms apart"
    )
    FEW_GAPS = (
        "{} finished trial{s} with a gap, too few or in too few conditions to tell the terms apart"
    )
    SAME_FIRST = "who merged first is the same in all {} trials: nothing to explain"
    SEPARATION = "separation: no finite estimate of {}; see Firth's fit"
    NO_LIKELIHOOD = "the maximum likelihood fit does not converge"
    NO_FIRTH = "Firth's penalised fit does not converge"
    NO_PROFILE = "no profile of Firth's likelihood converges"
    INFINITE_GAP = "a gap is not finite"
    STEADY_GAP = "the gaps vary by less than 1 cm: there is nothing to test"
    ONE_DECIDES = "a single trial decides a coefficient: no HC3 errors"
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
        UNDECIDED + '. A study whose [scenario] has collision_rule = "rectangle" decides them'
    )
    # Comparisons with humans.
    OF_HUMANS = "humans: {}"
    NONE_ENDED = "no trial ended: {}"
    ONE_GAP = "a single trial has no error"
    NO_GAP_THERE = "humans: no gap in {} of its conditions"
    NOBODY_THERE = "no human drove its conditions"
    NONE_ACTED = "I5 is not compared: no trial acted"
    FEW_HUMANS = "I5 is not compared: too few human recordings are imported"


class Fact(NamedTuple):
    """What statistics have to say, as a code with its values; as a text it is the sentence."""

    why: Why
    values: tuple[object, ...] = ()

    def __str__(self) -> str:
        told = (number(v) if isinstance(v, float) else v for v in self.values)
        return self.why.value.format(*told, s="" if self.values[:1] == (1,) else "s")


def note_of(*remarks: object) -> str:
    """The note of these remarks, without those that are empty."""
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
    """One thing that a driver is compared with the humans by.

    ``trait`` names what humans do, ``label`` and ``unit`` head a column, ``rests_on`` is the column
    in which its trials have a value, or "finished", and ``rule`` says how its state is set.
    ``told`` is the sentence of a difference, with the fields ``of`` (driver) and ``humans``, each a
    value with its interval. ``says`` has by state the driver's part of a sentence, with the fields
    ``of``, ``humans``, its ``rate`` and ``more`` or less. ``ends`` are those of its axis.
    ``margin``: so far from 0, where the humans are, it still is alike.
    """

    name: str
    trait: str
    label: str
    unit: str
    rests_on: str
    rule: str
    told: str
    ends: tuple[float, float]
    says: Mapping[str, str] = field(default_factory=dict)
    margin: float | None = None


def _trait(does: str, does_not: str) -> dict[str, str]:
    """The driver's part of a sentence by the state of a trait that humans have."""
    return {
        SHOWN: f"{does} as humans do",
        WEAKER: f"{does} less than humans",
        STRONGER: f"{does} more than humans",
        UNLIKE: f"{does_not} as humans do",
    }


MEASURES = {
    measure.name: measure
    for measure in (
        Measure(
            "headway",
            "The one who is ahead goes first (I1)",
            "who goes first by headway",
            "log-odds per m",
            LEFT_FIRST.column,
            "Firth's fit: above 0, likelihood-ratio test at 5 %",
            "gains {of} log-odds of going first per m of headway, humans {humans}",
            (-0.25, 2.5),
            _trait("goes first by headway", "does not go first by headway"),
        ),
        Measure(
            "velocity",
            "The faster one yields (I2)",
            "who goes first by relative velocity",
            "log-odds per m/s",
            LEFT_FIRST.column,
            "Firth's fit: below 0, likelihood-ratio test at 5 %",
            "changes its log-odds of going first by {of} per m/s of relative velocity, humans by "
            "{humans}",
            (-6.5, 3.0),
            _trait("when faster, yields", "when faster, does not yield"),
        ),
        Measure(
            "collisions",
            "Collisions by the humans' rule",
            "collisions",
            "% of trials",
            BOXES.column,
            "corrected p below .05",
            "collides in {of} % of trials, humans in {humans} %",
            (0.0, 30.0),
            {UNLIKE: "collides in {rate} % of trials"},
        ),
        Measure(
            "gap",
            "Gap at the merge point",
            "mean gap",
            "m",
            GAP.column,
            "corrected p below .05",
            "leaves a gap of {of} m, humans {humans} m",
            (0.0, 8.0),
            {UNLIKE: "leaves {of} m, humans {humans} m"},
        ),
        Measure(
            "gap-headway",
            "More headway, more gap (I3)",
            "gap by headway",
            "m per m",
            GAP.column,
            "HC3 errors: above 0 at 5 %",
            "leaves {of} m more per m of headway, humans {humans} m",
            (-0.6, 1.0),
            {
                WEAKER: "leaves less gap per headway than humans",
                STRONGER: "leaves more gap per headway than humans",
                UNLIKE: "leaves less gap per headway than humans",
            },
        ),
        Measure(
            "gap-velocity",
            "Relative velocity leaves the gap as it is (I4)",
            "gap moved by relative velocity",
            "m at most",
            GAP.column,
            "HC3 errors: largest difference of predicted gaps within 1 m, two one-sided tests at "
            "5 %; unlike: corrected p of being within below .05",
            "moves its gap by up to {of} m by relative velocity alone, humans by up to {humans} m",
            (0.0, 3.0),
            {UNLIKE: "moves its gap by {of} m by relative velocity alone"},
            margin=1.0,
        ),
        Measure(
            "held",
            "Accelerations are held, then jump (I5)",
            "accelerations held",
            "SD from humans",
            "finished",
            "within 0.5 SD, two one-sided tests at 5 %; unlike: corrected p of being within below "
            ".05",
            "holds its accelerations {of} human SD more than humans do",
            (-2.0, 3.0),
            {UNLIKE: "holds accelerations {more}"},
            margin=0.5,
        ),
    )
}


def by_group(rows: Iterable[Any]) -> dict[str, dict[str, Values]]:
    """The values of a table's rows by the id of their driver and prompt, and by measure.

    ``row`` and ``note`` are added. A group that is not judged has one entry, without a measure.
    """
    groups: dict[str, dict[str, Values]] = {}
    for row in rows:
        values = {**row.values, "note": row.note, "row": row.id}
        groups.setdefault(row.groups[0], {})[row.values.get("measure") or ""] = values
    return groups


def sentences(rows: Iterable[Any]) -> list[str]:
    """The headline of a table's rows, then a sentence on each driver and prompt."""
    groups = by_group(rows)
    kinds = {name: next(iter(of.values()))["kind"] for name, of in groups.items()}
    judged = {n: of for n, of in groups.items() if kinds[n] == LANGUAGE_MODEL and "" not in of}
    suffix = f"/{BASELINE}"
    # A study may call its first prompt otherwise.
    models = {n.removesuffix(suffix): of for n, of in judged.items() if n.endswith(suffix)}
    return [
        " ".join(filter(None, headline(models or judged))),
        *(f"{name}: {sentence(of)}" for name, of in groups.items() if kinds[name] != HUMANS),
    ]


def sentence(verdicts: Mapping[str, Values]) -> str:
    """One driver beside the humans in a sentence or a few, of the states of its measures."""
    if "" in verdicts:
        return f"{capital(verdicts['']['note'])}."
    state = {name: values.get("state") for name, values in verdicts.items()}
    parts = {name: _part(values) for name, values in verdicts.items()}
    if state.get("headway") == state.get("velocity") == SHOWN:
        parts |= {"headway": "goes first as humans do", "velocity": ""}
    if _percent(verdicts["collisions"], verdicts["collisions"].get("k") or 0) > MOST_COLLISIONS:
        parts = {"collisions": parts["collisions"], **parts}
    unclear = [
        MEASURES[name].label + _between(verdicts[name])
        for name in ("headway", "velocity", "collisions", "gap")
        if state.get(name) == OPEN
    ]
    if unclear:
        parts["unclear"] = f"{joined(unclear)}: {OPEN}"
    text = ". ".join(capital(part) for part in parts.values() if part)
    return f"{text or 'Nothing can be compared with humans'}."


def _part(values: Values) -> str:
    says = MEASURES[str(values["measure"])].says.get(str(values.get("state")), "")
    of, humans = (number(values.get(name)) for name in ("estimate", "human"))
    more = "more" if (values.get("estimate") or 0.0) > 0 else "less"
    return says.format(of=of, humans=humans, more=more, rate=share(values))


def _between(values: Values) -> str:
    """Of a rate with undecided trials, what it lies between."""
    return f" ({share(values)} % of trials)" if values.get("undecided") else ""


def _percent(collisions: Values, count: int) -> float:
    """So many trials in percent of all that ended, with the undecided ones."""
    ended = (collisions["n"] or 0) + (collisions.get("undecided") or 0)
    return 100 * count / ended if ended else 0.0


def share(collisions: Values) -> str:
    """A rate in percent, or ``13.64 to 68.18`` where trials are undecided."""
    k, undecided = collisions.get("k") or 0, collisions.get("undecided") or 0
    least = number(_percent(collisions, k))
    return f"{least} to {number(_percent(collisions, k + undecided))}" if undecided else least


def differs(values: Values) -> bool:
    """Whether the driver is shown to differ from the humans in a measure."""
    return values.get("state") in DIFFERS


def headline(drivers: Mapping[str, Mapping[str, Values]]) -> tuple[str, str]:
    """The answer of language models in two parts: the claim, and what it rests on most.

    ``drivers`` are those that are judged, by name: no mock model and no program. Of those with
    too few outcomes it says the counts alone; of several others how many comparisons it rests on.
    """
    if not drivers:
        return "No language model is judged here.", ""
    compared = {
        name: of for name, of in drivers.items() if any(v.get("state") for v in of.values())
    }
    if not compared:
        return "No language model can be compared with humans yet.", ""
    few = [name for name, of in compared.items() if _outcomes(of) < ENOUGH]
    enough = {name: of for name, of in compared.items() if name not in few}
    uncertain = _too_few({name: compared[name] for name in few}) if few else ""
    if not enough:
        return uncertain, ""
    claim, because = _likeness(enough, every=len(enough) == len(drivers))
    return claim, " ".join(filter(None, [because, uncertain]))


def _likeness(drivers: Mapping[str, Mapping[str, Values]], *, every: bool) -> tuple[str, str]:
    """The two parts of a headline on drivers with trials enough; ``every``: there are no others."""
    unlike = [
        (name, values) for name, of in drivers.items() for values in filter(differs, of.values())
    ]
    count = _count(drivers, len(unlike)) if len(drivers) > 1 else ""
    if not unlike:
        return f"No difference from humans is shown for {joined([*drivers])}.", count
    name, values = min(unlike, key=lambda one: one[1]["p_holm"])  # the surest one
    if others := [name for name in drivers if name not in dict(unlike)]:
        claim = f"No difference from humans is shown for {joined(others)};"
        return claim, f"but {name} {told(values)}. {count}"
    if len(drivers) == 1:
        return f"{name} does not drive like humans:", f"it {told(values)}."
    claim = "No language model here drives like humans:"
    if not every:
        claim = f"{joined([*drivers])} do not drive like humans:"
    return claim, f"{name} {told(values)}. {count}"


def _finished(verdicts: Mapping[str, Values]) -> int:
    """How many trials finished: each of them has a gap."""
    return verdicts["gap"]["n"] or 0


def _outcomes(verdicts: Mapping[str, Values]) -> int:
    """How many trials finished, or collided by the humans' rule."""
    return _finished(verdicts) + (verdicts["collisions"].get("k") or 0)


def _too_few(drivers: Mapping[str, Mapping[str, Values]]) -> str:
    """How many trials of each driver finished, and that these tell nothing of likeness."""
    counts = []
    for name, of in drivers.items():
        finished = _finished(of)
        ended = (of["collisions"]["n"] or 0) + (of["collisions"].get("undecided") or 0)
        trials = "finished trial" if finished == 1 else "finished trials"
        others = f" of {ended}" if ended > finished else ""
        counts.append(f"{name}: {finished} {trials}{others}")
    them = "it drives" if len(counts) == 1 else "they drive"
    return f"{joined(counts)}, too few to say whether {them} like humans."


def _count(drivers: Mapping[str, Mapping[str, Values]], unlike: int) -> str:
    """How many comparisons a headline rests on, and how they are corrected."""
    tested = sum(v.get("p_holm") is not None for of in drivers.values() for v in of.values())
    return (
        f"{unlike} of {tested} comparisons with humans show a difference at 5 %, corrected by Holm "
        f"within each of {len(drivers)} models."
    )


def told(values: Values) -> str:
    """The sentence of one difference: ``collides in 68.18 [47.32, 83.64] % ... (n = 22)``.

    A driver's interval beside a margin has the level of its row, which is named if not 95 %.
    """
    measure = MEASURES[str(values["measure"])]
    of = with_interval(values["estimate"], values["ci"])
    level = values.get("level") if measure.margin is not None and values["ci"] else None
    own = "" if level is None or f"{level:.4g}" == "95" else f"; its interval at {level:.4g} %"
    humans = with_interval(values["human"], values["human_ci"])
    return f"{measure.told.format(of=of, humans=humans)} (n = {values['n']}{own})"


def with_interval(value: float | None, ci: Sequence[float] | None) -> str:
    """``68.18 [47.32, 83.64]``; an en dash where there is no value."""
    return number(value) if value is None else f"{number(value)} {brackets(ci)}".rstrip()


def brackets(ci: Sequence[float] | None) -> str:
    """``[47.32, 83.64]``, or nothing."""
    return "" if ci is None else f"[{', '.join(map(number, ci))}]"


def number(value: float | None, decimals: int = DECIMALS, unit: str = "") -> str:
    """A number as pages and sentences print it: with a true minus sign, and never minus zero."""
    return MISSING if value is None else f"{value:z.{decimals}f}{unit}".replace("-", MINUS)


def p_value(p: float | None) -> str:
    """A p of three decimals, or that it is smaller."""
    return "<0.001" if p is not None and p < 0.001 else number(p, 3)


def verdict_word(values: Values) -> str:
    """A state in words, as it stands in a list of verdicts."""
    state, name = values.get("state"), str(values["measure"])
    if not state:
        return "not judged"
    if name in {"collisions", "gap"} and state != OPEN:
        more = "more" if (values["difference"] or 0.0) > 0 else "less"
        return f"{'fewer' if (more, name) == ('less', 'collisions') else more} than humans"
    return {SHOWN: "as in humans", UNLIKE: "unlike humans"}.get(str(state), str(state))


def joined(items: Sequence[str]) -> str:
    """``a, b and c``."""
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}"


def capital(text: str) -> str:
    """The text with a capital letter at its beginning."""
    return text[:1].upper() + text[1:]
