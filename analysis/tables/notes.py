"""Sentences under the tables: what n rests on, and what was left out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache

import pandas as pd

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.data.intermittency import RANDOM_SECONDS, STEADY_MPS, random_gain
from merge_runner_analysis.data.reference_data import HUMAN_DOI, HUMAN_GAP_SD_M, HUMAN_TRIALS
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.tables.model import Table


def listed(items: Sequence[str]) -> str:
    """``a, b and c``."""
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}"


def sample_notes(
    study: Study, groups: Iterable[Group], *, pooled: bool = True, whole: bool = True
) -> list[str]:
    """Notes on the trials behind a table: which did not finish, and caveats about the drivers.

    ``pooled`` means that the table treats imported human trials as independent, ``whole`` that it
    leaves out those that did not finish.
    """
    shown = list(groups)
    left_out = {g.id: g.left_out if whole else _failed(g) for g in shown}
    parts = [f"{name} {reasons}" for name, reasons in left_out.items() if reasons != "none"]
    notes = [f"trials that did not finish: {'; '.join(parts)}"] if parts else []
    if study.empty:
        notes.append(
            f"{study.db} holds no trial of a model; `merge-runner sweep baseline` plays some"
        )
    notes += _pooled_notes(study, [group for group in shown if group.setting])
    if study.human in shown:
        notes += [*_human_notes(study, pooled), *_own_notes(study, shown)]
    return [*notes, *_repeated_notes(shown), *equal_notes(shown), *pair_notes(shown)]


def _failed(group: Group) -> str:
    failed = len(group.trials) - len(group.ended)
    return f"{failed} failed" if failed else "none"


def _pooled_notes(study: Study, groups: list[Group]) -> Iterator[str]:
    """Which studies the trials are of, where these are several."""
    if study.file or len(study.studies.orders) < 2 or not groups:
        return
    trials = pd.concat([group.trials for group in groups])
    sizes = {name: int(study.studies.holds(name, trials).sum()) for name in study.studies.orders}
    named = [f"{name} ({n} trials)" for name, n in sizes.items() if n]
    if len(named) > 1:
        yield (
            f"trials of several studies: {listed(named)}. No p is given for a difference across "
            "studies; `--study FILE` keeps the trials of one"
        )


def measured_notes(study: Study) -> list[str]:
    """The notes of a table that shows every group whose speeds are known."""
    nothing = [] if study.measured else ["there is no measured trial to show"]
    return [*nothing, *sample_notes(study, study.measured)]


def _own_notes(study: Study, groups: list[Group]) -> list[str]:
    """Notes on the trials in conditions that no human drove, an equal one once."""
    whose: dict[str, list[str]] = {}
    for group in groups:
        mine = group.trials.loc[~group.trials["condition"].isin(HUMAN_CONDITIONS), "condition"]
        if len(mine):
            names = [name for name in study.conditions if name in set(mine)]
            note = (
                f"no human drove {', '.join(names)} ({len(mine)} trials): beside the humans, rates "
                "and regressions rest on these too, contrasts with the humans and the human "
                "ceiling on the other conditions alone"
            )
            whose.setdefault(note, []).append(group.id)
    return [f"{', '.join(ids)}: {note}" for note, ids in whose.items()]


def replayed_notes(study: Study) -> list[str]:
    """Which baselines are not judged, since a human is replayed in them."""
    return [
        f"{group.id}: {group.caution}: it is not judged, nor compared with the humans"
        for group in study.baselines
        if group.caution
    ]


def footnoted(table: Table, study: Study) -> Table:
    """The table with ``*`` for what is said of a stand-in or a replayed human, told in a note."""
    groups = (*study.groups, *study.asked, *study.unjudged, *study.unjudged_asked)
    said = {text for group in groups for text in (group.posing, group.said)}
    whose: dict[str, dict[str, None]] = {}
    rows = []
    for row in table.rows:
        driver, _, text = str(row.values.get("driver")).removesuffix(")").rpartition(" (")
        if text in said:
            whose.setdefault(text, {})[driver] = None
            row = replace(row, values={**row.values, "driver": f"{driver}*"})  # noqa: PLW2901
        rows.append(row)
    notes = [f"* {', '.join(drivers)}: {text}" for text, drivers in whose.items()]
    if study.without_fallbacks:
        notes.append("trials in which a decision had a fallback are left out (--without-fallbacks)")
    return replace(table, rows=rows, notes=(*table.notes, *notes))


def _repeated_notes(groups: Iterable[Group]) -> list[str]:
    """Say which deterministic drivers repeat their trials."""
    counts = [f"{g.id}: {g.repeated} of {len(g.stored.trials)}" for g in groups if g.repeated]
    if not counts:
        return []
    return [
        f"{', '.join(counts)} trials repeat an earlier one to the last state, of programs that "
        "declare no chance: they are left out, and n counts the others"
    ]


def equal_notes(groups: Iterable[Group]) -> list[str]:
    """Say which trials of language models are equal."""
    counts = [f"{g.id}: {g.equal} of {len(g.trials)}" for g in groups if g.equal]
    text = "trials are as an earlier one to the last state; each counts"
    return [f"{', '.join(counts)} {text}"] if counts else []


def pair_notes(groups: Iterable[Group]) -> list[str]:
    """Say whose odds those of two different drivers are, and on which sides they sat."""
    pairs = [f"{group.id}: {_seats_note(group)}" for group in groups if group.is_mixed]
    if not pairs:
        return []
    return [
        "of two different drivers left stands for the one that is named first, wherever it sat: "
        f"odds that it goes first. {'; '.join(pairs)}"
    ]


def _seats_note(group: Group) -> str:
    if group.one_sided:
        return one_sided_note(group)
    left, right = group.seats
    return (
        f"{group.models[0]} sat on the left in {left} trials, and on the right in {right}, mirrored"
    )


def one_sided_note(group: Group) -> str:
    """Says that two different drivers were played one way round alone."""
    side = "left" if group.seats[0] else "right"
    return (
        f"{group.models[0]} sat on the {side} in all {sum(group.seats)} trials: what is its doing "
        "cannot be told from what is its side's; `mirror = true` in the study, or --mirror, plays "
        "both ways round"
    )


# Nearly every table has these notes: they are made once for a study.
@cache
def _human_notes(study: Study, pooled: bool) -> tuple[str, ...]:
    if study.imported is None:
        return (
            f"human: the published outcomes of {HUMAN_TRIALS} trials; for the rest `merge-runner "
            f"human import PATH` reads the recordings (doi {HUMAN_DOI})",
        )
    found = tuple(f"human: {finding}" for finding in study.imported.findings())
    # A table that models the pairs (see stats.joint) has no such bias to warn of.
    if not pooled:
        return found
    return (
        *found,
        "human: intervals and tests take the trials as independent, but the imported ones come "
        f"from {study.imported.pairs} pairs who differ: they are too narrow",
    )


def no_ceiling(group: Group) -> str:
    """Why a group has no human ceiling; empty where it has one."""
    if min(group.sizes):
        return ""
    if any(group.sizes):
        return "not all conditions of the humans were played: no ceiling"
    played = len(group.ended_outcomes)
    return f"{'no human drove its conditions' if played else 'no trial ended'}: no ceiling"


def ceiling_notes() -> list[str]:
    """What the human ceiling is drawn from."""
    return [
        "humans pass: share of 1000 human data sets with as many trials in each condition as the "
        "row has on average; outcomes from the published counts, gaps from the published "
        f"regression with residuals of SD {HUMAN_GAP_SD_M} m; at the score: I1 to I4 together. So "
        "often a perfect copy of the humans passes"
    ]


def intermittency_notes(study: Study) -> list[str]:
    """How I5 is measured, and what it does not say."""
    beside = (
        "the difference from the humans in the same conditions, in human SD, is no part of it"
        if study.calibrated
        else "without human traces of every condition it is not compared with the humans'"
    )
    return [
        "I5: piecewise-constant acceleration, by the gain of straight lines over cubics in the "
        "speeds under control, BIC per sample at 5 Hz; above 0 accelerations are held and jump, "
        "below 0 they move. Robust: the 95 % interval of the mean gain lies above 0; "
        f"{beside}. Vehicles that stay within {STEADY_MPS} m/s, with or without the simulator's "
        "resistance, took no action and do not count",
        "I5 at 1 Hz: the gain of the same speeds with one acceleration from each full second to "
        "the next, as any driver has that decides once a second and holds. Accelerations that are "
        f"drawn by chance each second have {random_gain():.2f}, on average over "
        f"{RANDOM_SECONDS} s: so much the clock alone can make",
    ]
