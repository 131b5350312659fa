"""What is judged of a driver beside the humans, and the sentences that verdicts are told in.

Nothing here computes: sentences read the finished rows of the table ``verdicts``, so that a page, a
report and a terminal say the same. pandas is not needed to read them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from merge_runner_analysis.names import BASELINE

TABLE = "verdicts"
# Kinds of drivers: language models are in the headline, scripts that pose as one are not.
HUMANS, LANGUAGE_MODEL, PROGRAM, MOCK = "humans", "language model", "program", "mock"
# States. A trait is shown by its own test; the others need a difference whose interval excludes 0.
SHOWN, WEAKER, STRONGER, UNLIKE, OPEN = "shown", "weaker", "stronger", "unlike", "inconclusive"
DIFFERS = frozenset({WEAKER, STRONGER, UNLIKE})
MOST_COLLISIONS = 25.0  # percent; with more of them collisions come first in a sentence

Values = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Measure:
    """One thing that a driver is compared with the humans by.

    ``trait`` names what humans do, ``label`` and ``unit`` head a column, ``counts`` is the SQL
    predicate of its trials and ``rule`` says how its state is set. ``told`` is the sentence of a
    difference, with the fields ``of`` (driver) and ``humans``, each a value with its interval, and
    ``decimals`` are those of its values there. ``ends`` are those of its axis. ``margin``: so far
    from the humans it still is alike.
    """

    name: str
    trait: str
    label: str
    unit: str
    counts: str
    rule: str
    told: str
    ends: tuple[float, float]
    decimals: int = 1
    margin: float | None = None

    @property
    def is_slope(self) -> bool:
        """Whether it is a term of a regression, which an indicator tests."""
        return self.name not in {"collisions", "gap", "held"}


MERGED = "status = 'finished' AND merged_first IS NOT NULL"
# Those that are undecided count, too; what the first part names is a share with a numerator.
ENDED = "(collided_boxes IS NOT NULL OR status <> 'failed')"
WITH_GAP = "status = 'finished' AND gap_m IS NOT NULL"
MEASURES = {
    measure.name: measure
    for measure in (
        Measure(
            "headway",
            "The one who is ahead goes first (I1)",
            "who goes first by headway",
            "log-odds per m",
            MERGED,
            "Firth's fit: above 0, likelihood-ratio test at 5 %",
            "gains {of} log-odds of going first per m of headway, humans {humans}",
            (-0.25, 2.5),
        ),
        Measure(
            "velocity",
            "The faster one yields (I2)",
            "who goes first by relative velocity",
            "log-odds per m/s",
            MERGED,
            "Firth's fit: below 0, likelihood-ratio test at 5 %",
            "changes its log-odds of going first by {of} per m/s of relative velocity, humans by "
            "{humans}",
            (-6.5, 3.0),
        ),
        Measure(
            "collisions",
            "Collisions by the humans' rule",
            "collisions",
            "% of trials",
            ENDED,
            "the difference excludes 0",
            "collides in {of} % of trials, humans in {humans} %",
            (0.0, 30.0),
        ),
        Measure(
            "gap",
            "Gap at the merge point",
            "gap",
            "m",
            WITH_GAP,
            "the difference excludes 0",
            "leaves a gap of {of} m, humans {humans} m",
            (0.0, 8.0),
        ),
        Measure(
            "gap-headway",
            "More headway, more gap (I3)",
            "gap by headway",
            "m per m",
            WITH_GAP,
            "HC3 errors: above 0 at 5 %",
            "leaves {of} m more per m of headway, humans {humans} m",
            (-0.6, 1.0),
            decimals=2,
        ),
        Measure(
            "gap-velocity",
            "Relative velocity leaves the gap as it is (I4)",
            "gap by relative velocity",
            "m at 0.8 m/s",
            WITH_GAP,
            "HC3 errors: within 1 m in two one-sided tests; unlike where the interval is beyond it",
            "changes its gap by {of} m at 0.8 m/s of relative velocity, humans by {humans} m",
            (-3.0, 2.0),
            margin=1.0,
        ),
        Measure(
            "held",
            "Accelerations are held, then jump (I5)",
            "accelerations held",
            "SD from humans",
            "status = 'finished'",
            "the interval within 0.5 SD of the humans, or beyond it",
            "holds its accelerations {of} human SD more than humans do",
            (-2.0, 3.0),
            margin=0.5,
        ),
    )
}
WHO_FIRST = {
    "headway": {
        SHOWN: "goes first by headway as humans do",
        WEAKER: "goes first by headway, less than humans",
        STRONGER: "goes first by headway, more than humans",
        UNLIKE: "does not go first by headway as humans do",
    },
    "velocity": {
        SHOWN: "when faster, yields as humans do",
        WEAKER: "when faster, yields less than humans",
        STRONGER: "when faster, yields more than humans",
        UNLIKE: "when faster, does not yield as humans do",
    },
}


def by_group(rows: Iterable[Any]) -> dict[str, dict[str, Values]]:
    """The values of a table's rows by the id of their driver and prompt, and by measure.

    ``row`` and ``note`` are added. A group that is not judged has one entry, without a measure.
    """
    found: dict[str, dict[str, Values]] = {}
    for row in rows:
        values = {**row.values, "note": row.note, "row": row.id}
        found.setdefault(row.groups[0], {})[row.values.get("measure") or ""] = values
    return found


def sentences(rows: Iterable[Any]) -> list[str]:
    """The headline of a table's rows, then a sentence on each driver and prompt."""
    groups = by_group(rows)
    kinds = {name: next(iter(of.values()))["kind"] for name, of in groups.items()}
    judged = {
        name: of for name, of in groups.items() if kinds[name] == LANGUAGE_MODEL and "" not in of
    }
    baselines = {
        name.removesuffix(f"/{BASELINE}"): of
        for name, of in judged.items()
        if name.endswith(f"/{BASELINE}")
    }
    models = baselines or judged  # a study may call its first prompt otherwise
    return [
        " ".join(filter(None, headline(models))),
        *(f"{name}: {sentence(of)}" for name, of in groups.items() if kinds[name] != HUMANS),
    ]


