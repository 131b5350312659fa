"""What the trials would have come to under the other readings of "collision".

The stored plans are driven again. Where a trial ended in a collision that another rule does not
see, the drivers' last plans go on as far as they reach; what is open then stays ``undecided``.
Human traces are judged as they are.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import pandas as pd

from analysis.load import SPECS, load_each
from merge_runner.config import CollisionRule, Scenario
from merge_runner.simulator.collision import collided
from merge_runner.simulator.conditions import CONDITIONS
from merge_runner.simulator.world import World

RULES: tuple[CollisionRule, ...] = get_args(CollisionRule)
UNDECIDED = "undecided"
PLANS = (
    "SELECT trial_id, spec_hash, side, list(applied ORDER BY decision) AS applied, "
    "arg_max(coalesce(plan, []), decision) AS last_plan FROM decisions "
    "GROUP BY ALL ORDER BY ALL"
)
# No rule sees a collision where the vehicles are 5 m apart along the track.
HUMAN_TRACES = """
SELECT trial_id, spec_hash,
    coalesce(list((left_m, right_m) ORDER BY step) FILTER (abs(left_m - right_m) < 5), []) AS close
FROM vehicle_pairs JOIN trials USING (trial_id, spec_hash) WHERE source = 'human'
GROUP BY ALL ORDER BY ALL
"""


def outcomes(db: Path, trials: pd.DataFrame) -> pd.DataFrame:
    """One row a trial that ended and a rule: trial_id, spec_hash, rule, status, merged_first.

    ``status`` is finished, collided, timeout or undecided.
    """
    ended = trials[trials["status"] != "failed"]
    humans = bool((ended["source"] == "human").any())
    found = load_each(
        {"specs": SPECS, "plans": PLANS} | ({"traces": HUMAN_TRACES} if humans else {}), db
    )
    specs = found["specs"].set_index("spec_hash")["spec"]
    frames = [_driven(ended[ended["source"] != "human"], found["plans"], specs)]
    if humans:
        frames.append(_judged(ended, found["traces"]))
    return pd.concat(frames, ignore_index=True)


def redrive(
    scenario: Scenario,
    condition: str,
    applied: Sequence[Sequence[Sequence[float]]],
    last_plans: Sequence[Sequence[float]],
) -> tuple[str, str | None]:
    """Drive a trial's plans again: (status, merged_first).

    ``applied`` holds, for left and right, the normalised actions of each decision; a vehicle that
    decided later than the other cruised before. ``last_plans`` are whole plans, empty if unknown.
    """
    world = World(scenario, CONDITIONS[condition])
    actions = [[action for actions in side for action in actions] for side in applied]
    steps = max(map(len, actions))
    queues: list[list[float | None]] = []
    for side, last, own in zip(applied, last_plans, actions, strict=True):
        rest = last[len(side[-1]) :] if side else []
        queues.append([*[None] * (steps - len(own)), *own, *rest])
    for left, right in zip(*queues, strict=False):
        if world.status is not None:
            break
        world.advance({"left": left, "right": right})
    return world.status or UNDECIDED, world.merged_first() if world.status else None


def _driven(trials: pd.DataFrame, plans: pd.DataFrame, specs: pd.Series) -> pd.DataFrame:
    by_trial: dict[tuple[str, str], dict[str, Any]] = {}
    for row in plans.itertuples():
        by_trial.setdefault((row.trial_id, row.spec_hash), {})[row.side] = row
    scenarios = {
        (spec_hash, rule): Scenario.model_validate(
            json.loads(specs[spec_hash])["scenario"] | {"collision_rule": rule}
        )
        for spec_hash in trials["spec_hash"].unique()
        for rule in RULES
    }
    rows = []
    for trial in trials.itertuples():
        sides = by_trial.get((trial.trial_id, trial.spec_hash), {})
        drivers = [sides[side] for side in ("left", "right") if side in sides]
        for rule in RULES:
            scenario = scenarios[trial.spec_hash, rule]
            if len(drivers) == 2:
                outcome = redrive(
                    scenario,
                    trial.condition,
                    [driver.applied for driver in drivers],
                    [driver.last_plan for driver in drivers],
                )
            else:  # it ended before both drivers had decided anything
                outcome = UNDECIDED, None
            rows.append((trial.trial_id, trial.spec_hash, rule, *outcome))
    return _frame(rows)


def _judged(trials: pd.DataFrame, traces: pd.DataFrame) -> pd.DataFrame:
    scenarios = {rule: Scenario(collision_rule=rule) for rule in RULES}
    stored = trials.set_index(["trial_id", "spec_hash"])
    rows = []
    for trace in traces.itertuples():
        if (trace.trial_id, trace.spec_hash) not in stored.index:
            continue
        trial = stored.loc[(trace.trial_id, trace.spec_hash)]
        for rule, scenario in scenarios.items():
            if any(collided(scenario, left, right) for left, right in trace.close):
                outcome = "collided", None
            elif trial["status"] == "collided":
                outcome = UNDECIDED, None
            else:
                outcome = trial["status"], trial["merged_first"]
            rows.append((trace.trial_id, trace.spec_hash, rule, *outcome))
    return _frame(rows)


def _frame(rows: Sequence[tuple[str, str, str, str, str | None]]) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=["trial_id", "spec_hash", "rule", "status", "merged_first"])
