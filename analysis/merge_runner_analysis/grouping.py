"""The groups of a database: trials of equal drivers, prompts and parameters, and the humans."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from math import inf
from typing import Any

import pandas as pd

from merge_runner.audit.checks import not_judged
from merge_runner.planted_effect import PARAMETERS as PLANTED
from merge_runner.prompts.blocks import BASELINE
from merge_runner.records import SIDES, Side, canonical_json
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner.study.arms import DEFAULT, MODEL, PROMPT, SELF
from merge_runner.trial_records import spec_hash
from merge_runner_analysis.drivers import (
    has_chance,
    language_models,
    programs_alone,
    stand_in,
    unresponsive,
)
from merge_runner_analysis.frames import KEYS, Order
from merge_runner_analysis.published import HUMAN, HUMAN_TRIALS
from merge_runner_analysis.trials import outcomes_with_metrics

MEAN_SPEED = "mean_speed_mps"
# Factors that every study has, and levels that others are compared with.
FIRST = (MODEL, PROMPT)
USUAL = (BASELINE, DEFAULT, SELF)
NUMBER = re.compile(r"-?[0-9]+(\.[0-9]+)?")


@dataclass(frozen=True, eq=False, kw_only=True)
class Group:
    """Trials of equal drivers, prompts and parameters."""

    name: str
    """The driver: a model's, or both of a mixed pair."""
    driver: str
    """The name with the mark, and ``[scripted]`` where a mock model answered only some trials."""
    label: str
    """The driver as tables name it, with its remark."""
    mark: str = ""
    """``[1a2b3c4d]`` tells a driver from itself under other settings of the task."""
    models: tuple[str, ...]
    """The names that were asked for, the ego's first, an equal one once."""
    setting: str = ""
    """The prompt variant; empty for humans."""
    spec_hash: str = ""
    """Hash of its spec, at the usual mean speed if conditions have several."""
    levels: Mapping[str, str] = field(default_factory=dict)
    """By factor the level of its study; model and prompt are the first ones."""
    trials: pd.DataFrame
    """Rows of a study's trials, of programs the distinct ones.

    ``way`` is equal in trials of programs and of mock models that went alike, whichever of two
    equal drivers is the ego: copies, where the groups differ only in words that nobody reads.

    Humans before an import have the published outcomes alone."""
    whole: Group | None = None
    """The group with its copies, where it has some."""
    equal: int = 0
    """Number of a language model's trials that went as an earlier one."""
    published_outcomes: pd.DataFrame | None = None
    """Outcomes of humans, which imported trials do not replace."""
    posing: str = ""
    """Label of a mock model that answered; empty without one."""
    caution: str = ""
    """Remark on a replayed human, whose trials are not judged."""
    unjudged: str = ""
    """Why nothing is concluded from its trials; empty where something is."""

    @property
    def id(self) -> str:
        """``o3/A2``, or ``human``."""
        return f"{self.driver}/{self.setting}" if self.setting else self.driver

    @property
    def remark(self) -> str:
        """Remarks on a mock model and on a replayed human."""
        return "; ".join(filter(None, (self.posing, self.caution)))

    @property
    def measured(self) -> bool:
        """True if the speeds behind its trials are known: not of humans before an import."""
        return "trial_id" in self.trials

    @property
    def ego_sides(self) -> tuple[int, int]:
        """Numbers of stored trials with the ego on the left and on the right."""
        left, right = (int((self.stored.trials["ego"] == side).sum()) for side in SIDES)
        return left, right

    @property
    def scripted(self) -> bool:
        """True if a mock model answered."""
        return bool(self.posing)

    @property
    def repeated(self) -> int:
        """Number of a program's trials that are left out as copies of an earlier one."""
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
        """True if the speeds behind all outcomes are known."""
        return self.measured and len(self.trials) >= len(self.outcomes)

    def part(self, is_kept: Callable[[pd.DataFrame], pd.Series]) -> Group:
        """Return the group with only those trials, and outcomes, that ``is_kept`` selects."""
        outcomes = self.published_outcomes
        return replace(
            self,
            trials=self.trials[is_kept(self.trials)],
            published_outcomes=None if outcomes is None else outcomes[is_kept(outcomes)],
        )

    @cached_property
    def ended(self) -> pd.DataFrame:
        """The trials that did not fail."""
        return self.trials[self.trials["status"] != "failed"]

    @cached_property
    def finished(self) -> pd.DataFrame:
        """The trials that a vehicle finished without a collision."""
        return self.trials[self.trials["status"] == "finished"]

    @cached_property
    def ended_outcomes(self) -> pd.DataFrame:
        """The outcomes of trials that did not fail."""
        return self.outcomes[self.outcomes["status"] != "failed"]

    @property
    def sizes(self) -> tuple[int, ...]:
        """Numbers of outcomes in the conditions of humans, in their order."""
        return in_human_conditions(self.ended_outcomes)

    @cached_property
    def left_out(self) -> str:
        """Trials that did not finish, counted by status: ``2 collided, 1 failed``."""
        counts = self.trials["status"].value_counts()
        statuses = [name for name in ("collided", "timeout", "failed") if name in counts]
        return ", ".join(f"{counts[name]} {name}" for name in statuses) or "none"


