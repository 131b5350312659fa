"""Trials of a study: one group per driver and prompt variant, and the humans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import pandas as pd

from merge_runner.driver_names import without_endpoint
from merge_runner.errors import UsageError
from merge_runner.paths import DEFAULT_DB
from merge_runner.prompts.blocks import BASELINE
from merge_runner.registry import require
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner.study.arms import MODEL, PROMPT
from merge_runner.study.crossing import listed_levels
from merge_runner.study.file import StudySource, read_study
from merge_runner.study.runs import study_name
from merge_runner_analysis.cache import present_state, remembered
from merge_runner_analysis.frames import KEYS, Order, Studies, read, read_frames
from merge_runner_analysis.grouping import (
    Group,
    groups_of,
    humans_of,
    in_human_conditions,
    levels_of,
)
from merge_runner_analysis.humans.imported import VELOCITY_PAGES, findings, of_published_pairs
from merge_runner_analysis.published import HUMAN, HUMAN_TRIALS
from merge_runner_analysis.selection import Selection

PROBE = " [asked]"  # ends the name of a driver asked only for first decisions
EVERYTHING = Selection()
# So many human trials in every condition make a reference; fewer are shown, but not compared with.
ENOUGH_PER_CONDITION = 5


class StudyResults:
    """The groups of a database, humans first, and results that are computed once.

    ``models`` are the ``played`` groups that are judged, ``unjudged`` the others; ``probes`` are
    groups of first-decision probes. ``baselines`` are the humans and every driver with the baseline
    prompt, ``measured`` the groups whose speeds are known, ``reference`` is the prompt that others
    are compared with. Tables depend on ``options`` and on ``state``, that before the results were
    read.
    """

    def __init__(self, db: Path | str = DEFAULT_DB, selection: Selection = EVERYTHING) -> None:
        """Read a database; raises UsageError, also where it holds nothing of a selection."""
        self.db, self.selection = Path(db), selection
        self.state = present_state(self.db)
        self.frames = read_frames(self.db)
        self.source = None if selection.file is None else read_study(selection.file)
        self.file, self.order = _chosen(self.db, self.frames.studies, self.source)
        trials, probes = self.frames.trials, self.frames.probes
        is_human, condition = trials["source"] == HUMAN, selection.condition
        self.human = humans_of(of_published_pairs(trials[is_human]))
        if condition:
            self.human = self.human.part(lambda rows: rows["condition"] == condition)
        played = self._groups(self._driven(trials[~is_human]))
        probed = self._groups(probes.assign(driver=probes["driver"] + PROBE))
        chosen = self._selected([*played, *probed])
        self.empty = not played
        self.played = [group for group in played if group in chosen]
        self.models = [group for group in self.played if not group.unjudged]
        self.unjudged = [group for group in self.played if group.unjudged]
        if selection.models:  # the one that is named first is what others are compared with
            place = [without_endpoint(name) for name in selection.models].index
            named = sorted(self.models, key=lambda group: place(without_endpoint(group.driver)))
            levels = [group.levels[MODEL] for group in named if MODEL in group.levels]
            self.order = {**self.order, MODEL: list(dict.fromkeys(levels))}
        probed = [group for group in probed if group in chosen]
        self.probes = [group for group in probed if not group.unjudged]
        self.unjudged_probes = [group for group in probed if group.unjudged]
        with_human = selection.models is None or HUMAN in selection.models
        self.groups = [self.human] * with_human + self.models
        self.baselines = [group for group in self.groups if group.setting in {"", BASELINE}]
        self.measured = [group for group in self.groups if group.measured]
        self.reference = next(iter(levels_of(self.played, self.order).get(PROMPT, ())), BASELINE)
        self.options = selection.key(self.db)

    def _driven(self, trials: pd.DataFrame) -> pd.DataFrame:
        """Return trials of the chosen run and condition; raises UsageError for an unknown run."""
        run, condition = self.selection.sweep, self.selection.condition
        if run:
            links, called = self.frames.studies.trials, self.frames.studies.called
            if run not in called.values():
                names = filter(None, called.values())
                require(dict.fromkeys([*names, *called]), "run", run, f"in {self.db}")
            runs = [sweep_id for sweep_id, name in called.items() if name == run] or [run]
            trials = trials.merge(links.loc[links["sweep_id"].isin(runs), KEYS].drop_duplicates())
        return trials[trials["condition"] == condition] if condition else trials

    def _groups(self, trials: pd.DataFrame) -> list[Group]:
        """Return the groups of these trials, of the chosen study only, if one is chosen."""
        frames = self.frames
        if self.file:
            trials = trials[frames.studies.holds(self.file, trials)]
        groups = groups_of(trials, frames.specs, frames.decisions, frames.levels, self.order)
        if not self.selection.without_fallbacks:
            return groups
        fallen = _keys(frames.calls[frames.calls["fallback"] > 0])
        every = "every trial had a fallback"
        parts = [
            group.part(lambda rows: pd.Series(~_keys(rows).isin(fallen), rows.index))
            for group in groups
        ]
        return [
            replace(group, unjudged=group.unjudged or every) if part.trials.empty else part
            for group, part in zip(groups, parts, strict=True)
        ]

    def _selected(self, groups: list[Group]) -> list[Group]:
        """Return the chosen groups; first-decision probes go by their models' names."""
        names = {
            group: group.name.removesuffix(PROBE) if group.name.endswith(PROBE) else group.driver
            for group in groups
        }
        valid = dict.fromkeys([HUMAN, *names.values()])
        named = [*valid] if self.selection.models is None else self.selection.models
        # Where one driver alone is so called without its endpoint, that is enough.
        short = [*map(without_endpoint, valid)]
        full = {
            name: long for name, long in zip(short, valid, strict=True) if short.count(name) < 2
        }
        named = [name if name in valid else full.get(name, name) for name in named]
        for name in named or [""]:
            require(valid, "driver", name, f"in {self.db}")
        kept = [group for group, name in names.items() if name in named]
        where = self.selection.where
        return _at(where, kept, self.db, self.order) if where else kept

    @cached_property
    def findings(self) -> list[str]:
        """Remarks on imported humans."""
        trials, specs = self.frames.trials, self.frames.specs
        recorded = trials[trials["source"] == HUMAN]
        origins = recorded["spec_hash"].map(lambda name: specs.get(name, {}).get("origin"))
        of_pages = origins == VELOCITY_PAGES
        return [*findings(recorded.assign(of_pages=of_pages))] if len(recorded) else []

    @cached_property
    def _human_traces(self) -> int:
        """Smallest number of human traces in a condition."""
        return min(in_human_conditions(self.human.ended)) if self.human.measured else 0

    @property
    def calibrated(self) -> bool:
        """True if every condition has enough human traces to compare others with."""
        return self._human_traces >= ENOUGH_PER_CONDITION

    @property
    def complete(self) -> bool:
        """True if all human traces are imported."""
        return self._human_traces >= HUMAN_TRIALS / len(HUMAN_CONDITIONS)

    @cached_property
    def conditions(self) -> dict[str, tuple[float, float]]:
        """Projected headway in m and relative velocity in m/s, by name of a played condition.

        The humans' conditions come first. If no model played, these are all of them.
        """
        played = {
            row.condition: (row.projected_headway_m, row.relative_velocity_mps)
            for group in self.models
            for row in group.trials.drop_duplicates("condition").itertuples()
        }
        humans = {
            name: (condition.projected_headway_m, condition.relative_velocity_mps)
            for name, condition in HUMAN_CONDITIONS.items()
            if name in played or not played
        }
        return humans | dict(sorted(played.items(), key=lambda item: (item[1], item[0])))

    @remembered
    def read(self, sql: str) -> pd.DataFrame:
        """Return the rows of a query that a single table or figure needs, which is run once."""
        return read(self.db, sql)


