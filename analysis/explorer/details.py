"""One trial with its decisions, as they are read from the database for their pages."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.pace import Pace, pace_of
from merge_runner.records import SIDES, Side
from merge_runner_analysis.explorer.reading import Row, reading, records

ONE = "WHERE trial_id = $trial AND spec_hash = $spec"
STATES = f"""
SELECT side, list(time_s ORDER BY step) AS time_s,
    list(position_m ORDER BY step) AS position_m, list(velocity_mps ORDER BY step) AS velocity_mps,
    list(acceleration_mps2 ORDER BY step) AS acceleration_mps2
FROM states {ONE} GROUP BY ALL
"""  # noqa: S608 # constants
# Where a call got no answer the trial ended, and what the other driver decided is never driven.
DECISIONS = f"""
SELECT *, false AS lost FROM decisions {ONE}
UNION ALL BY NAME
SELECT DISTINCT decision, side, false AS valid, false AS fallback, true AS lost
FROM calls ANTI JOIN decisions USING (trial_id, spec_hash, side, decision) {ONE}
ORDER BY decision, side
"""  # noqa: S608 # constants
ATTEMPTS = f"SELECT * EXCLUDE request FROM calls {ONE} ORDER BY attempt"  # noqa: S608 # constants
PERCEIVED = f"FROM perceptions {ONE}"
TASKS = f"""
SELECT source, spec
FROM (FROM trials {ONE}) LEFT JOIN specs USING (spec_hash)
"""  # noqa: S608 # constants
# Recordings do not describe their task: collisions were judged by the outlines, at 20 Hz.
HUMAN_TASK = {"collision_rule": "rectangle", "step_s": 0.05}


@dataclass(frozen=True, slots=True)
class Trial:
    """A trial's samples by side, its decisions, and the task it is of.

    ``paces`` say when each driver decided. A decision is a row with the one ``before`` on its side,
    its ``attempts``, what was ``perceived`` where that was imperfect, whether its call was ``lost``
    and whether it was ``driven``.
    """

    scenario: ScenarioConfig
    paces: dict[Side, Pace]
    states: dict[Side, Row]
    decisions: list[Row]

    @property
    def end_s(self) -> float:
        """The time of the last sample."""
        return max((samples["time_s"][-1] for samples in self.states.values()), default=0.0)

    @property
    def by_side(self) -> dict[Side, list[Row]]:
        """The decisions of each side that has any."""
        decided = {side: [d for d in self.decisions if d["side"] == side] for side in SIDES}
        return {side: mine for side, mine in decided.items() if mine}

    def interval_s(self, side: Side) -> float:
        """How long a decision of a side is driven."""
        return self.paces[side].interval_steps * self.scenario.step_s


def read_trial(db: Path, trial_id: str, spec_hash: str) -> Trial:
    """Read a trial that is known to be there."""
    key = {"trial": trial_id, "spec": spec_hash}
    with reading(db) as connection:
        states, decisions, calls, perceived, (task,) = (
            records(connection, sql, key) for sql in (STATES, DECISIONS, ATTEMPTS, PERCEIVED, TASKS)
        )
    told = json.loads(task["spec"] or "{}")
    scenario = scenario_of(task["source"], told.get("scenario"))
    samples = {row["side"]: row for row in states}
    trial = Trial(
        scenario,
        {side: pace_of(scenario, told.get(side, {})) for side in SIDES},
        {side: samples[side] for side in SIDES if side in samples},
        decisions,
    )
    attempts: dict[tuple[str, int], list[Row]] = {}
    for call in calls:
        attempts.setdefault((call["side"], call["decision"]), []).append(call)
    seen = {(row["side"], row["decision"]): row for row in perceived}
    before: dict[str, Row] = {}
    for row in decisions:
        side, number = row["side"], row["decision"]
        if row["lost"]:
            row["time_s"] = trial.end_s
        row |= {
            "driven": row["time_s"] < trial.end_s,
            "before": before.get(side),
            "attempts": attempts.get((side, number), []),
            "perceived": seen.get((side, number)),
        }
        before[side] = row
    return trial


def scenario_of(source: str, told: Mapping[str, Any] | None) -> ScenarioConfig:
    """The task of a trial, as its spec tells it, or as it usually is."""
    usual = HUMAN_TASK if source == "human" else {}
    return ScenarioConfig.model_validate(usual if told is None else told)
