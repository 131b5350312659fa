"""What a study holds: one group of trials per driver and prompt variant, and the humans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import pandas as pd

from analysis.load import SHARED, load, load_plans, load_speeds, load_trials
from analysis.published import human_outcomes
from merge_runner.errors import UsageError
from merge_runner.places import DEFAULT_DB
from merge_runner.simulator.conditions import CONDITIONS

HUMAN = "human"
BASELINE = "baseline"


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

    @property
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
        trials = load_trials(self.db)
        self.human = _human_group(trials[trials["source"] == HUMAN])
        every = _model_groups(trials[trials["source"] != HUMAN])
        valid = [HUMAN, *dict.fromkeys(group.driver for group in every)]
        for name in models or ():
            if name not in valid:
                raise UsageError(f"{db} holds no driver {name!r}; valid: {', '.join(valid)}")
        wanted = valid if models is None else models
        self.models = [group for group in every if group.driver in wanted]
        self.groups = [self.human, *self.models] if HUMAN in wanted else self.models

    @property
    def baselines(self) -> list[Group]:
        """The humans and every driver with the baseline prompt."""
        return [group for group in self.groups if group.setting in {"", BASELINE}]

    def baseline_of(self, group: Group) -> Group | None:
        """The baseline of a variant's driver."""
        for other in self.models:
            if other.driver == group.driver and other.setting == BASELINE:
                return other
        return None

    @cached_property
    def profiles(self) -> pd.DataFrame:
        """One row a vehicle: the piecewise-linear fit of its speeds."""
        from analysis.piecewise import fit_profiles

        return fit_profiles(self.speeds)

    @cached_property
    def speeds(self) -> pd.DataFrame:
        """One row a vehicle: its speeds from the start of control on."""
        return load_speeds(self.db)

    @cached_property
    def deviations(self) -> pd.DataFrame:
        """One row a trial and window: RMSE of the speeds from the initial ones, and joint."""
        return load("SELECT * FROM speed_deviations ORDER BY ALL", self.db)

    @cached_property
    def plans(self) -> pd.DataFrame:
        """One row a trial with valid plans: how coarse they are, how much they were revised."""
        return load_plans(self.db)

    @cached_property
    def shared(self) -> pd.DataFrame:
        """One row a variant: how many of its calls share their reply with the baseline."""
        return load(SHARED, self.db)


def of_group(frame: pd.DataFrame, group: Group, trials: pd.DataFrame) -> pd.DataFrame:
    """The rows of a per-trial frame that belong to these trials of a group."""
    keys = trials[["trial_id", "spec_hash"]]
    return frame.merge(keys, on=["trial_id", "spec_hash"])


def _human_group(trials: pd.DataFrame) -> Group:
    if len(trials):
        return Group(HUMAN, "", str(trials["spec_hash"].iloc[0]), trials)
    return Group(HUMAN, "", None, human_outcomes(), measured=False)


def _model_groups(trials: pd.DataFrame) -> list[Group]:
    """Groups by driver and variant; equal names of different specs are told apart by the hash."""
    if trials.empty:
        return []
    names = trials["trial_id"].str.split("/").str[0]
    sets = trials["sample_set"].map(lambda number: f"/set{number}" if number else "")
    keyed = trials.assign(driver=names + sets)
    specs = keyed.groupby(["driver", "variant"])["spec_hash"].nunique()
    ambiguous = {driver for (driver, _), count in specs.items() if count > 1}
    groups = [
        Group(
            f"{driver} [{spec_hash[:8]}]" if driver in ambiguous else driver,
            variant,
            spec_hash,
            rows.drop(columns="driver"),
            scripted=bool(rows["scripted"].any()),
        )
        for (driver, variant, spec_hash), rows in keyed.groupby(["driver", "variant", "spec_hash"])
    ]
    return sorted(
        groups, key=lambda group: (group.driver, group.setting != BASELINE, group.setting)
    )