def sentence(verdicts: Mapping[str, Values]) -> str:
    """One driver beside the humans in a sentence or a few, of the states of its measures."""
    if "" in verdicts:
        return f"{capital(verdicts['']['note'])}."
    state = {name: values.get("state") for name, values in verdicts.items()}
    parts = [_who_first(state), _collides(verdicts), _leaves(verdicts), _holds(verdicts)]
    if _least_percent(verdicts["collisions"]) > MOST_COLLISIONS:
        parts[:2] = parts[1::-1]
    unclear = [
        MEASURES[name].label
        for name in ("headway", "velocity", "collisions", "gap")
        if state.get(name) == OPEN
    ]
    if unclear:
        parts.append(f"{joined(unclear)}: no difference shown")
    text = ". ".join(capital(part) for part in parts if part)
    return f"{text or 'Nothing can be compared with humans'}."


def _who_first(state: Mapping[str, Any]) -> str:
    if state.get("headway") == state.get("velocity") == SHOWN:
        return "goes first as humans do"
    told = [texts.get(str(state.get(name)), "") for name, texts in WHO_FIRST.items()]
    return "; ".join(filter(None, told))


def _collides(verdicts: Mapping[str, Values]) -> str:
    found = verdicts["collisions"]
    return f"collides in {share(found, 0)} % of trials" if differs(found) else ""


def _least_percent(collisions: Values) -> float:
    return 100 * (collisions["k"] or 0) / collisions["n"] if collisions["n"] else 0.0


def share(collisions: Values, decimals: int = 1) -> str:
    """A rate in percent, or ``14 to 68`` where trials are undecided."""
    least = _least_percent(collisions)
    if not collisions.get("undecided"):
        return number(least, decimals)
    most = least + 100 * collisions["undecided"] / collisions["n"]
    return f"{number(least, decimals)} to {number(most, decimals)}"


