"""Results as data frames: single queries, and all that a study reads at once."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import duckdb
import pandas as pd

from merge_runner.audit.checks import ASKED_DECISIONS
from merge_runner.paths import DEFAULT_DB
from merge_runner.results import frames
from merge_runner.results.database import read_database
from merge_runner.results.instance import limit_memory
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner.served_model import other_models, sql_of
from merge_runner.study.runs import study_name
from merge_runner.text_safety import quoted
from merge_runner_analysis.queries import COUNTED, QUERIES
from merge_runner_analysis.trials import judged, with_metrics

PUBLISHED_CONDITIONS = ", ".join(
    f"({quoted(name)}, {at.projected_headway_m!r}::DOUBLE, {at.relative_velocity_mps!r}::DOUBLE)"
    for name, at in HUMAN_CONDITIONS.items()
)
TRIALS = QUERIES["trials"].format(published=PUBLISHED_CONDITIONS)
SPEEDS = QUERIES["speeds"]
CALLS = f"""
SELECT trial_id, spec_hash, attempts, calls, retried, lost, unknown, failures, decisions,
    others AS other_model, fallbacks AS fallback
FROM ({COUNTED}) ORDER BY ALL
"""  # noqa: S608 # constants
KEYS = ["trial_id", "spec_hash"]
LINKS = "SELECT DISTINCT trial_id, spec_hash, sweep_id FROM sweep_trials"
MANY_STATES = 1_500_000
Order = Mapping[str, list[str]]


def load(sql: str, db: Path | str = DEFAULT_DB) -> pd.DataFrame:
    """Return the rows of one read-only query; raises UsageError."""
    return frames.load(Path(db), sql)


def read(db: Path, sql: str) -> pd.DataFrame:
    """Return the rows of a query of ours; its lists are arrays. Raises UsageError."""
    with read_database(db) as connection:
        _limit(connection)
        return connection.execute(sql).df()


def _limit(connection: duckdb.DuckDBPyConnection) -> None:
    """Let DuckDB cache little of the file, unless lists of the states need more: 40 B for each."""
    [(states,)] = connection.execute("SELECT count(*) FROM states").fetchall()
    if states < MANY_STATES:
        limit_memory(connection)


def load_trials(db: Path | str = DEFAULT_DB) -> pd.DataFrame:
    """Return one row per trial as its ``ego`` sees it, in SI units; see docs/tables.md.

    A trial whose ego sat on the right is mirrored; first-decision probes are left out.
    """
    return load(f"FROM ({TRIALS}) WHERE source <> 'first_decision'", db)


class Studies(NamedTuple):
    """The studies of a database."""

    trials: pd.DataFrame
    """A row for each trial and each run that it was played for: its key, sweep_id, study."""
    orders: Mapping[str, Order]
    """The levels of each factor, in the order of the study, by study."""
    called: Mapping[str, str]
    """The user's name for each run, by its id; empty without a name."""
    texts: Mapping[str, str]
    """The text of a study's file in its newest run, by study."""

    def holds(self, study: str, frame: pd.DataFrame) -> pd.Series:
        """Return which rows of a frame are of trials that were played for a study."""
        members = self.trials.loc[self.trials["study"] == study, KEYS]
        is_member = pd.MultiIndex.from_frame(frame[KEYS]).isin(pd.MultiIndex.from_frame(members))
        return pd.Series(is_member, index=frame.index)


class Frames(NamedTuple):
    """Rows that a study reads of its database, while nobody writes there."""

    trials: pd.DataFrame
    """TRIALS and their traces, with a column for each metric and for each collision rule."""
    probes: pd.DataFrame
    """First-decision probes: TRIALS and their traces, with a column for each metric."""
    specs: Mapping[str, dict[str, Any]]
    """By their hashes, those of the newest run first."""
    studies: Studies
    calls: pd.DataFrame
    """CALLS: outcomes of the calls, by trial."""
    decisions: pd.DataFrame
    """ASKED_DECISIONS: how many are invalid, by trial and model."""
    levels: pd.DataFrame
    """The levels of factors, by trial."""


def read_frames(db: Path) -> Frames:
    """Read the data frames of a study, in one opening of the file; raises UsageError."""
    with read_database(db) as connection:
        _limit(connection)

        def rows(sql: str) -> pd.DataFrame:
            return frames.frame(connection.execute(sql))

        specs = {row.spec_hash: json.loads(row.spec) for row in rows(QUERIES["specs"]).itertuples()}
        calls = rows(CALLS.format(others=sql_of(other_models(connection))))
        trials = with_metrics(connection, TRIALS).merge(
            rows(QUERIES["traces"]), on=KEYS, how="left"
        )
        asked = trials["source"] == "first_decision"
        played = judged(connection, trials[~asked], specs)
        studies = _studies(rows(QUERIES["sweeps"]), rows(LINKS))
        decisions, levels = rows(ASKED_DECISIONS), rows("FROM trial_levels")
    return Frames(played, trials[asked], specs, studies, calls, decisions, levels)


def _studies(sweeps: pd.DataFrame, links: pd.DataFrame) -> Studies:
    names: dict[str, str] = {}
    orders: dict[str, dict[str, list[str]]] = {}
    for row in sweeps.itertuples():
        order = json.loads(row.levels)
        names[row.sweep_id] = study_name(row.name.removesuffix(row.suffix), order)
        known = orders.setdefault(names[row.sweep_id], {})
        for factor, levels in order.items():
            known[factor] = list(dict.fromkeys([*known.get(factor, ()), *levels]))
    called = sweeps.set_index("sweep_id")["run_name"].fillna("").to_dict()
    written = sweeps.dropna(subset="text").iloc[::-1]  # of several the newest stands
    texts = dict(zip(written["sweep_id"].map(names), written["text"], strict=True))
    return Studies(links.assign(study=links["sweep_id"].map(names)), orders, called, texts)
