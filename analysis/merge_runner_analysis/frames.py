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
from merge_runner_analysis.calls import COUNTED
from merge_runner_analysis.trials import judged, with_metrics

# One row per trial, as its ego sees it (see ``trial_drivers``). A trial whose ego sat on the right
# is mirrored: "left" is the ego everywhere, headway and relative velocity are the ego's minus the
# other's, and the condition is the one with these numbers. If no condition has them, its name is
# that of the driven one and the word mirrored.
_PUBLISHED = ", ".join(
    f"({quoted(name)}, {at.projected_headway_m!r}::DOUBLE, {at.relative_velocity_mps!r}::DOUBLE)"
    for name, at in HUMAN_CONDITIONS.items()
)
TRIALS = f"""
WITH placed AS (
    SELECT trials.*, driver, ego, ego = 'right' AS turned,
        (spec->>'$.mean_speed_mps')::DOUBLE AS mean_mps
    FROM trials JOIN trial_drivers USING (trial_id, spec_hash) LEFT JOIN specs USING (spec_hash)
), known (image, headway_m, velocity_mps, mean_mps, own) AS (
    SELECT *, NULL::DOUBLE, false FROM (VALUES {_PUBLISHED})
    UNION SELECT condition, projected_headway_m, relative_velocity_mps, mean_mps, true FROM placed
), images AS (
    SELECT headway_m, velocity_mps, mean_mps, arg_min(image, (own, image)) AS image
    FROM known GROUP BY ALL
)
SELECT placed.* EXCLUDE (driver, ego, turned, mean_mps) REPLACE (
        if(turned, coalesce(image, condition || ' mirrored'), condition) AS condition,
        if(turned, 0 - projected_headway_m, projected_headway_m) AS projected_headway_m,
        if(turned, 0 - relative_velocity_mps, relative_velocity_mps) AS relative_velocity_mps,
        if(turned, model_right, model_left) AS model_left,
        if(turned, model_left, model_right) AS model_right,
        if(turned, CASE merged_first WHEN 'left' THEN 'right' WHEN 'right' THEN 'left' END,
            merged_first) AS merged_first
    ), driver,
    coalesce(if(turned, right_scripted, left_scripted), false) AS left_scripted,
    coalesce(if(turned, left_scripted, right_scripted), false) AS right_scripted,
    trial_metrics.* EXCLUDE (trial_id, spec_hash) REPLACE (
        if(turned, rmse_right_mps, rmse_left_mps) AS rmse_left_mps,
        if(turned, rmse_left_mps, rmse_right_mps) AS rmse_right_mps
    ), ego, cost_usd,
    CASE WHEN model_left = model_right THEN left_replies + right_replies
        WHEN turned THEN right_replies ELSE left_replies END AS replies,
    CASE WHEN model_left = model_right THEN left_valid + right_valid
        WHEN turned THEN right_valid ELSE left_valid END AS valid_replies
FROM placed JOIN trial_metrics USING (trial_id, spec_hash)
LEFT JOIN (
    SELECT trial_id, spec_hash, bool_or(scripted AND side = 'left') AS left_scripted,
        bool_or(scripted AND side = 'right') AS right_scripted,
        if(count(*) = count(cost_usd), sum(cost_usd), NULL) AS cost_usd
    FROM calls GROUP BY ALL
) USING (trial_id, spec_hash)
LEFT JOIN (
    SELECT trial_id, spec_hash, count(*) FILTER (side = 'left') AS left_replies,
        count(*) FILTER (side = 'right') AS right_replies,
        count(*) FILTER (side = 'left' AND valid) AS left_valid,
        count(*) FILTER (side = 'right' AND valid) AS right_valid
    FROM decisions WHERE call_key IS NOT NULL GROUP BY ALL
) USING (trial_id, spec_hash)
LEFT JOIN images ON turned AND headway_m = 0 - projected_headway_m
    AND velocity_mps = 0 - relative_velocity_mps
    AND images.mean_mps IS NOT DISTINCT FROM placed.mean_mps
ORDER BY trial_id, spec_hash
"""  # noqa: S608 # constants
# Hashes of each driven trial that ended: its states as its ego sees them and as they are, with the
# other determinants of its outcome and its gap. Equal ones went the same way.
TRACES = """
SELECT trial_id, spec_hash, concat_ws(' ', seen, beside) AS trace, concat_ws(' ', driven, beside)
    AS drive
FROM (
    SELECT trial_id, spec_hash, sum(hash(step, if(side = ego, 'left', 'right'), position_m,
        velocity_mps)) AS seen, sum(hash(step, side, position_m, velocity_mps)) AS driven
    FROM states JOIN trial_drivers USING (trial_id, spec_hash) GROUP BY ALL
) JOIN (
    SELECT trial_id, spec_hash, concat_ws(' ', status, spec->>'$.scenario.vehicle_length_m',
        spec->>'$.scenario.vehicle_width_m') AS beside
    FROM trials LEFT JOIN specs USING (spec_hash) WHERE source <> 'human' AND status <> 'failed'
) USING (trial_id, spec_hash)
"""
# One row a vehicle: its speeds under control, and whether the simulator slowed it by itself. It
# cruises until its first decision; humans' decisions are not on record.
SPEEDS = """
SELECT trial_id, spec_hash, side, list(time_s ORDER BY step) AS time_s,
    list(velocity_mps ORDER BY step) AS velocity_mps,
    any_value(resisted) AS resisted
FROM states JOIN (
    SELECT spec_hash,
        coalesce(spec->>'$.source', spec->>'$.scenario.resistance', '') = 'human'
        AS resisted FROM specs
) USING (spec_hash) LEFT JOIN (
    SELECT trial_id, spec_hash, side, min(time_s) AS first_s FROM decisions GROUP BY ALL
) USING (trial_id, spec_hash, side)
WHERE time_s >= greatest(0, coalesce(first_s, 0)) GROUP BY ALL ORDER BY ALL
"""
CALLS = f"""
SELECT trial_id, spec_hash, attempts, calls, retried, lost, unknown, failures, decisions,
    others AS other_model, fallbacks AS fallback
FROM ({COUNTED}) ORDER BY ALL
"""  # noqa: S608 # constants
# Those of the newest run come first.
SPECS = """
SELECT spec_hash, spec FROM specs JOIN trials USING (spec_hash)
LEFT JOIN sweep_trials USING (trial_id, spec_hash) LEFT JOIN sweeps USING (sweep_id)
GROUP BY ALL ORDER BY max(started_at) DESC NULLS LAST, spec_hash
"""
KEYS = ["trial_id", "spec_hash"]
# The newest run comes first: the order of its levels counts.
SWEEPS = """
SELECT sweep_id, name, coalesce('-' || nullif(config->>'$.seat', ''), '') AS suffix,
    coalesce(config->'$.levels', '{}') AS levels, config->>'$.run_name' AS run_name,
    config->>'$.study.text' AS text
FROM sweeps ORDER BY started_at DESC, sweep_id
"""
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
    """TRIALS and TRACES, with a column for each metric and for each collision rule."""
    probes: pd.DataFrame
    """First-decision probes: TRIALS and TRACES, with a column for each metric."""
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

        specs = {row.spec_hash: json.loads(row.spec) for row in rows(SPECS).itertuples()}
        calls = rows(CALLS.format(others=sql_of(other_models(connection))))
        trials = with_metrics(connection, TRIALS).merge(rows(TRACES), on=KEYS, how="left")
        asked = trials["source"] == "first_decision"
        played = judged(connection, trials[~asked], specs)
        studies = _studies(rows(SWEEPS), rows(LINKS))
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
