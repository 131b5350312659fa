"""What casts doubt on the results of a study, in words."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from merge_runner.drivers.registry import MOCKS
from merge_runner_analysis.data.provenance import Provenance, tally
from merge_runner_analysis.data.study import Group, Study

# The share of a group's decisions above which an alarm is raised: a convention.
MANY_FALLBACKS = 0.05


@dataclass(frozen=True, slots=True)
class Alarm:
    """A warning to read before any of the numbers."""

    title: str
    text: str


def alarms(study: Study, origin: Provenance) -> list[Alarm]:
    """What casts doubt on the results of a study, the worst first."""
    unjudged = (*study.unjudged, *study.unjudged_asked)
    found = (
        (
            "Too few valid decisions",
            [f"{group.id}: {group.unjudged}" for group in unjudged],
            "What was driven is mostly not what the model decided: no value, test or conclusion "
            "rests on these trials.",
        ),
        (
            "Trials or answers repeat earlier ones",
            [*_equal(study)],
            "Where a cache on the way answered, or the temperature is 0, they are no samples, and "
            "intervals and tests claim too much.",
        ),
        (
            "Trials failed",
            [_failures(group) for group in study.played if len(group.trials) > len(group.ended)],
            "They are in no measure; the same sweep again plays them anew.",
        ),
        (
            "Many fallbacks",
            [*_fallbacks(study)],
            "There the older plan was driven, or none: tables --without-fallbacks shows whether "
            "that changes the results.",
        ),
        (
            "Attempts of unknown fate",
            [*_unknown(study)],
            "A run was killed before their reply was seen: they may have been paid for.",
        ),
        (
            "Several settings under one name",
            [*_mixed(study)],
            "They are never pooled: all but the most frequent carry a mark.",
        ),
    )
    return [
        *_of_answers(study, origin),
        *(Alarm(title, f"{'; '.join(parts)}. {rest}") for title, parts, rest in found if parts),
    ]


def _of_answers(study: Study, origin: Provenance) -> Iterator[Alarm]:
    """First, since no number is what it claims to be if another model drove."""
    for one in origin.mismatches.itertuples():
        answers = f"{one.answers} answer{'s' * (one.answers != 1)}"
        sweeps = f"sweep{'s' * (', ' in one.sweeps)} {one.sweeps}"
        yield Alarm(
            "Another model answered",
            f"{one.requested} was asked for, {one.served} answered: {answers}, {sweeps}. "
            "These trials are not what they claim to be.",
        )
    if groups := posing(study):
        yield Alarm(
            "A scripted stand-in answered",
            f"{'; '.join(f'{group.id}: {group.posing}' for group in groups)}. These rows stand "
            "last, are in no conclusion, and never beside the paper's row of that model.",
        )


def posing(study: Study) -> list[Group]:
    """Groups where a stand-in answered under a model's name; a mock model's own name is honest."""
    return [group for group in study.played if group.scripted and MOCKS.isdisjoint(group.models)]


def _equal(study: Study) -> Iterator[str]:
    if counts := [f"{g.id}: {g.equal} of {len(g.trials)}" for g in study.models if g.equal]:
        yield f"{', '.join(counts)} trials are as an earlier one to the last state; each counts"


def _failures(group: Group) -> str:
    failed = group.trials[group.trials["status"] == "failed"]
    reasons = failed["error"].fillna("no reason is stored").value_counts()
    more = ", among other reasons" if len(reasons) > 1 else ""
    return f"{len(failed)} of {len(group.trials)} of {group.id} ({reasons.index[0]}{more})"


def _fallbacks(study: Study) -> Iterator[str]:
    for group in study.models:
        # Without decisions both sides are 0, and there is no share to take.
        found = tally(study, group)
        fallbacks, decisions = found["fallback"], found["decisions"]
        if fallbacks > MANY_FALLBACKS * decisions:
            share = 100 * fallbacks / decisions
            yield f"{fallbacks} of {decisions} decisions of {group.id} ({share:.1f} %)"


def _unknown(study: Study) -> Iterator[str]:
    for group in study.played:
        found = tally(study, group)
        if found["unknown"]:
            yield f"{found['unknown']} of {found['attempts']} of {group.id}"


def _mixed(study: Study) -> Iterator[str]:
    """Names under which several settings were played; each with the marks that tell them apart."""
    marked: dict[str, dict[str, None]] = {}
    for group in study.played:
        marked.setdefault(group.name, {})[group.name + group.mark] = None
    yield from (", ".join(names) for names in marked.values() if len(names) > 1)