def in_human_conditions(trials: pd.DataFrame) -> tuple[int, ...]:
    """Return the numbers of trials in the conditions of humans, in their order."""
    return tuple(trials["condition"].value_counts().reindex(HUMAN_CONDITIONS, fill_value=0))


def of_trials(frame: pd.DataFrame, trials: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of a per-trial frame that belong to these trials."""
    # Leaving out other groups' rows first is faster than joining all rows.
    near = frame["spec_hash"].isin(trials["spec_hash"].unique())
    return frame[near].merge(trials[KEYS], on=KEYS)


@cache
def _published_humans() -> Group:
    """Return one object for all studies, so that results are computed once."""
    outcomes = outcomes_with_metrics()
    return Group(
        name=HUMAN, driver=HUMAN, label=HUMAN, models=(HUMAN,), trials=outcomes,
        published_outcomes=outcomes,
    )  # fmt: skip


def humans_of(trials: pd.DataFrame) -> Group:
    """Return the humans, with the trials that are imported."""
    if trials.empty:
        return _published_humans()
    n = len(trials)
    label = HUMAN if n >= HUMAN_TRIALS else f"humans ({n} of {HUMAN_TRIALS} imported)"
    return replace(_published_humans(), trials=trials, label=label)


def levels_of(groups: Iterable[Group], order: Order) -> dict[str, list[str]]:
    """Return the levels of each factor: those in ``order``, usual ones, numbers, the rest."""
    every: dict[str, set[str]] = {}
    for group in groups:
        for factor, level in group.levels.items():
            every.setdefault(factor, set()).add(level)
    return {
        factor: sorted(levels, key=lambda level: _place(level, order.get(factor, ())))
        for factor, levels in every.items()
    }


def _place(level: str, listed: Sequence[str]) -> tuple[int, bool, float, str]:
    place = listed.index(level) if level in listed else len(listed)
    number = float(level) if NUMBER.fullmatch(level) else inf
    return place, level not in USUAL, number, level


def _as_seen(stored: Mapping[str, Any] | None, name: str, ego: str) -> dict[str, Any]:
    """Return a spec as its ego sees it, on the left, with three hashes.

    ``image`` is its hash, ``usual`` that at the usual mean speed, ``task`` one without prompt, mean
    speed and planted effects: equal for all prompts and conditions of a study.
    """
    spec, image = stored or {}, name
    if ego == "right" and {*SIDES} <= spec.keys():
        spec = {**spec, "left": spec["right"], "right": spec["left"]}
        if isinstance(blocks := spec.get("prompt_blocks"), dict):
            spec["prompt_blocks"] = {_turned(block): digest for block, digest in blocks.items()}
        image = spec_hash(canonical_json(spec))
    at_usual = {name: value for name, value in spec.items() if name != MEAN_SPEED}
    usual = spec_hash(canonical_json(at_usual)) if MEAN_SPEED in spec else image
    task = {name: value for name, value in at_usual.items() if name != "prompt_blocks"}
    for side in SIDES:
        if body := task.get(side, {}).get("body"):
            unplanted = {key: value for key, value in body.items() if key not in PLANTED}
            task[side] = {**task[side], "body": unplanted}
    hashed = hashlib.sha256(json.dumps(task, sort_keys=True).encode()).hexdigest()
    task_hash = name if stored is None else hashed
    return {"spec": spec, "image": image, "usual": usual, "task": task_hash}


def _turned(block: str) -> str:
    """Return a prompt block's name with the other side, if a side's driver alone reads it."""
    name, _, side = block.partition("@")
    return f"{name}@{'left' if side == 'right' else 'right'}" if side else block


def groups_of(
    trials: pd.DataFrame,
    specs: Mapping[str, Mapping[str, Any]],
    decisions: pd.DataFrame,
    levels: pd.DataFrame,
    order: Order,
) -> list[Group]:
    """Return groups by driver and levels, mock models last; the frames are a study's.

    All but the most frequent task settings of a driver, and texts of a prompt, carry a mark; of
    equally frequent ones that which is first in ``specs`` has none.
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
    keyed["place"] = keyed["spec_hash"].map({name: place for place, name in enumerate(specs)})
    keyed["mark"] = _marks(keyed, ["driver"], "task")
    keyed["mark"] += _marks(keyed, ["driver", "mark", "variant"], "usual")
    keyed["apart"] = keyed.groupby(["driver", "mark"])["scripted"].transform("nunique") > 1
    keys = ["driver", "mark", "apart", "scripted", "variant", "usual"]
    groups = []
    for _, rows in keyed.groupby(keys):
        counts = of_trials(decisions, rows).groupby("model")[["invalid", "asked"]].sum()
        reasons = filter(None, (not_judged(*count) for count in counts.itertuples()))
        group = _model_group(trials.loc[rows.index], rows.iloc[0], "; ".join(reasons))
        stored = [specs.get(name, {}) for name in rows["spec_hash"].unique()]
        # The rest of a trial is unknown after a first-decision probe: draws may differ later.
        is_first = rows["source"].iloc[0] == "first_decision"
        only_asked = is_first and any(map(has_chance, stored))
        programs = all(map(programs_alone, stored)) and not only_asked
        group = _distinct(group, programs=programs, scripted=group.scripted and not only_asked)
        of_group = of_trials(levels, group.trials).drop_duplicates("factor")
        named = of_group.set_index("factor")["value"].to_dict()
        ordered = {name: named[name] for name in sorted(named, key=lambda n: (n not in FIRST, n))}
        groups.append(replace(group, levels=ordered))

    def place(group: Group) -> tuple[bool, str, list[tuple[int, bool, float, str]], str]:
        levels = [_place(level, order.get(name, ())) for name, level in group.levels.items()]
        return group.scripted, group.driver, levels, group.setting

    return sorted(groups, key=place)


def _model_group(rows: pd.DataFrame, first: pd.Series, unjudged: str) -> Group:
    scripted = bool(first["scripted"])
    models: dict[Side, str] = {side: first[f"model_{side}"] for side in SIDES}
    sides = [side for side in SIDES if rows[f"{side}_scripted"].any()]
    posing = stand_in(language_models(models, first["spec"]), sides or SIDES) if scripted else ""
    driver = first["driver"] + first["mark"] + " [scripted]" * (scripted and bool(first["apart"]))
    group = Group(
        name=first["driver"],
        driver=driver,
        label=driver,
        mark=first["mark"],
        models=tuple(dict.fromkeys(models.values())),
        setting=first["variant"],
        spec_hash=min(rows["spec_hash"].unique(), key=lambda name: (name != first["usual"], name)),
        trials=rows,
        posing=posing,
        caution=unresponsive(first["spec"]),
        unjudged=unjudged,
    )
    return replace(group, label=f"{driver} ({group.remark})") if group.remark else group


def _distinct(group: Group, *, programs: bool, scripted: bool) -> Group:
    """Return the group without copies if only programs drive; count a language model's copies.

    A mock model's nth trial of one course is a copy of the nth one of another prompt.
    """
    rows = group.trials
    ended = rows[rows["trace"].notna()].sort_values(["rep", "ego"], kind="stable")
    again = ended.index[ended.duplicated(["condition", "trace"])]
    way = rows["trial_id"] + " " + rows["spec_hash"]
    drive = ended["drive"] + (" " + ended["ego"]).where(
        ended["model_left"] != ended["model_right"], ""
    )
    if programs:
        way = drive.reindex(rows.index).fillna(way)
    elif scripted:
        times = drive.groupby([drive, ended["condition"], ended["ego"]]).cumcount().astype(str)
        way = (drive + " " + times).reindex(rows.index).fillna(way)
    whole = replace(group, trials=rows.assign(way=way))
    if not programs:
        return replace(whole, equal=len(again))
    if again.empty:
        return whole
    return replace(whole, trials=whole.trials.drop(index=again), whole=whole)


def _marks(keyed: pd.DataFrame, within: list[str], what: str) -> pd.Series:
    """Return `` [mark]`` for all but the most frequent value of ``what`` within equal names."""
    sizes = keyed.groupby([*within, what])[what].transform("size")
    ordered = keyed.assign(rarity=-sizes).sort_values(["rarity", "place", what])
    usual = ordered.groupby(within)[what].transform("first").reindex(keyed.index)
    return (" [" + keyed[what].str[:8] + "]").mask(keyed[what] == usual, "")