def _leaves(verdicts: Mapping[str, Values]) -> str:
    found = verdicts["gap"]
    if not differs(found):
        return ""
    return f"leaves {found['estimate']:.1f} m, humans {found['human']:.1f} m"


def _holds(verdicts: Mapping[str, Values]) -> str:
    found = verdicts["held"]
    if not differs(found):
        return ""
    return f"holds accelerations {'more' if found['estimate'] > 0 else 'less'}"


def differs(values: Values) -> bool:
    """Whether the driver is shown to differ from the humans in a measure."""
    return values.get("state") in DIFFERS


def strongest(verdicts: Mapping[str, Values]) -> Values | None:
    """The difference that is surest of a driver's, by its corrected p; None where none is shown."""
    return min((one for one in verdicts.values() if differs(one)), key=_p, default=None)


def headline(drivers: Mapping[str, Mapping[str, Values]]) -> tuple[str, str]:
    """The answer of language models in two parts: the claim, and what it rests on most.

    ``drivers`` are those that are judged, by name: no mock model and no program.
    """
    compared = [name for name, of in drivers.items() if any(v.get("state") for v in of.values())]
    unlike = {name: found for name, of in drivers.items() if (found := strongest(of)) is not None}
    if not drivers:
        return "No language model is judged here.", ""
    if not compared:
        return "No language model can be compared with humans yet.", ""
    if not unlike:
        return f"No difference from humans is shown for {joined(compared)}.", ""
    name, found = min(unlike.items(), key=lambda one: _p(one[1]))
    rest = f"{name} {told(found)}."
    if len(drivers) == 1:
        return f"{name} does not drive like humans:", f"it {told(found)}."
    others = [name for name in compared if name not in unlike]
    if not others:
        return "No language model here drives like humans:", rest
    return f"No difference from humans is shown for {joined(others)};", f"but {rest}"


def _p(values: Values) -> float:
    """The corrected p; that of I5, which has none, is the largest."""
    found = values.get("p_holm")
    return 1.0 if found is None else float(found)


def told(values: Values) -> str:
    """The sentence of one difference: ``collides in 68 % [47, 84] of trials, humans in ...``."""
    measure = MEASURES[str(values["measure"])]
    of = with_interval(values["estimate"], values["ci"], measure.decimals)
    if values.get("undecided"):
        of = share(values)
    humans = with_interval(values["human"], values["human_ci"], measure.decimals)
    return measure.told.format(of=of, humans=humans)


def with_interval(value: float | None, ci: Sequence[float] | None, decimals: int) -> str:
    """``68.2 [47.3, 83.6]``; an en dash where there is no value."""
    if value is None:
        return "–"
    ends = "" if ci is None else f" [{number(ci[0], decimals)}, {number(ci[1], decimals)}]"
    return f"{number(value, decimals)}{ends}"


def number(value: float, decimals: int) -> str:
    """A number with a true minus sign, and never minus zero."""
    text = f"{value:.{decimals}f}"
    return text.lstrip("-") if not float(text) else text.replace("-", "−")


def verdict_word(values: Values) -> str:
    """A state in words, as it stands in a list of verdicts."""
    state, name = values.get("state"), str(values["measure"])
    if not state:
        return "not judged"
    if name in {"collisions", "gap"}:
        if state == OPEN:
            return "no difference shown"
        more = "more" if (values["difference"] or 0.0) > 0 else "less"
        return f"{'fewer' if (more, name) == ('less', 'collisions') else more} than humans"
    return {SHOWN: "as in humans", UNLIKE: "unlike humans"}.get(str(state), str(state))


def joined(items: Sequence[str]) -> str:
    """``a, b and c``."""
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}"


def capital(text: str) -> str:
    """The text with a capital letter at its beginning."""
    return text[:1].upper() + text[1:]
