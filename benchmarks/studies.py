"""Makes a database of a study of any size, to measure the analysis with.

``python -m benchmarks.studies STUDY.duckdb --trials 1100 --copies 10``: ten groups of equal size,
o3 with eight prompts, another driver and humans, in all conditions. The trials are driven by simple
controllers with noise, seeded: equal sizes give equal studies. Nothing of it is a result.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path

import duckdb
import numpy as np

from merge_runner.config import ScenarioConfig
from merge_runner.records import SIDES, Attempt, ChatReply, ChatRequest, Decision, Side, Slot, Usage
from merge_runner.results.store import Store
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS, Condition
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from merge_runner.trial_records import DecisionRow, FailedCall, StateRow, TrialRecord, TrialSpec
from merge_runner_analysis.humans.record import SPEC, SPEC_HASH
from merge_runner_analysis.published import PAIRS

SEED = 1
BATCH = 500
MODELS = (*(("o3", v) for v in ("baseline", *(f"A{i}" for i in range(1, 8)))), ("o1", "baseline"))
GROUPS = len(MODELS) + 1
SCENARIO = ScenarioConfig()
# Humans are recorded at 20 Hz.
HUMAN_SCENARIO = ScenarioConfig(step_s=0.05)
PROMPT = "You drive a car towards a merge point and see another one. " * 30
HORIZON, HELD = 20, 5
STARTED = datetime(2026, 11, 21, tzinfo=UTC).replace(tzinfo=None)


def main() -> None:
    """Write a study into a new file, or every trial of a study more often."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("study", type=Path, metavar="STUDY.duckdb")
    parser.add_argument("--trials", type=int, help="write so many, a multiple of 110")
    parser.add_argument("--copies", type=int, default=1, help="have every trial so many times")
    arguments = parser.parse_args()
    if arguments.trials is not None:
        if arguments.trials % (GROUPS * len(HUMAN_CONDITIONS)) or arguments.study.exists():
            parser.error("--trials is a multiple of 110, and STUDY a new file")
        write_study(arguments.study, arguments.trials)
    copy_trials(arguments.study, arguments.copies)


def copy_trials(path: Path, copies: int) -> None:
    """Have every trial so many times, under other names, as further repetitions."""
    with duckdb.connect(str(path)) as connection:
        connection.execute("CREATE TEMP TABLE numbers AS SELECT unnest(range(1, ?)) AS n", [copies])
        for table, also in (
            ("trials", ", rep + 1000 * n AS rep"),
            ("states", ""),
            ("decisions", ", call_key || '/' || n AS call_key"),
            ("calls", ", call_key || '/' || n AS call_key"),
            ("sweep_trials", ""),
        ):
            connection.execute(
                f"INSERT INTO {table} SELECT {table}.* "  # noqa: S608 # constants
                f"REPLACE (trial_id || '/' || n AS trial_id{also}) FROM {table}, numbers"
            )


def write_study(path: Path, trials: int) -> None:
    """Write so many trials, the same number in every group and condition."""
    reps = trials // (GROUPS * len(HUMAN_CONDITIONS))
    store = Store(path)
    scenario = {"scenario": SCENARIO.model_dump()}
    specs = {
        f"{driver}-{variant}": json.dumps(scenario | {"prompt_blocks": {"C0": variant}})
        for driver, variant in MODELS
    }
    config = json.dumps({"models": {"o3": {"id": "o3", "aliases": ["o3-2025-04-16"]}}})
    sweep = {"sweep_id": "sweep-1", "name": "made", "started_at": STARTED}
    store.begin_sweep({**sweep, "config": config, "versions": "{}"}, specs, [])
    rng = np.random.default_rng(SEED)
    played = (
        _played(rng, driver, variant, name, rep)
        for rep in range(1, reps + 1)
        for driver, variant in MODELS
        for name in HUMAN_CONDITIONS
    )
    while batch := list(islice(played, BATCH)):
        store.write("sweep-1", batch, patience_s=5)
    driven = (_human(rng, name, rep) for rep in range(1, reps + 1) for name in HUMAN_CONDITIONS)
    while batch := list(islice(driven, BATCH)):
        store.add_recorded(batch, {SPEC_HASH: SPEC})


def _goes(rng: np.random.Generator, condition: Condition) -> bool:
    """Draw whether the left goes first, as often as among the humans."""
    logit = condition.projected_headway_m - 3 * condition.relative_velocity_mps - 0.3
    return bool(rng.random() < 1 / (1 + np.exp(-logit)))


