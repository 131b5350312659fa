"""What a study holds: one group of trials per driver and prompt variant, and the humans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import pandas as pd

from merge_runner.audit.checks import ASKED_DECISIONS
from merge_runner.errors import UsageError, unknown_name
from merge_runner.paths import DEFAULT_DB
from merge_runner.registry import require
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner.study.crossing import PROMPT, listed_levels
from merge_runner.study.file import StudySource, read_study
from merge_runner_analysis.cache import options_text, present_state
from merge_runner_analysis.frames import (
    ASKED_TRIALS,
    KEYS,
    LINKS,
    TRACES,
    Order,
    Studies,
    load,
    load_calls,
    load_each,
    load_specs,
    read_studies,
    study_name,
)
from merge_runner_analysis.grouping import (
    Group,
    groups_of,
    humans_of,
    in_human_conditions,
    levels_of,
    levels_of_group,
    of_trials,
)
from merge_runner_analysis.humans.imported import findings, human_trials, of_published_pairs
from merge_runner_analysis.names import BASELINE, HUMAN
from merge_runner_analysis.published import HUMAN_TRIALS
from merge_runner_analysis.remember import remembered
from merge_runner_analysis.trials import judged, trials_with_metrics

ONLY_ASKED = " [asked]"  # ends the name of a driver that was only asked
SPEC = ["spec_hash", "variant"]
QUERIES = {
    "asked": ASKED_TRIALS,
    "decisions": ASKED_DECISIONS,
    "levels": "FROM trial_levels",
    "traces": TRACES,
}
# So many human trials in every condition make a reference; fewer are shown, but not compared with.
ENOUGH_PER_CONDITION = 5


class Study:
    """The groups of a database, humans first, and what is computed from their traces once.

    ``played`` are those of drivers, and ``models`` the ones of them that something is concluded
    from, as ``unjudged`` are the others; ``asked`` and ``unjudged_asked`` are the same of drivers
    that were only asked what they do first, each marked so by its name. ``findings`` say what to
    know of imported humans. ``state`` is that of the results before they were read: rows may be
    stored meanwhile.
    """

    def __init__(
        self,
        db: Path | str = DEFAULT_DB,
        models: Sequence[str] | None = None,
        where: Mapping[str, Sequence[str]] | None = None,
        file: str | None = None,
        by: str | None = None,
        without_fallbacks: bool = False,
        sweep: str = "",
        condition: str = "",
    ) -> None:
        """Read the trials; ``models`` keeps these drivers alone, ``where`` these levels of factors.

        ``file`` keeps the trials of this study, and ``by`` is the factor at whose levels the table
        ``factors`` shows the others. ``without_fallbacks`` leaves out trials in which a decision
        had no valid plan. ``sweep`` keeps the drivers' trials of this sweep, by its id, and
        ``condition`` all trials of one condition. Raises UsageError.
        """
        self.db = Path(db)
        self._frames: dict[str, pd.DataFrame] = {}
        self.by = by
        self.without_fallbacks = without_fallbacks
        self.options = options_text(
            self.db, models=models, where=where, file=file, by=by,
            without_fallbacks=without_fallbacks, sweep=sweep, condition=condition,
        )  # fmt: skip
        self.state = present_state(self.db)
        self.studies = read_studies(self.db)
        self.source = None if file is None else read_study(file)
        self.file, self.order = _chosen(self.db, self.studies, self.source)
        self.specs = load_specs(self.db)
        self._found = load_each(QUERIES, self.db)
        trials = judged(self.db, trials_with_metrics(self.db))
        recorded = trials["source"] == HUMAN
        self.human = humans_of(of_published_pairs(trials[recorded]))
        self.findings = [*findings(human_trials(self.db))] if recorded.any() else []
        driven, asked = trials[~recorded], self._found["asked"]
        if sweep:
            driven = driven.merge(load(LINKS, self.db).query("sweep_id == @sweep")[KEYS])
        if condition:
            driven = driven[driven["condition"] == condition]
            self.human = self.human.part(lambda rows: rows["condition"] == condition)
        self._every = pd.concat([trials[SPEC], asked[SPEC]])
        # Those that were only asked are chosen by the names of their models.
        played = {group: group.driver for group in self._groups(driven)}
        only_asked = self._groups(asked.assign(driver=asked["driver"] + ONLY_ASKED))
        names = played | {group: group.name.removesuffix(ONLY_ASKED) for group in only_asked}
        valid = dict.fromkeys([HUMAN, *names.values()])
        wanted = list(valid) if models is None else models
        for name in wanted or [""]:
            if name not in valid:
                raise unknown_name("driver", name, valid, f"in {self.db}")
        kept = [group for group, name in names.items() if name in wanted]
        if where:
            kept = _at(where, kept, self.db, self.order)
        self.empty = not played
        self.played = [group for group in kept if group in played]
        self.models = [group for group in self.played if not group.unjudged]
        self.unjudged = [group for group in self.played if group.unjudged]
        only_asked = [group for group in kept if group not in played]
        self.asked = [group for group in only_asked if not group.unjudged]
        self.unjudged_asked = [group for group in only_asked if group.unjudged]
        self.groups = [self.human] * (HUMAN in wanted) + self.models

    def _groups(self, trials: pd.DataFrame) -> list[Group]:
        """The groups of these trials that were played for the study, if one was chosen."""
        if self.file:
            trials = trials[self.studies.holds(self.file, trials)]
        trials = trials.merge(self._found["traces"], on=KEYS, how="left")
        return [
            self._kept_trials(replace(group, levels=levels_of_group(self._found["levels"], group)))
            for group in groups_of(trials, self.specs, self._found["decisions"])
        ]

    def _kept_trials(self, group: Group) -> Group:
        """The group, perhaps without its trials that had a fallback; it is judged by all."""
        if not self.without_fallbacks:
            return group
        calls = of_trials(self.calls, group.trials)
        fallen = _keys(calls[calls["fallback"] > 0])
        kept = group.part(lambda trials: pd.Series(~_keys(trials).isin(fallen), trials.index))
        if kept.trials.empty:
            return replace(group, unjudged=group.unjudged or "every trial had a fallback")
        return kept

    def holds_more(self, group: Group) -> bool:
        """Whether the database has other trials with the specs and the prompt of a group."""
        alike = self._every["spec_hash"].isin(group.trials["spec_hash"])
        if group.setting:
            alike &= self._every["variant"] == group.setting
        return int(alike.sum()) > len(group.trials)

    @property
    def reference(self) -> str:
        """The prompt that others are compared with."""
        return next(iter(levels_of(self.played, self.order).get(PROMPT, ())), BASELINE)

    @cached_property
    def _human_traces(self) -> int:
        """So many human traces there are in each condition, or more."""
        return min(in_human_conditions(self.human.ended)) if self.human.measured else 0

    @property
    def calibrated(self) -> bool:
        """Whether there are human traces enough of every condition to compare others with."""
        return self._human_traces >= ENOUGH_PER_CONDITION

    @property
    def complete(self) -> bool:
        """Whether the human traces are all there, so that whole trials can be drawn from them."""
        return self._human_traces >= HUMAN_TRIALS / len(HUMAN_CONDITIONS)

    @cached_property
    def conditions(self) -> dict[str, tuple[float, float]]:
        """Name to projected headway in m and relative velocity in m/s, of those that were played.

        Those of the humans come first; where no model played, all of these. The others are read
        from the stored trials: what registered them may not be installed here.
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

    @property
    def baselines(self) -> list[Group]:
        """The humans and every driver with the baseline prompt."""
        return [group for group in self.groups if group.setting in {"", BASELINE}]

    @property
    def measured(self) -> list[Group]:
        """The groups whose speeds are known: all, but for humans before an import."""
        return [group for group in self.groups if group.measured]

    def read(self, sql: str) -> pd.DataFrame:
        """The rows of a query of ours, by trial or vehicle; it is run once."""
        if sql not in self._frames:
            self._frames[sql] = load(sql, self.db)
        return self._frames[sql]

    @cached_property
    def calls(self) -> pd.DataFrame:
        """What became of the calls, by trial."""
        return load_calls(self.db)


