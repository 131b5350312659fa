"""Reasons to doubt the results of a study, which the report says first."""

from __future__ import annotations

from collections.abc import Iterator

import pandas as pd

from merge_runner.drivers.registry import MOCKS
from merge_runner.records import NO_DECISION
from merge_runner_analysis.provenance import Provenance, tally
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.wording import number

# The share of a group's decisions above which an alarm is raised: a convention.
MANY_FALLBACKS = 0.05
# The worst first: what each alarm says of the groups that it names.
MEANINGS = {
    "Another model answered": "These trials are not what they claim to be.",
    "A mock model answered": "These rows stand last, are in no conclusion, and never beside "
    "the paper's row of that model.",
    "Too few valid decisions": "What was driven is mostly not what the model decided: no value, "
    "test or conclusion rests on these trials.",
    "Trials repeat earlier ones": "Copies of programs add nothing to any n, interval or test. "
    "Where a cache answered a language model on the way, or its temperature is 0, equal trials are "
    "no samples, and intervals and tests claim too much.",
    "Trials failed": "They are in no measure; the same sweep again plays them anew.",
    "Many fallbacks": "There the older plan was driven, or none: tables --without-fallbacks shows "
    "whether that changes the results.",
    "Decisions are missing": "The plans of these replies were driven, but the tactical decision "
    "that was asked for is not in them: they are in no table of what drivers say.",
    "Attempts of unknown fate": "A run was killed before their reply was seen: they may have been "
    "paid for.",
    "Several settings under one name": "All but the most frequent, or the newest of these, carry a "
    "mark. Only levels of factors pool them.",
}


def alarms(study: StudyResults, origin: Provenance) -> dict[str, tuple[list[str], str]]:
    """Return the reasons to doubt the results of a study by title, the worst first.

    Each has its findings, one for each group or run, and their meaning.
    """
    findings: dict[str, list[str]] = {title: [] for title in MEANINGS}
    for title, text in _found(study, origin):
        findings[title].append(text)
    return {title: (texts, MEANINGS[title]) for title, texts in findings.items() if texts}


def _repeats(study: StudyResults) -> Iterator[str]:
    """Yield findings on identical trials, at one level of a driver's factors or at several."""
    by_name: dict[str, list[pd.DataFrame]] = {}
    for group in study.played:
        if not group.scripted:
            by_name.setdefault(group.name, []).append(group.trials)
        if group.repeated:
            yield (
                f"{group.id}: {group.repeated} of {len(group.stored.trials)} trials of programs "
                "are as an earlier one to the last state; they are left out"
            )
        if group.equal:
            yield (
                f"{group.id}: {group.equal} of {len(group.trials)} trials are as an earlier one to "
                "the last state; each counts"
            )
    for name, parts in by_name.items():
        every = pd.concat(parts)
        distinct = len(every.drop_duplicates(["condition", "way"]))
        if distinct < len(every):
            yield (
                f"{name}: {distinct} of {len(every)} trials of programs at different levels of "
                "factors are distinct; each counts once where levels are pooled, and copies are "
                "not compared"
            )


def _found(study: StudyResults, origin: Provenance) -> Iterator[tuple[str, str]]:
    for pair in origin.mismatches.itertuples():
        answers = f"{pair.answers} answer{'s' * (pair.answers != 1)}"
        asked = f"{pair.requested} was asked for, {pair.served} answered"
        yield "Another model answered", f"{asked}: {answers}, in {pair.sweeps}"
    for group in (*study.unjudged, *study.unjudged_probes):
        yield "Too few valid decisions", f"{group.id}: {group.unjudged}"
    names: dict[str, dict[str, None]] = {}
    for group in study.played:
        names.setdefault(group.name, {})[group.name + group.mark] = None
        trials, counts = len(group.trials), tally(study, group)
        # A mock model's own name is honest.
        if group.scripted and MOCKS.isdisjoint(group.models):
            yield "A mock model answered", f"{group.id}: {group.posing}"
        if failed := counts["failed"]:
            reasons = group.trials["error"].dropna()
            why = reasons.mode().get(0, "no reason is stored")
            more = ", among other reasons" if reasons.nunique() > 1 else ""
            yield "Trials failed", f"{failed} of {trials} of {group.id} ({why}{more})"
        fallbacks, decisions = counts["fallback"], counts["decisions"]
        if not group.unjudged and fallbacks > MANY_FALLBACKS * decisions:
            share = number(100 * fallbacks / decisions)
            text = f"{fallbacks} of {decisions} decisions of {group.id} ({share} %)"
            yield "Many fallbacks", text
        if missing := counts[NO_DECISION]:
            yield "Decisions are missing", f"{missing} of {decisions} decisions of {group.id}"
        if counts["unknown"]:
            text = f"{counts['unknown']} of {counts['attempts']} of {group.id}"
            yield "Attempts of unknown fate", text
    yield from (("Trials repeat earlier ones", text) for text in _repeats(study))
    for marked in names.values():
        if len(marked) > 1:
            yield "Several settings under one name", ", ".join(marked)
