"""What a study holds: one group of trials per driver and prompt variant, and the humans."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import pandas as pd

from analysis.intermittency import measure_profiles
from analysis.load import (
    LEFT_SPEEDS,
    PLANS,
    SHARED,
    SPECS,
    SPEEDS,
    TRIALS,
    Calls,
    load_calls,
    load_each,
)
from analysis.published import human_outcomes
from merge_runner.errors import UsageError
from merge_runner.places import DEFAULT_DB
from merge_runner.simulator.conditions import CONDITIONS

HUMAN = "human"
BASELINE = "baseline"
# So many human trials in every condition make a reference; fewer are shown, but not drawn from.
ENOUGH_PER_CONDITION = 5


@dataclass(frozen=True, eq=False)
class Group:
    """Trials of equal drivers, prompts and parameters.

    ``trials`` are rows of ``load_trials``; for humans before an import only the outcomes that are
    published, and ``measured`` is False. ``setting`` is the prompt variant, empty for humans.
    """

    driver: str
    setting: str
    spec_hash: str | None
    trials: pd.DataFrame
    measured: bool = True
    scripted: bool = False

    @property
    def id(self) -> str:
        """``o3/A2``, or ``human``."""
        return f"{self.driver}/{self.setting}" if self.setting else self.driver

    @cached_property
    def ended(self) -> pd.DataFrame:
        """The trials that did not fail."""
        return self.trials[self.trials["status"] != "failed"]

    @cached_property
    def finished(self) -> pd.DataFrame:
        """The trials that a vehicle finished without a collision."""
        return self.trials[self.trials["status"] == "finished"]

    @property
    def sizes(self) -> tuple[int, ...]:
        """How many trials ended in each condition, in the order of CONDITIONS."""
        counts = self.ended["condition"].value_counts()
        return tuple(int(counts.get(name, 0)) for name in CONDITIONS)

    @cached_property
    def left_out(self) -> str:
        """Which trials are not among the finished ones, in words."""
        counts = self.trials["status"].value_counts()
        parts = [
            f"{counts[status]} {status}"
            for status in ("collided", "timeout", "failed")
            if counts.get(status, 0)
        ]
        return ", ".join(parts) or "none"


class Study:
    """The groups of a database, humans first, and what is computed from their traces once."""

    def __init__(self, db: Path | str = DEFAULT_DB, models: Sequence[str] | None = None) -> None:
        """Read the trials; ``models`` keeps these drivers alone. Raises UsageError."""
        self.db = Path(db)
        found = load_each({"trials": TRIALS, "specs": SPECS}, self.db)
        trials = found["trials"]
        self.human = _human_group(trials[trials["source"] == HUMAN])
        every = _model_groups(trials[trials["source"] != HUMAN], _tasks(found["specs"]))
        valid = [HUMAN, *dict.fromkeys(group.driver for group in every)]
        wanted = valid if models is None else list(models)
        unknown = [name for name in wanted if name not in valid]
        if unknown or not wanted:
            named = f"no driver {unknown[0]!r}" if unknown else "nothing that --models names"
            raise UsageError(f"{db} holds {named}; valid: {', '.join(valid)}")
        self.empty = not every
        self.models = [group for group in every if group.driver in wanted]
        self.groups = [self.human, *self.models] if HUMAN in wanted else self.models

    @property
    def calibrated(self) -> bool:
        """Whether enough human traces are imported to draw ceilings and limits from them."""
        return self.human.measured and min(self.human.sizes) >= ENOUGH_PER_CONDITION

    @property
    def baselines(self) -> list[Group]:
        """The humans and every driver with the baseline prompt."""
        return [group for group in self.groups if group.setting in {"", BASELINE}]

    @cached_property
    def profiles(self) -> pd.DataFrame:
        """One row a vehicle: whether it acted, and how far its acceleration is held."""
        return measure_profiles(self._read(SPEEDS))

    @cached_property
    def left_speeds(self) -> pd.DataFrame:
        """One row a finished baseline trial: the left vehicle's speeds under control."""
        return self._read(LEFT_SPEEDS)

    @cached_property
    def deviations(self) -> pd.DataFrame:
        """One row a trial and window: RMSE of the speeds from the initial ones, and joint."""
        return self._read("SELECT * FROM speed_deviations ORDER BY ALL")

    @cached_property
    def plans(self) -> pd.DataFrame:
        """One row a trial with valid plans: how coarse they are, how much they were revised."""
        return self._read(PLANS)

    @cached_property
    def calls(self) -> Calls:
        """What became of the calls, by trial."""
        return load_calls(self.db)

    @cached_property
    def shared(self) -> pd.DataFrame:
        """One row a variant: how many of its calls share their reply with the baseline."""
        return self._read(SHARED)

    def _read(self, sql: str) -> pd.DataFrame:
        return load_each({"rows": sql}, self.db)["rows"]