def _keys(trials: pd.DataFrame) -> pd.MultiIndex:
    """Return the key of each trial: one id may stand under several specs."""
    return pd.MultiIndex.from_frame(trials[KEYS])


@remembered
def in_one_study(study: StudyResults, *groups: Group) -> bool:
    """Return whether all trials of these groups belong to one study."""
    known = study.frames.studies
    return len(known.orders) < 2 or any(
        all(known.holds(name, group.trials).all() for group in groups) for name in known.orders
    )


def _chosen(db: Path, studies: Studies, source: StudySource | None) -> tuple[str, Order]:
    """Return the chosen study's name, if any, and its levels. Raises UsageError."""
    if source is None:
        return "", _pooled_order(studies)
    order = listed_levels(source.file, source.file.models)
    study = study_name(source.name, order)
    if study not in studies.orders:
        stored = ", ".join(studies.orders) or "none"
        raise UsageError(f"{db} holds no trial of the study {study}; its studies: {stored}")
    recorded = studies.orders[study]
    return study, {
        factor: list(dict.fromkeys([*order.get(factor, ()), *recorded.get(factor, ())]))
        for factor in {**order, **recorded}
    }


def _pooled_order(studies: Studies) -> Order:
    """Return levels in the order of the study that lists the most; of several, the newest one."""
    pooled: dict[str, list[str]] = {}
    for factor in dict.fromkeys(name for order in studies.orders.values() for name in order):
        lists = [order[factor] for order in studies.orders.values() if factor in order]
        several = [levels for levels in lists if len(levels) > 1 or len(lists) == 1]
        ranked = sorted(several, key=len, reverse=True)
        pooled[factor] = list(dict.fromkeys(level for levels in ranked for level in levels))
    return pooled


def _at(
    where: Mapping[str, Sequence[str]], groups: list[Group], db: Path, order: Order
) -> list[Group]:
    """Return the groups that have one of these levels of each factor. Raises UsageError."""
    every, kept = levels_of(groups, order), groups
    for factor, levels in where.items():
        known = require(every, "factor", factor)
        for level in levels:
            require(dict.fromkeys(known), f"level of {factor}", level)
        kept = [group for group in kept if group.levels.get(factor) in levels]
    if not kept:
        named = " and ".join(f"{factor}={'|'.join(levels)}" for factor, levels in where.items())
        raise UsageError(f"{db} holds no trial with {named}: there are some with each alone")
    return kept