def _actions(
    rng: np.random.Generator, condition: Condition, noise: float, seconds: int = 30
) -> dict[str, list[float]]:
    """Normalised actions of both, one a step of 0.2 s: one gives way, then both even out."""
    left = _goes(rng, condition)
    strength = rng.normal(0.36, 0.09) + 0.02 * abs(condition.projected_headway_m)
    strength *= 0.15 if rng.random() < 0.1 else 1  # they hesitate, and some of them collide
    intervals = int(rng.integers(2, 5))
    actions = {}
    for side, first in (("left", left), ("right", not left)):
        signed = strength if first else -strength
        steps = np.repeat(
            [*(signed * rng.uniform(0.6, 1.2, intervals)), *([-0.3 * signed] * 2)], HELD
        )
        whole = np.zeros(seconds * HELD)
        whole[: len(steps)] = steps
        wobble = noise * rng.normal(size=len(whole)) * (rng.random() < 0.4)
        actions[side] = np.clip(whole + wobble, -1, 1).round(3).tolist()
    return actions


def _played(
    rng: np.random.Generator, driver: str, variant: str, name: str, rep: int
) -> TrialRecord:
    """One trial of a model; now and then a call fails, is retried, or gives no plan."""
    condition = HUMAN_CONDITIONS[name]
    world = World(SCENARIO, condition, TRACK)
    actions = _actions(rng, condition, 0.02 * MODELS.index((driver, variant)))
    spec = TrialSpec(
        f"{driver}/{variant}/{name}/rep{rep:02d}",
        *(f"{driver}-{variant}", "llm", driver, driver, variant, name, rep, 0, 0),
        kinematics=condition,
    )
    decisions: list[DecisionRow] = []
    lost: list[FailedCall] = []
    while world.status is None and not lost:
        start = world.step
        for side in SIDES:
            fate = rng.random()
            if fate < 0.0002:
                call = _reply(spec, side, start // HELD, ("timeout", "timeout"))
                lost.append(FailedCall(start // HELD, side, call.request, call.attempts))
                continue
            outcomes = ("rate_limit", "ok") if fate > 0.99 else ("ok",)
            plan = tuple((actions[side] + [0.0] * HORIZON)[start : start + HORIZON])
            decision = Decision(
                plan,
                plan[:HELD],
                "M" if plan[0] > 0 else "Y",
                f"I am at step {start}.",
                prompt=f"{PROMPT}Step {start}, rep {rep}, {side}, {name}.",
                reply=_reply(spec, side, start // HELD, outcomes),
            )
            if fate < 0.003:
                decision = replace(decision, plan=None, failure="wrong_length", fallback=True)
            decisions.append(DecisionRow(start // HELD, world.time_s, side, decision))
        for step in range(start, start + HELD):
            if world.status is None and not lost:
                world.drive([actions["left"][step]], [actions["right"][step]])
    return TrialRecord(
        spec,
        world.status or "failed",
        None if lost else world.merged_first(),
        world.time_s,
        "no answer after 2 attempts" if lost else None,
        world.states(),
        tuple(decisions),
        tuple(lost),
    )


def _reply(spec: TrialSpec, side: Side, number: int, outcomes: tuple[str, ...]) -> ChatReply:
    slot = Slot(spec.condition, spec.repetition, side, number, 0)
    key = f"{spec.trial_id}/{side}/{number}"
    body = json.dumps({"model": spec.model_left, "messages": [PROMPT], "key": key})
    request = ChatRequest(key, "openai", "openai", spec.model_left, "/chat", {}, body, slot)
    attempts = tuple(
        Attempt(
            index,
            outcome,
            http_status=200 if outcome == "ok" else None,
            model_served=spec.model_left if outcome == "ok" else None,
            usage=Usage(700, 0, 300, 200),
            latency_s=0.5,
            started_at=STARTED.isoformat(),
            reply=json.dumps({"text": "I give way. " * 60, "key": key}),
            cost_usd=0.004,
        )
        for index, outcome in enumerate(outcomes, 1)
    )
    return ChatReply("", outcomes[-1], request, attempts, cached_attempts=0)


def _human(rng: np.random.Generator, name: str, rep: int) -> TrialRecord:
    """One trial of a pair, at 20 Hz and without decisions."""
    condition = HUMAN_CONDITIONS[name]
    world = World(HUMAN_SCENARIO, condition, TRACK)
    actions = _actions(rng, condition, 0.05)
    pair = list(PAIRS.values())[rep % len(PAIRS)]
    while world.status is None:
        now = world.step // 4
        world.drive([actions["left"][now]], [actions["right"][now]])
    spec = TrialSpec(
        f"human/{pair}/{name}/iter{rep:03d}",
        *(SPEC_HASH, "human", "human", "human", None, name, rep, 0, 0),
        pair=pair,
        kinematics=condition,
    )
    states: tuple[StateRow, ...] = world.states()
    return TrialRecord(spec, world.status, world.merged_first(), world.time_s, None, states, ())


if __name__ == "__main__":
    main()