def of_group(frame: pd.DataFrame, group: Group, trials: pd.DataFrame) -> pd.DataFrame:
    """The rows of a per-trial frame that belong to these trials of a group."""
    keys = trials[["trial_id", "spec_hash"]]
    # To join all rows takes longer than to leave out those of other groups first.
    near = frame["spec_hash"].isin(keys["spec_hash"].unique())
    return frame[near].merge(keys, on=["trial_id", "spec_hash"])


def _human_group(trials: pd.DataFrame) -> Group:
    if len(trials):
        return Group(HUMAN, "", str(trials["spec_hash"].iloc[0]), trials)
    return _published_group()


@cache
def _published_group() -> Group:
    """One object for all studies: what is computed from it is computed once."""
    return Group(HUMAN, "", None, human_outcomes(), measured=False)


def _tasks(specs: pd.DataFrame) -> dict[str, str]:
    """Spec hash to a hash of what it covers beside the prompt: equal for variants of one study."""
    tasks = {}
    for row in specs.itertuples():
        spec = json.loads(row.spec)
        spec.pop("prompt_blocks", None)
        text = json.dumps(spec, sort_keys=True)
        tasks[row.spec_hash] = hashlib.sha256(text.encode()).hexdigest()[:8]
    return tasks


def _model_groups(trials: pd.DataFrame, tasks: dict[str, str]) -> list[Group]:
    """Groups by driver and variant.

    Where a driver was run under several settings of the task, all but the most frequent carry a
    mark, the same for a baseline and its variants; likewise where a prompt was changed.
    """
    if trials.empty:
        return []
    names = trials["trial_id"].str.split("/").str[0]
    sets = trials["sample_set"].map(lambda number: f"/set{number}" if number else "")
    task = trials["spec_hash"].map(lambda spec_hash: tasks.get(spec_hash, spec_hash[:8]))
    keyed = trials.assign(driver=names + sets, task=task)
    keyed["driver"] += _marks(keyed, ["driver"], "task")
    keyed["driver"] += _marks(keyed, ["driver", "variant"], "spec_hash")
    groups = [
        Group(
            driver,
            variant,
            spec_hash,
            rows.drop(columns=["driver", "task"]),
            scripted=bool(rows["scripted"].any()),
        )
        for (driver, variant, spec_hash), rows in keyed.groupby(["driver", "variant", "spec_hash"])
    ]
    return sorted(
        groups, key=lambda group: (group.driver, group.setting != BASELINE, group.setting)
    )


def _marks(keyed: pd.DataFrame, within: list[str], what: str) -> pd.Series:
    """`` [mark]`` for all but the most frequent value of ``what`` within equal names."""
    counts = keyed.groupby([*within, what]).size().reset_index(name="n")
    ordered = counts.sort_values(
        [*within, "n", what], ascending=[True] * len(within) + [False, True]
    )
    usual = ordered.drop_duplicates(within).set_index(within)[what]
    keys = pd.MultiIndex.from_frame(keyed[within]) if len(within) > 1 else keyed[within[0]]
    expected = usual.reindex(keys).to_numpy()
    marks = [
        "" if found == usually else f" [{found[:8]}]"
        for found, usually in zip(keyed[what], expected, strict=True)
    ]
    return pd.Series(marks, index=keyed.index)