def _keys(trials: pd.DataFrame) -> pd.MultiIndex:
    """The key of each trial: one id may stand under several specs."""
    return pd.MultiIndex.from_frame(trials[KEYS])


@remembered
def in_one_study(study: Study, *groups: Group) -> bool:
    """Whether one study was played with all trials of these groups of drivers."""
    known = study.studies
    return len(known.orders) < 2 or any(
        all(known.holds(name, group.trials).all() for group in groups) for name in known.orders
    )


def _chosen(db: Path, studies: Studies, source: StudySource | None) -> tuple[str, Order]:
    """The name of the study that was chosen, empty without one, and the order of its levels.

    Where several studies are pooled the one that lists the most levels of a factor says their
    order, of equal ones the newest. Raises UsageError where the database has no trial of the study.
    """
    if source is None:
        return "", _pooled_order(studies)
    order = listed_levels(source.file, source.file.models)
    study = study_name(source.name, order)
    if study not in studies.orders:
        held = ", ".join(studies.orders) or "none"
        raise UsageError(f"{db} holds no trial of the study {study}; it holds those of: {held}")
    recorded = studies.orders[study]
    return study, {
        factor: list(dict.fromkeys([*order.get(factor, ()), *recorded.get(factor, ())]))
        for factor in {**order, **recorded}
    }


def _pooled_order(studies: Studies) -> Order:
    """The levels of each factor in the order of the studies; one level alone says no order."""
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
    """The groups that have one of these levels of each factor.

    Raises UsageError where there is none, or no such level.
    """
    there, kept = levels_of(groups, order), groups
    for factor, levels in where.items():
        known = require(there, "factor", factor)
        for level in levels:
            require(dict.fromkeys(known), f"level of {factor}", level)
        kept = [group for group in kept if group.levels.get(factor) in levels]
    if not kept:
        named = " and ".join(f"{factor}={'|'.join(levels)}" for factor, levels in where.items())
        raise UsageError(f"{db} holds no trial with {named}: there are some with each alone")
    return kept
