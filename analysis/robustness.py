"""What the trials would have come to under the other readings of "collision".

Up to a trial's end the rule changes nothing but the end, so the stored traces are judged again.
Where a trial of drivers ended in a collision that another rule does not see, its stored plans are
driven again, and the last ones go on as far as they reach; what is open then stays ``undecided``.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from math import hypot
from pathlib import Path
from typing import Any, get_args

import pandas as pd

from analysis.load import SPECS, load_each
from merge_runner.config import CollisionRule, Scenario
from merge_runner.simulator.collision import collided
from merge_runner.simulator.conditions import CONDITIONS
from merge_runner.simulator.track import FORWARD, LATERAL, MERGE_POINT_M
from merge_runner.simulator.world import World

RULES: tuple[CollisionRule, ...] = get_args(CollisionRule)
UNDECIDED = "undecided"
# Samples with centres closer in the plane than a distance, from which on no rule sees a collision.
CLOSE = """
SELECT trial_id, spec_hash, list((left_m, right_m) ORDER BY step) AS close FROM (
    SELECT *, left_m - {merge} AS left_past_m, right_m - {merge} AS right_past_m,
        {lateral} * (least(left_past_m, 0) + least(right_past_m, 0)) AS across_m,
        if(left_past_m < 0, {forward} * left_past_m, left_past_m)
            - if(right_past_m < 0, {forward} * right_past_m, right_past_m) AS along_m
    FROM vehicle_pairs
) WHERE across_m ** 2 + along_m ** 2 < {reach_m} ** 2 GROUP BY ALL
"""
# Trials in which both drivers decided something; the others ended before that.
DECIDED = """
SELECT trial_id, spec_hash FROM decisions GROUP BY ALL HAVING count(DISTINCT side) = 2
"""
PLANS = (
    "SELECT trial_id, spec_hash, side, list(applied ORDER BY decision) AS applied, "
    "arg_max(coalesce(plan, []), decision) AS last_plan FROM decisions "
    "SEMI JOIN (FROM trials WHERE status = 'collided') USING (trial_id, spec_hash) "
    "GROUP BY ALL ORDER BY ALL"
)
Outcome = tuple[str, str | None]


def outcomes(db: Path, trials: pd.DataFrame) -> pd.DataFrame:
    """One row a trial that ended and a rule: trial_id, spec_hash, rule, status, merged_first.

    ``status`` is finished, collided, timeout or undecided.
    """
    ended = trials[trials["status"] != "failed"]
    specs = load_each({"specs": SPECS}, db)["specs"]
    scenarios = _scenarios(ended["spec_hash"].unique(), specs)
    found = load_each({"plans": PLANS, "close": _close(scenarios.values()), "decided": DECIDED}, db)
    close = {(row.trial_id, row.spec_hash): row.close for row in found["close"].itertuples()}
    decided = set(found["decided"].itertuples(index=False, name=None))
    plans: dict[tuple[str, str], dict[str, Any]] = {}
    for row in found["plans"].itertuples():
        plans.setdefault((row.trial_id, row.spec_hash), {})[row.side] = row
    rows = []
    columns = ["trial_id", "spec_hash", "source", "condition", "status", "merged_first"]
    for trial in ended[columns].itertuples(index=False):
        key = (trial.trial_id, trial.spec_hash)
        pairs = close.get(key, ())
        known = trial.source == "human" or key in decided
        for rule in RULES:
            scenario = scenarios[trial.spec_hash, rule]
            outcome: Outcome
            if not known:
                outcome = UNDECIDED, None
            elif any(collided(scenario, left, right) for left, right in pairs):
                outcome = "collided", None
            elif trial.status != "collided":
                outcome = trial.status, trial.merged_first
            elif trial.source == "human":
                outcome = UNDECIDED, None
            else:
                sides = [plans[key][side] for side in ("left", "right")]
                outcome = redrive(
                    scenario,
                    trial.condition,
                    [side.applied for side in sides],
                    [side.last_plan for side in sides],
                )
            rows.append((*key, rule, *outcome))
    return pd.DataFrame(rows, columns=["trial_id", "spec_hash", "rule", "status", "merged_first"])


def _close(scenarios: Iterable[Scenario]) -> str:
    """The samples at which boxes can touch, with a margin for rounding."""
    reach_m = max(
        (hypot(one.vehicle_length_m, one.vehicle_width_m) for one in scenarios), default=0.0
    )
    return CLOSE.format(
        merge=MERGE_POINT_M, lateral=LATERAL, forward=FORWARD, reach_m=reach_m + 0.01
    )


def _scenarios(
    spec_hashes: Iterable[str], specs: pd.DataFrame
) -> dict[tuple[str, CollisionRule], Scenario]:
    """The scenario of each spec under each rule; that of humans is the default one."""
    texts = dict(zip(specs["spec_hash"], specs["spec"], strict=True))
    found = {
        spec_hash: json.loads(texts.get(spec_hash, "{}")).get("scenario", {})
        for spec_hash in spec_hashes
    }
    return {
        (spec_hash, rule): Scenario.model_validate(scenario | {"collision_rule": rule})
        for spec_hash, scenario in found.items()
        for rule in RULES
    }


def redrive(
    scenario: Scenario,
    condition: str,
    applied: Sequence[Sequence[Sequence[float]]],
    last_plans: Sequence[Sequence[float]],
) -> Outcome:
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
