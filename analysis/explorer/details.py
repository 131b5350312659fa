"""One trial and one decision, as they are read from the database for their pages."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import duckdb

from analysis.explorer.prompts import Part, parts_of
from merge_runner.config import Scenario
from merge_runner.database import read_database
from merge_runner.records import SIDES, Side

Row = dict[str, Any]
OF_TRIAL = "trial_id = ? AND spec_hash = ?"
STATES = f"""
SELECT side, list(time_s ORDER BY step) AS time_s, list(position_m ORDER BY step) AS position_m,
    list(velocity_mps ORDER BY step) AS velocity_mps,
    list(acceleration_mps2 ORDER BY step) AS acceleration_mps2
FROM states WHERE {OF_TRIAL} GROUP BY ALL
"""  # noqa: S608 # constants
DECISIONS = f"""
SELECT decision, time_s, side, valid, failure, tactical, plan, applied, fallback, rationale
FROM decisions WHERE {OF_TRIAL} ORDER BY decision, side
"""  # noqa: S608 # constants
# A decision and the one before it on the same side.
DECIDED = f"""
SELECT * FROM decisions WHERE {OF_TRIAL} AND side = ? AND decision IN (?, ? - 1) ORDER BY decision
"""  # noqa: S608 # constants
ATTEMPTS = f"""
SELECT * FROM calls WHERE {OF_TRIAL} AND side = ? AND decision = ? ORDER BY attempt
"""  # noqa: S608 # constants


@dataclass(frozen=True, slots=True)
class Trial:
    """A trial's samples by side and its decisions without prompts; ``scenario`` is its task's."""

    trial_id: str
    spec_hash: str
    scenario: Scenario
    states: dict[Side, Row]
    decisions: list[Row]

    @property
    def end_s(self) -> float:
        """The time of the last sample."""
        return max((samples["time_s"][-1] for samples in self.states.values()), default=0.0)


@dataclass(frozen=True, slots=True)
class Decision:
    """A decision with its prompt in parts, each compared with the one before, and its attempts.

    ``before`` is the decision before on the same side, None for the first.
    """

    row: Row
    before: Row | None
    parts: list[Part]
    attempts: list[Row]


def read_trial(db: Path, trial_id: str, spec_hash: str) -> Trial:
    """Read a trial that is known to be there."""
    key = [trial_id, spec_hash]
    with read_database(db) as connection:
        states = {row.pop("side"): row for row in _records(connection, STATES, key)}
        decisions = _records(connection, DECISIONS, key)
        spec = _records(connection, "SELECT spec FROM specs WHERE spec_hash = ?", [spec_hash])
    told = json.loads(spec[0]["spec"]) if spec else {}
    scenario = Scenario.model_validate(told.get("scenario", {}))
    ordered = {side: states[side] for side in SIDES if side in states}
    return Trial(trial_id, spec_hash, scenario, ordered, decisions)


def read_decision(
    db: Path, trial_id: str, spec_hash: str, side: str, number: int
) -> Decision | None:
    """Read a decision; None where there is none."""
    key = [trial_id, spec_hash, side, number]
    with read_database(db) as connection:
        found = _records(connection, DECIDED, [*key, number])
        attempts = _records(connection, ATTEMPTS, key)
    if not found or found[-1]["decision"] != number:
        if not attempts:
            return None
        # A call without an answer ends its trial before there is a decision.
        row: Row = {"decision": number, "side": side, "prompt": None, "lost": True}
        return Decision(row, None, [], attempts)
    row = {**found[-1], "lost": False}
    before = found[0] if len(found) > 1 else None
    parts = parts_of(row["prompt"] or "", before["prompt"] if before else None)
    return Decision(row, before, parts, attempts)


def _records(connection: duckdb.DuckDBPyConnection, sql: str, values: list[Any]) -> list[Row]:
    found = connection.execute(sql, values)
    names = [column[0] for column in found.description]
    return [dict(zip(names, row, strict=True)) for row in found.fetchall()]
