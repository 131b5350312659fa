"""One trial and one decision, as they are read from the database for their pages."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.pace import Pace, pace_of
from merge_runner.records import SIDES, Side
from merge_runner_analysis.explorer.prompts import Part, parts_of
from merge_runner_analysis.explorer.reading import Row, reading, records

ONE = "WHERE trial_id = $trial AND spec_hash = $spec"
STATES = f"""
SELECT trial_id, spec_hash, side, list(time_s ORDER BY step) AS time_s,
    list(position_m ORDER BY step) AS position_m, list(velocity_mps ORDER BY step) AS velocity_mps,
    list(acceleration_mps2 ORDER BY step) AS acceleration_mps2
FROM states {ONE} GROUP BY ALL
"""  # noqa: S608 # constants
# Where a call got no answer the trial ended, and what the other driver decided is never driven.
DECISIONS = f"""
SELECT decision, time_s, side, valid, failure, tactical, plan, applied, fallback, rationale,
    false AS lost
FROM decisions {ONE}
UNION ALL BY NAME
SELECT DISTINCT decision, side, false AS valid, false AS fallback, true AS lost
FROM calls ANTI JOIN decisions USING (trial_id, spec_hash, side, decision) {ONE}
ORDER BY decision, side
"""  # noqa: S608 # constants
TASKS = f"""
SELECT source, spec
FROM (FROM trials {ONE}) LEFT JOIN specs USING (spec_hash)
"""  # noqa: S608 # constants
# Recordings do not describe their task: collisions were judged by the outlines, at 20 Hz.
HUMAN_TASK = {"collision_rule": "rectangle", "step_s": 0.05}
DECIDED = f"SELECT * FROM decisions {ONE}"  # noqa: S608 # constants
ATTEMPTS = f"SELECT * FROM calls {ONE} ORDER BY attempt"  # noqa: S608 # constants


@dataclass(frozen=True, slots=True)
class Trial:
    """A trial's samples by side and its decisions without prompts, and the task it is of.

    ``paces`` say when each driver decided.
    """

    scenario: ScenarioConfig
    paces: dict[Side, Pace]
    states: dict[Side, Row]
    decisions: list[Row]

    @property
    def end_s(self) -> float:
        """The time of the last sample."""
        return max((samples["time_s"][-1] for samples in self.states.values()), default=0.0)

    def interval_s(self, side: Side) -> float:
        """How long a decision of a side is driven."""
        return self.paces[side].interval_steps * self.scenario.step_s


@dataclass(frozen=True, slots=True)
class Decision:
    """A decision, the one before on the same side, None for the first, and its attempts."""

    row: Row
    before: Row | None
    attempts: list[Row]

    @property
    def parts(self) -> list[Part]:
        """The prompt in parts, each compared with the one before."""
        return parts_of(self.row["prompt"] or "", self.before["prompt"] if self.before else None)


def read_trial(db: Path, trial_id: str, spec_hash: str) -> Trial:
    """Read a trial that is known to be there."""
    key = {"trial": trial_id, "spec": spec_hash}
    with reading(db) as connection:
        states = records(connection, STATES, key)
        decisions = records(connection, DECISIONS, key)
        (task,) = records(connection, TASKS, key)
    told = json.loads(task["spec"] or "{}")
    scenario = scenario_of(task["source"], told.get("scenario"))
    samples = {row["side"]: row for row in states}
    trial = Trial(
        scenario,
        {side: pace_of(scenario, told.get(side, {})) for side in SIDES},
        {side: samples[side] for side in SIDES if side in samples},
        decisions,
    )
    for row in decisions:
        if row["lost"]:
            row["time_s"] = trial.end_s
        row["driven"] = row["time_s"] < trial.end_s
    return trial


def read_decisions(db: Path, trial_id: str, spec_hash: str) -> dict[tuple[str, int], Decision]:
    """Read all decisions of a trial that is known to be there, by side and number.

    A call without an answer ends its trial before there is a decision: what was asked is there.
    """
    key = {"trial": trial_id, "spec": spec_hash}
    with reading(db) as connection:
        rows = records(connection, DECIDED, key)
        calls = records(connection, ATTEMPTS, key)
    decided = {(row["side"], row["decision"]): {**row, "lost": False} for row in rows}
    attempts: dict[tuple[str, int], list[Row]] = {}
    for call in calls:
        attempts.setdefault((call["side"], call["decision"]), []).append(call)
    decisions = {}
    for side, number in sorted({*decided, *attempts}, key=lambda at: (at[1], at[0])):
        lost = {"decision": number, "side": side, "lost": True, "prompt": None}
        decisions[side, number] = Decision(
            decided.get((side, number), lost),
            decided.get((side, number - 1)),
            attempts.get((side, number), []),
        )
    return decisions


def scenario_of(source: str, told: Mapping[str, Any] | None) -> ScenarioConfig:
    """The task of a trial, as its spec tells it, or as it usually is."""
    usual = HUMAN_TASK if source == "human" else {}
    return ScenarioConfig.model_validate(usual if told is None else told)
