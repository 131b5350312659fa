"""Trials as they are read: their samples, their decisions with their calls, and their tasks."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from duckdb import DuckDBPyConnection

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.pace import Pace, pace_of
from merge_runner.records import SIDES, Side
from merge_runner.results.database import by_name, names_of
from merge_runner_analysis.web.reading import Row, records
from merge_runner_analysis.web.trial.prompt_parts import digests_of

Key = tuple[str, str]
"""The name of a trial, and its spec."""
OF_THEM = "WHERE (trial_id, spec_hash) IN (SELECT unnest($trials), unnest($specs))"
STATES = f"""
SELECT trial_id, spec_hash, side, list(time_s ORDER BY step) AS time_s,
    list(position_m ORDER BY step) AS position_m, list(velocity_mps ORDER BY step) AS velocity_mps,
    list(acceleration_mps2 ORDER BY step) AS acceleration_mps2
FROM states {OF_THEM} GROUP BY ALL ORDER BY side
"""  # noqa: S608 # constants
DECISIONS = f"SELECT *, false AS lost FROM decisions {OF_THEM}"  # noqa: S608 # constants
CALLS = f"SELECT * EXCLUDE request FROM calls {OF_THEM} ORDER BY attempt"  # noqa: S608 # constants
PERCEIVED = f"FROM perceptions {OF_THEM}"
TASKS = f"""
SELECT trial_id, spec_hash, source, spec
FROM (FROM trials {OF_THEM}) LEFT JOIN specs USING (spec_hash)
"""  # noqa: S608 # constants
# Recordings do not describe their task: collisions were judged by the outlines, at 20 Hz, and a
# vehicle whose pedals are released slows down.
HUMAN_TASK = {"collision_rule": "rectangle", "step_s": 0.05, "resistance": "human"}


@dataclass(frozen=True, slots=True)
class Trial:
    """A trial's samples by side, its decisions, and the task it is of.

    ``paces`` say when each driver decided. A decision is a row with the one ``before`` on its side,
    its ``attempts`` and the last ``reply``, what was ``perceived`` where that was imperfect,
    whether its call was ``lost`` and whether it was ``driven``. ``blocks`` are the digests of each
    side's prompt.
    """

    scenario: ScenarioConfig
    paces: dict[Side, Pace]
    states: dict[Side, Row]
    decisions: list[Row]
    blocks: dict[Side, dict[str, str]]

    @property
    def end_s(self) -> float:
        """The time of the last sample."""
        return max((samples["time_s"][-1] for samples in self.states.values()), default=0.0)

    @property
    def by_side(self) -> dict[Side, list[Row]]:
        """The decisions of each side that has any."""
        by_side = {side: [d for d in self.decisions if d["side"] == side] for side in SIDES}
        return {side: rows for side, rows in by_side.items() if rows}


def read_trials(connection: DuckDBPyConnection, keys: Sequence[Key]) -> list[Trial]:
    """Read trials that are known to be there, by their names and specs."""
    parameters = {"trials": [name for name, _ in keys], "specs": [spec for _, spec in keys]}
    states, calls, tasks = (
        _by_trial(records(connection, sql, parameters)) for sql in (STATES, CALLS, TASKS)
    )
    result = connection.execute(DECISIONS, parameters)
    lost = dict.fromkeys(names_of(result)) | {"valid": False, "fallback": False, "lost": True}
    rows = list(by_name(result))
    is_noisy = any(row["other_seen"] is not None for row in rows)
    decisions = _by_trial(rows)
    perceived = _by_trial(records(connection, PERCEIVED, parameters) if is_noisy else ())
    return [
        _trial(tasks[key][0], states[key], decisions[key], calls[key], perceived[key], lost)
        for key in keys
    ]


def _by_trial(rows: Iterable[Row]) -> dict[Key, list[Row]]:
    by_trial = defaultdict[Key, list[Row]](list)
    for row in rows:
        by_trial[row["trial_id"], row["spec_hash"]].append(row)
    return by_trial


def _trial(
    task: Row,
    states: Sequence[Row],
    decisions: Sequence[Row],
    calls: Sequence[Row],
    perceptions: Sequence[Row],
    lost: Row,
) -> Trial:
    """Return a trial of its rows; ``lost`` is the row of a decision without an answer."""
    made = {(row["decision"], row["side"]): row for row in decisions}
    for call in calls:
        place = call["decision"], call["side"]
        # Where it got no answer the trial ended, and what the other driver decided is never driven.
        row = made.setdefault(place, lost | dict(zip(("decision", "side"), place, strict=True)))
        row.setdefault("attempts", []).append(call)
    perceived = {(row["decision"], row["side"]): row for row in perceptions}
    spec = json.loads(task["spec"] or "{}")
    scenario = scenario_of(task["source"], spec.get("scenario"))
    trial = Trial(
        scenario,
        {side: pace_of(scenario, spec.get(side, {})) for side in SIDES},
        {row["side"]: row for row in states},
        [made[place] for place in sorted(made)],
        {side: digests_of(spec.get("prompt_blocks") or {}, side) for side in SIDES},
    )
    before: dict[str, Row] = {}
    for row in trial.decisions:
        row.setdefault("attempts", [])
        replies = [call["reply"] for call in row["attempts"] if call["reply"] is not None]
        row["reply"] = replies[-1] if replies else None
        row["perceived"] = perceived.get((row["decision"], row["side"]))
        if row["lost"]:
            row["time_s"] = trial.end_s
        row |= {"driven": row["time_s"] < trial.end_s, "before": before.get(row["side"])}
        before[row["side"]] = row
    return trial


def scenario_of(source: str, spec: Mapping[str, Any] | None) -> ScenarioConfig:
    """Return the task of a trial from its spec, or the usual one."""
    usual = HUMAN_TASK if source == "human" else {}
    return ScenarioConfig.model_validate(usual if spec is None else spec)


def controlled(samples: Row, name: str) -> list[float]:
    """Return a vehicle's samples from the start of control on; in the tunnels it has none."""
    return [x for t, x in zip(samples["time_s"], samples[name], strict=True) if t >= 0]
