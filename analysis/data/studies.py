"""Which study each trial was played for, and in which order that study lists its levels."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from merge_runner.study.crossing import MODEL, PROMPT
from merge_runner_analysis.data.load import load_each

KEYS = ["trial_id", "spec_hash"]
# The newest run comes first: the order of its levels counts.
SWEEPS = """
SELECT sweep_id, name, nullif(config->>'$.seat', '') AS seat, config->'$.levels' AS levels
FROM sweeps ORDER BY started_at DESC, sweep_id
"""
LINKS = "SELECT DISTINCT trial_id, spec_hash, sweep_id FROM sweep_trials"
Order = Mapping[str, list[str]]


@dataclass(frozen=True, eq=False)
class Studies:
    """The studies of a database.

    ``trials`` has a row for each trial and study that it was played for; ``orders`` holds by study
    the levels of each factor, in the order of the study.
    """

    trials: pd.DataFrame
    orders: Mapping[str, Order]

    def holds(self, study: str, frame: pd.DataFrame) -> pd.Series:
        """Return which rows of a frame are of trials that were played for a study."""
        own = self.trials.loc[self.trials["study"] == study, KEYS]
        held = pd.MultiIndex.from_frame(frame[KEYS]).isin(pd.MultiIndex.from_frame(own))
        return pd.Series(held, index=frame.index)

    def of_all(self, frame: pd.DataFrame) -> frozenset[str]:
        """Return the studies that all trials of a frame were played for."""
        return frozenset(name for name in self.orders if self.holds(name, frame).all())


def read_studies(db: Path) -> Studies:
    """Read the studies of a database from its sweeps."""
    found = load_each({"sweeps": SWEEPS, "links": LINKS}, db)
    names: dict[str, str] = {}
    orders: dict[str, dict[str, list[str]]] = {}
    for row in found["sweeps"].itertuples():
        order = json.loads(row.levels) if isinstance(row.levels, str) else {}
        name = row.name.removesuffix(f"-{row.seat}") if isinstance(row.seat, str) else row.name
        names[row.sweep_id] = named = study_name(name, order)
        merged = orders.setdefault(named, {})
        for factor, levels in order.items():
            merged[factor] = list(dict.fromkeys([*merged.get(factor, ()), *levels]))
    trials = found["links"].assign(study=found["links"]["sweep_id"].map(names))
    return Studies(trials[[*KEYS, "study"]].drop_duplicates(), orders)


def study_name(name: str, factors: Iterable[str]) -> str:
    """``mood (opponent, temperature)``: studies of one name but other factors are others."""
    own = sorted({*factors} - {MODEL, PROMPT})
    return f"{name} ({', '.join(own)})" if own else name
