"""What puts the results of a study in doubt, in words."""

from __future__ import annotations

from dataclasses import dataclass

from analysis.data.provenance import Mismatch, Provenance, tally
from analysis.data.study import Group, Study
from merge_runner.drivers.registry import EMULATOR

MANY_FALLBACKS = 0.05


@dataclass(frozen=True, slots=True)
class Alarm:
    """What a reader must know before any number."""

    title: str
    text: str


def alarms(study: Study, origin: Provenance) -> list[Alarm]:
    """What puts the results of a study in doubt, the worst first."""
    found = (
        ("A scripted stand-in answered", _posing(study)),
        ("Repetitions are the same trial", _repeated(study)),
        ("Some trials are equal", _equal(study)),
        ("The human trials are another data set", _other_humans(study)),
        ("Answers are word for word as before", _alike(origin)),
        ("Trials failed", _failed(study)),
        ("Many fallbacks", _fallbacks(study)),
        ("Attempts of unknown fate", _unknown(study)),
        ("Several settings under one name", _mixed(study)),
    )
    return [
        *(Alarm("Another model answered", mismatch(one)) for one in origin.mismatches),
        *(Alarm(title, text) for title, text in found if text),
    ]


def mismatch(one: Mismatch) -> str:
    """Who answered in the place of whom, how often, and in which sweeps."""
    answers = f"{one.answers} answer{'s' * (one.answers != 1)}"
    sweeps = f"sweep{'s' * (len(one.sweeps) != 1)} {', '.join(one.sweeps) or 'unknown'}"
    return (
        f"{one.requested} was asked for, {one.served} answered: {answers}, {sweeps}. "
        "These trials are not what they claim to be."
    )


def posing(study: Study) -> list[Group]:
    """Stand-ins that answered in a model's name; the emulator has one of its own."""
    return [group for group in study.models if group.scripted and EMULATOR not in group.models]


def _said(parts: list[str], rest: str) -> str:
    """What was found, and what to know of it; empty where nothing was."""
    return f"{'; '.join(parts)}. {rest}" if parts else ""


def _posing(study: Study) -> str:
    return _said(
        [f"{group.id}: {group.posing}" for group in posing(study)],
        "These rows stand last, are in no conclusion, and never beside the paper's row of that "
        "model.",
    )


def _repeated(study: Study) -> str:
    return _said(
        [
            f"{group.repeated} of {len(group.trials) + group.repeated} trials of {group.id} repeat "
            "an earlier one to the last state"
            for group in study.models
            if group.repeated
        ],
        "A driver without chance goes the same way each time: equal trials count once, in every n, "
        "interval and test.",
    )


def _equal(study: Study) -> str:
    return _said(
        [
            f"{group.equal} of {len(group.trials)} trials of {group.id} are as an earlier one to "
            "the last state"
            for group in study.models
            if group.equal
        ],
        "Others of their repetitions differ, so that each counts; where they came from a cache on "
        "the way, they are no samples.",
    )


def _other_humans(study: Study) -> str:
    return _said(
        list(study.imported.contradicting) if study.imported else [],
        "They are no part of the published trials, and their rows say so.",
    )


def _alike(origin: Provenance) -> str:
    return _said(
        [
            f"all {repeated} answers of {driver} to prompts that it was asked before"
            for driver, repeated in origin.alike.items()
        ],
        "A cache on the way or a temperature of 0 does this: the repetitions are no samples.",
    )


def _failed(study: Study) -> str:
    return _said(
        [_failures(group) for group in study.models if len(group.trials) > len(group.ended)],
        "They are in no measure; the same sweep again plays them anew.",
    )


def _failures(group: Group) -> str:
    failed = group.trials[group.trials["status"] == "failed"]
    reasons = failed["error"].fillna("no reason is stored").value_counts()
    more = ", among other reasons" if len(reasons) > 1 else ""
    return f"{len(failed)} of {len(group.trials)} of {group.id} ({reasons.index[0]}{more})"


def _fallbacks(study: Study) -> str:
    return _said(
        [
            f"{found.fallbacks} of {found.decisions} decisions of {group.id} "
            f"({100 * found.fallbacks / found.decisions:.1f} %)"
            for group in study.models
            for found in [tally(study, group)]
            if found.fallbacks > MANY_FALLBACKS * found.decisions
        ],
        "There the older plan was driven, or none: the table fallbacks shows whether that changes "
        "the results.",
    )


def _unknown(study: Study) -> str:
    return _said(
        [
            f"{found.unknown} of {found.attempts} of {group.id}"
            for group in study.models
            for found in [tally(study, group)]
            if found.unknown
        ],
        "A run was killed before their reply was seen: they may have been paid for.",
    )


def _mixed(study: Study) -> str:
    settings: dict[str, dict[str, None]] = {}
    for group in study.models:
        settings.setdefault(group.name, {})[group.name + group.mark] = None
    return _said(
        [", ".join(marked) for marked in settings.values() if len(marked) > 1],
        "They are never pooled: all but the most frequent carry a mark.",
    )
