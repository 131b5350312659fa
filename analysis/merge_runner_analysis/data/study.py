"""What a study holds: one group of trials per driver and prompt variant, and the humans."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from math import inf
from pathlib import Path
from typing import Any

import pandas as pd

from merge_runner.audit.checks import ASKED_DECISIONS, not_judged
from merge_runner.errors import UsageError, unknown_name
from merge_runner.paths import DEFAULT_DB
from merge_runner.records import SIDES, Side, canonical_json, spec_hash
from merge_runner.registry import require
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner.study.crossing import DEFAULT, MODEL, PROMPT, SELF, listed_levels
from merge_runner.study.file import StudySource, read_study
from merge_runner.text_safety import quoted
from merge_runner_analysis.data.derived_cache import options_text, present_state
from merge_runner_analysis.data.driver_words import (
    has_chance,
    language_models,
    programs_alone,
    stand_in,
    unresponsive,
)
from merge_runner_analysis.data.imported_humans import findings, human_trials, of_published_pairs
from merge_runner_analysis.data.intermittency import measure_profiles
from merge_runner_analysis.data.load import (
    ASKED_TRIALS,
    KEYS,
    LINKS,
    SPEEDS,
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
from merge_runner_analysis.data.reference_data import HUMAN_TRIALS
from merge_runner_analysis.data.remember import remembered
from merge_runner_analysis.data.trials import judged, outcomes_with_metrics, trials_with_metrics
from merge_runner_analysis.names import BASELINE, HUMAN

MEAN_SPEED = "mean_speed_mps"
# Factors that every study has, and levels that others are compared with.
FIRST = (MODEL, PROMPT)
USUAL = (BASELINE, DEFAULT, SELF)
ONLY_ASKED = " [asked]"  # ends the name of a driver that was only asked
SPEC = ["spec_hash", "variant"]
QUERIES = {
    "asked": ASKED_TRIALS,
    "decisions": ASKED_DECISIONS,
    "levels": "FROM trial_levels",
    "traces": TRACES,
}
NUMBER = re.compile(r"-?[0-9]+(\.[0-9]+)?")
# So many human trials in every condition make a reference; fewer are shown, but not compared with.
ENOUGH_PER_CONDITION = 5


@dataclass(frozen=True, eq=False)
class Group:
    """Trials of equal drivers, prompts and parameters.

    ``trials`` are rows of ``load_trials``; for humans before an import only the outcomes that are
    published, and ``measured`` is False. ``setting`` is the prompt variant, empty for humans.
    ``spec_hash`` is that of its trials, or of those at the usual mean speed where a condition has
    another. ``levels`` are those of its study's factors, and its model and prompt, by factor.
    ``driver`` is its ``name`` with the ``mark`` that tells it from itself under other settings, and
    with ``[scripted]`` where a stand-in answered only some of its trials. ``label`` is how tables
    name the driver, ``models`` are the names that were asked for, the ego's first, an equal one
    once, ``seats`` are how many of the trials have the ego on the left and on the right, ``posing``
    is what is said of a scripted stand-in, and ``caution`` of a human who is replayed: such trials
    are not judged. The ``trials`` of programs are distinct, and ``whole`` is the group with their
    copies; ``equal`` counts the trials of a language model that went as an earlier one. The column
    ``way`` is equal in copies: trials of programs that are equal state by state.
    ``unjudged`` says why nothing is concluded from them, and is empty where something is.
    ``published_outcomes`` are those of humans, which imported trials do not replace.
    """

    driver: str
    setting: str
    spec_hash: str | None
    trials: pd.DataFrame
    label: str
    models: tuple[str, ...]
    name: str
    mark: str = ""
    seats: tuple[int, int] = (0, 0)
    measured: bool = True
    posing: str = ""
    caution: str = ""
    whole: Group | None = None
    equal: int = 0
    unjudged: str = ""
    published_outcomes: pd.DataFrame | None = None
    levels: Mapping[str, str] = field(default_factory=dict)

    @property
    def id(self) -> str:
        """``o3/A2``, or ``human``."""
        return f"{self.driver}/{self.setting}" if self.setting else self.driver

    @property
    def said(self) -> str:
        """What is said of a scripted stand-in and of a human who is replayed."""
        return "; ".join(filter(None, (self.posing, self.caution)))

    @property
    def scripted(self) -> bool:
        """Whether a scripted stand-in answered."""
        return bool(self.posing)

    @property
    def repeated(self) -> int:
        """How many trials of programs are left out as copies of an earlier one."""
        return len(self.stored.trials) - len(self.trials)

    @property
    def stored(self) -> Group:
        """The group with all its trials, as accounts of calls and money count them."""
        return self.whole or self

    @property
    def outcomes(self) -> pd.DataFrame:
        """The trials that count for collisions and for who merged first."""
        return self.trials if self.published_outcomes is None else self.published_outcomes

    @property
    def traced(self) -> bool:
        """Whether the speeds behind all outcomes are known."""
        return self.measured and len(self.trials) >= len(self.outcomes)

    def part(self, wanted: Callable[[pd.DataFrame], pd.Series]) -> Group:
        """The group with only those trials, and outcomes, of which ``wanted`` holds."""
        outcomes = self.published_outcomes
        return replace(
            self,
            trials=self.trials[wanted(self.trials)],
            published_outcomes=None if outcomes is None else outcomes[wanted(outcomes)],
        )

    @cached_property
    def ended(self) -> pd.DataFrame:
        """The trials that did not fail."""
        return self.trials[self.trials["status"] != "failed"]

    @cached_property
    def finished(self) -> pd.DataFrame:
        """The trials that a vehicle finished without a collision."""
        return self.trials[self.trials["status"] == "finished"]

    @property
    def ended_outcomes(self) -> pd.DataFrame:
        """The outcomes of trials that did not fail."""
        return self.outcomes[self.outcomes["status"] != "failed"]

    @property
    def sizes(self) -> tuple[int, ...]:
        """How many outcomes there are in each condition of humans, in their order."""
        return in_human_conditions(self.ended_outcomes)

    @property
    def left_out(self) -> str:
        """Which trials are not among the finished ones, in words."""
        counts = self.trials["status"].value_counts()
        statuses = [name for name in ("collided", "timeout", "failed") if name in counts]
        return ", ".join(f"{counts[name]} {name}" for name in statuses) or "none"


def in_human_conditions(trials: pd.DataFrame) -> tuple[int, ...]:
    """How many trials there are in each condition of humans, in their order."""
    return tuple(trials["condition"].value_counts().reindex(HUMAN_CONDITIONS, fill_value=0))


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
        self.human = _humans(of_published_pairs(trials[recorded]))
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
            self._kept_trials(replace(group, levels=_levels(self._found["levels"], group)))
            for group in _model_groups(trials, self.specs, self._found["decisions"])
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

    def profiles_of(self, group: Group) -> pd.DataFrame:
        """One row a vehicle of a group: whether it acted, and how far its acceleration is held."""
        specs = ", ".join(quoted(name) for name in group.trials["spec_hash"].unique())
        speeds = load(f"FROM ({SPEEDS}) WHERE list_contains([{specs}], spec_hash)", self.db)
        return measure_profiles(of_trials(speeds, group.trials))

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


def of_trials(frame: pd.DataFrame, trials: pd.DataFrame) -> pd.DataFrame:
    """The rows of a per-trial frame that belong to these trials."""
    # To join all rows takes longer than to leave out those of other groups first.
    near = frame["spec_hash"].isin(trials["spec_hash"].unique())
    return frame[near].merge(trials[KEYS], on=KEYS)


@cache
def _published_humans() -> Group:
    """One object for all studies: what is computed from it is computed once."""
    outcomes = outcomes_with_metrics()
    return Group(
        HUMAN, "", None, outcomes, HUMAN, models=(HUMAN,), name=HUMAN, measured=False,
        published_outcomes=outcomes,
    )  # fmt: skip


def _humans(trials: pd.DataFrame) -> Group:
    """The humans, with the trials that are imported."""
    if trials.empty:
        return _published_humans()
    n = len(trials)
    label = HUMAN if n >= HUMAN_TRIALS else f"humans ({n} of {HUMAN_TRIALS} imported)"
    return replace(_published_humans(), trials=trials, label=label, measured=True)


def _levels(levels: pd.DataFrame, group: Group) -> dict[str, str]:
    """The levels of a group, model and prompt first."""
    found = of_trials(levels, group.trials).drop_duplicates("factor")
    named = found.set_index("factor")["value"].to_dict()
    return {name: named[name] for name in sorted(named, key=lambda n: (n not in FIRST, n))}


def levels_of(groups: Iterable[Group], order: Order) -> dict[str, list[str]]:
    """The levels of each factor that these groups have, those in ``order`` first.

    Then come usual ones, then numbers by size, then the rest by name.
    """
    found: dict[str, set[str]] = {}
    for group in groups:
        for factor, level in group.levels.items():
            found.setdefault(factor, set()).add(level)
    return {
        factor: sorted(levels, key=lambda level: _place(level, order.get(factor, ())))
        for factor, levels in found.items()
    }


def _place(level: str, listed: Sequence[str]) -> tuple[int, bool, float, str]:
    place = listed.index(level) if level in listed else len(listed)
    number = float(level) if NUMBER.fullmatch(level) else inf
    return place, level not in USUAL, number, level


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


def _as_seen(stored: Mapping[str, Any] | None, name: str, ego: str) -> dict[str, Any]:
    """A spec as the ego sees it: with the ego's driver on the left.

    ``image`` is its hash, ``usual`` its hash at the usual mean speed. ``task`` is a hash of what
    it covers beside the prompt and the mean speed: equal for all prompts and conditions of a study.
    """
    spec, image = stored or {}, name
    if ego == "right" and {*SIDES} <= spec.keys():
        spec = {**spec, "left": spec["right"], "right": spec["left"]}
        image = spec_hash(canonical_json(spec))
    at_usual = {name: value for name, value in spec.items() if name != MEAN_SPEED}
    usual = spec_hash(canonical_json(at_usual)) if MEAN_SPEED in spec else image
    task = {name: value for name, value in at_usual.items() if name != "prompt_blocks"}
    hashed = hashlib.sha256(json.dumps(task, sort_keys=True).encode()).hexdigest()
    return {
        "spec": spec,
        "image": image,
        "usual": usual,
        "task": name if stored is None else hashed,
    }


def _model_groups(
    trials: pd.DataFrame,
    specs: Mapping[str, Mapping[str, Any]],
    decisions: pd.DataFrame,
) -> list[Group]:
    """Groups by driver and variant, scripted stand-ins last; ``decisions`` are ASKED_DECISIONS.

    Where a driver was run under several settings of the task, all but the most frequent carry a
    mark, the same for a baseline and its variants; likewise where a prompt was changed, and where
    a stand-in answered some of its trials.
    """
    if trials.empty:
        return []
    pairs = [*zip(trials["spec_hash"], trials["ego"], strict=True)]
    seen = {pair: _as_seen(specs.get(pair[0]), *pair) for pair in {*pairs}}
    keyed = trials.join(pd.DataFrame([seen[pair] for pair in pairs], index=trials.index))
    # A condition that was driven at several mean speeds must not be mixed.
    speeds = keyed.groupby(["usual", "condition"])["image"].transform("nunique")
    mixed = keyed["usual"].isin(keyed.loc[speeds > 1, "usual"])
    keyed["usual"] = keyed["usual"].mask(mixed, keyed["image"])
    keyed["mark"] = _marks(keyed, ["driver"], "task")
    keyed["mark"] += _marks(keyed, ["driver", "mark", "variant"], "usual")
    keyed["apart"] = keyed.groupby(["driver", "mark"])["scripted"].transform("nunique") > 1
    keys = ["driver", "mark", "apart", "scripted", "variant", "usual"]
    groups = []
    for _, rows in keyed.groupby(keys):
        counts = of_trials(decisions, rows).groupby("model")[["invalid", "asked"]].sum()
        reasons = (not_judged(row.Index, row.invalid, row.asked) for row in counts.itertuples())
        group = _model_group(trials.loc[rows.index], rows.iloc[0])
        group = replace(group, unjudged="; ".join(filter(None, reasons)))
        own = [specs.get(name, {}) for name in rows["spec_hash"].unique()]
        # Of a first decision that was only asked, what follows is not known: draws that differ
        # later may be equal until then.
        only_asked = rows["source"].iloc[0] == "seat" and any(map(has_chance, own))
        programs = all(map(programs_alone, own)) and not only_asked
        groups.append(_distinct(group, programs=programs))
    return sorted(groups, key=lambda g: (g.scripted, g.driver, g.setting != BASELINE, g.setting))


def _model_group(rows: pd.DataFrame, first: pd.Series) -> Group:
    """The group of these trials, which have the keys of the ``first`` of them."""
    scripted = bool(first["scripted"])
    models: dict[Side, str] = {side: first[f"model_{side}"] for side in SIDES}
    sides = [side for side in SIDES if rows[f"{side}_scripted"].any()]
    posing = stand_in(language_models(models, first["spec"]), sides or SIDES) if scripted else ""
    driver = first["driver"] + first["mark"] + " [scripted]" * (scripted and bool(first["apart"]))
    group = Group(
        driver,
        first["variant"],
        min(rows["spec_hash"].unique(), key=lambda name: (name != first["usual"], name)),
        rows,
        label=driver,
        models=tuple(dict.fromkeys(models.values())),
        name=first["driver"],
        mark=first["mark"],
        seats=(int((rows["ego"] == "left").sum()), int((rows["ego"] == "right").sum())),
        posing=posing,
        caution=unresponsive(first["spec"]),
    )
    return replace(group, label=f"{driver} ({group.said})") if group.said else group


def _distinct(group: Group, *, programs: bool) -> Group:
    """The group without copies, if only programs drive; of a language model they are counted."""
    rows = group.trials
    ended = rows[rows["trace"].notna()].sort_values(["rep", "ego"], kind="stable")
    again = ended.index[ended.duplicated(["condition", "trace"])]
    each = rows["trial_id"] + " " + rows["spec_hash"]
    rows = rows.assign(way=rows["trace"].fillna(each) if programs else each)
    if not programs:
        return replace(group, trials=rows, equal=len(again))
    whole = replace(group, trials=rows)
    return replace(whole, trials=rows.drop(index=again), whole=whole) if len(again) else whole


def _marks(keyed: pd.DataFrame, within: list[str], what: str) -> pd.Series:
    """`` [mark]`` for all but the most frequent value of ``what`` within equal names."""
    sizes = keyed.groupby([*within, what])[what].transform("size")
    ordered = keyed.assign(rarity=-sizes).sort_values(["rarity", what])
    usual = ordered.groupby(within)[what].transform("first").reindex(keyed.index)
    return (" [" + keyed[what].str[:8] + "]").mask(keyed[what] == usual, "")
