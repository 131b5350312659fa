"""Sentences under the tables: what n rests on, what was left out, and which models are mocks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.cache import remembered
from merge_runner_analysis.grouping import Group
from merge_runner_analysis.published import HUMAN_DOI, HUMAN_TRIALS
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables.model import Table


def footnoted(table: Table, study: StudyResults) -> Table:
    """Return the table with notes on its trials, and ``*`` for remarks on drivers."""
    drivers = (*study.groups, *study.probes, *study.unjudged, *study.unjudged_probes)
    remarks = {text for group in drivers for text in (group.posing, group.remark)}
    whose: dict[str, dict[str, None]] = {}
    rows = []
    for row in table.rows:
        driver, _, text = str(row.values.get("driver")).removesuffix(")").rpartition(" (")
        if text in remarks:
            whose.setdefault(text, {})[driver] = None
            row = replace(row, values={**row.values, "driver": f"{driver}*"})  # noqa: PLW2901
        rows.append(row)
    marked = [f"* {', '.join(drivers)}: {text}" for text, drivers in whose.items()]
    return replace(table, rows=rows, notes=(*table.notes, *_of_trials(table, study), *marked))


def _of_trials(table: Table, study: StudyResults) -> Iterator[str]:
    ids = {name for row in table.rows for name in row.groups}
    groups = [group for group in (*study.groups, *study.probes) if group.id in ids]
    if study.empty:
        yield f"{study.db} holds no trial of a model; `merge-runner sweep baseline` plays some"
    if left_out := [f"{g.id} {g.left_out}" for g in groups if g.left_out != "none"]:
        yield f"trials that did not finish: {'; '.join(left_out)}"
    if study.selection.without_fallbacks:
        yield (
            "trials in which a decision had a fallback are left out (--without-fallbacks): long "
            "ones more often than those that a crash ended early, so that shares of crashes rise"
        )
    yield from _pooled_by_name(table, groups)
    driven = [group for group in groups if group.setting]
    if driven and not study.file:
        sizes = sum((_studies_of(study, group) for group in driven), Counter[str]())
        pooled = [f"{name} ({sizes[name]} trials)" for name in sizes]
        if len(pooled) > 1:
            yield (
                f"trials of several studies: {', '.join(pooled)}. A difference "
                "between trials of different studies has no p; `--study FILE` selects one study"
            )
    if study.human in groups:
        yield from _human_notes(study, table)
        for group in groups:
            if unknown := _without_humans(group):
                yield (
                    f"{group.id}: no human drove {', '.join(unknown)}: any difference "
                    f"from the humans leaves out these {unknown.total()} trials"
                )
    if counts := [f"{g.id}: {g.repeated} of {len(g.stored.trials)}" for g in groups if g.repeated]:
        yield (
            f"{', '.join(counts)} trials of programs repeat an earlier one to the last state: they "
            "are left out, and n, shares and means are of the others, not of all draws"
        )
    if counts := [f"{g.id}: {g.equal} of {len(g.trials)}" for g in groups if g.equal]:
        yield (
            f"{', '.join(counts)} trials are as an earlier one to the last "
            "state: each is a sample, and counts"
        )
    if pairs := [f"{group.id}: {_ego_sides(group)}" for group in groups if len(group.models) > 1]:
        yield (
            'where two different drivers meet, "left first" means that the driver named first '
            f"goes first, wherever it sat. {'; '.join(pairs)}"
        )


def _pooled_by_name(table: Table, groups: list[Group]) -> Iterator[str]:
    """Yield a note on marked groups that stand in a row with groups of another mark."""
    marks = {group.id: group.mark for group in groups}
    mixed = [row.groups for row in table.rows if len({marks.get(name) for name in row.groups}) > 1]
    if marked := [name for name in marks if marks[name] and any(name in names for names in mixed)]:
        yield (
            f"{', '.join(marked)}: another text or setting under the same name. The level counts "
            "these trials, too; a difference compares them only with each other"
        )


@remembered
def _studies_of(study: StudyResults, group: Group) -> Counter[str]:
    known = study.frames.studies
    return +Counter({name: int(known.holds(name, group.trials).sum()) for name in known.orders})


@remembered
def _without_humans(group: Group) -> Counter[str]:
    """Return the number of trials in each condition that no human drove."""
    conditions = group.trials["condition"]
    return Counter(sorted(conditions[~conditions.isin(HUMAN_CONDITIONS)]))


def _human_notes(study: StudyResults, table: Table) -> Iterator[str]:
    if not study.human.measured:
        yield (
            f"human: the published outcomes of {HUMAN_TRIALS} trials; for the rest `merge-runner "
            f"human import PATH` reads the recordings (doi {HUMAN_DOI})"
        )
        return
    yield from (f"human: {finding}" for finding in study.findings)
    if table.number:  # the paper's take imported human trials as independent
        yield (
            "human: intervals and tests take the trials as independent, but the imported ones come "
            f"from {study.human.trials['pair'].nunique()} pairs who differ: they are too narrow"
        )


def _ego_sides(group: Group) -> str:
    left, right = group.ego_sides
    drove = f"{group.models[0]} drove on the left in {left} trials, and on the right in {right}"
    if left and right:
        return f"{drove}, mirrored"
    return (
        f"{drove}: driver and side cannot be separated; `mirror = true` in the study, or --mirror, "
        "counterbalances the positions"
    )
