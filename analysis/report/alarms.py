"""What puts the results of a study in doubt, in words."""

from __future__ import annotations

from collections import Counter
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
    found = [Alarm("Another model answered", mismatch(one)) for one in origin.mismatches]
    for title, parts, rest in (
        (
            "A scripted stand-in answered",
            [f"{group.id}: {group.posing}" for group in posing(study)],
            "These rows stand last, are in no conclusion, and never beside the paper's row of that "
            "model.",
        ),
        (
            "Repetitions are the same trial",
            [_repeated(group) for group in study.models if group.repeated],
            "A driver without chance goes the same way each time: equal trials count once, in "
            "every n, interval and test.",
        ),
        (
            "Some trials are equal",
            [_equal(group) for group in study.models if group.equal],
            "Others of their repetitions differ, so that each counts; where they came from a cache "
            "on the way, they are no samples.",
        ),
        (
            "The human trials are another data set",
            list(study.imported.contradicting) if study.imported else [],
            "They are no part of the published trials, and their rows say so.",
        ),
        (
            "Answers are word for word as before",
            [
                f"all {repeated} answers of {driver} to prompts that it was asked before"
                for driver, repeated in origin.alike.items()
            ],
            "A cache on the way or a temperature of 0 does this: the repetitions are no samples.",
        ),
        (
            "Trials failed",
            [_failed(group) for group in study.models if len(group.trials) > len(group.ended)],
            "They are in no measure; the same sweep again plays them anew.",
        ),
        (
            "Many fallbacks",
            _fallbacks(study),
            "There the older plan was driven, or none: the table fallbacks shows whether that "
            "changes the results.",
        ),
        (
            "Attempts of unknown fate",
            _unknown(study),
            "A run was killed before their reply was seen: they may have been paid for.",
        ),
        (
            "Several settings under one name",
            _mixed(study),
            "They are never pooled: all but the most frequent carry a mark.",
        ),
    ):
        if parts:
            found.append(Alarm(title, f"{'; '.join(parts)}. {rest}"))
    return found


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
    return [g for g in study.models if g.scripted and EMULATOR not in g.model.split("+")]


def _repeated(group: Group) -> str:
    every = len(group.trials) + group.repeated
    return (
        f"{group.repeated} of {every} trials of {group.id} repeat an earlier one to the last state"
    )


def _equal(group: Group) -> str:
    return (
        f"{group.equal} of {len(group.trials)} trials of {group.id} are as an earlier one to the "
        "last state"
    )


def _failed(group: Group) -> str:
    failed = group.trials[group.trials["status"] == "failed"]
    reasons = failed["error"].fillna("no reason is stored").value_counts()
    more = ", among other reasons" if len(reasons) > 1 else ""
    return f"{len(failed)} of {len(group.trials)} of {group.id} ({reasons.index[0]}{more})"


def _fallbacks(study: Study) -> list[str]:
    return [
        f"{found.fallbacks} of {found.decisions} decisions of {group.id} "
        f"({100 * found.fallbacks / found.decisions:.1f} %)"
        for group in study.models
        for found in [tally(study, group)]
        if found.fallbacks > MANY_FALLBACKS * found.decisions
    ]


def _unknown(study: Study) -> list[str]:
    return [
        f"{found.unknown} of {found.attempts} of {group.id}"
        for group in study.models
        for found in [tally(study, group)]
        if found.unknown
    ]


def _mixed(study: Study) -> list[str]:
    drivers = dict.fromkeys(group.driver.removesuffix(" [scripted]") for group in study.models)
    bare = Counter(driver.split(" [")[0] for driver in drivers)
    return [
        ", ".join(driver for driver in drivers if driver.split(" [")[0] == name)
        for name, count in bare.items()
        if count > 1
    ]
