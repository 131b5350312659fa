"""What the trials would have come to under the other readings of "collision".

Up to a trial's end the rule changes nothing but the end, so the stored traces are judged again.
Where a trial of drivers ended in a collision that another rule does not see, its stored plans are
driven again, and the last ones go on as far as they reach; what is open then stays ``undecided``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby, pairwise
from math import ceil, hypot, isclose
from pathlib import Path
from typing import Any, NamedTuple, get_args

import pandas as pd

from analysis.data.load import load_each, load_specs
from merge_runner.config import CollisionRule, ScenarioConfig
from merge_runner.drivers.pace import pace_of
from merge_runner.records import Side, other_side
from merge_runner.scenarios.merge.collision import collided, rectangles_overlap
from merge_runner.scenarios.merge.conditions import Condition
from merge_runner.scenarios.merge.geometry import TRACK, Track, track_of
from merge_runner.scenarios.merge.vehicle import advance
from merge_runner.scenarios.merge.world import World
from merge_runner.text_safety import quoted

# The readings of the paper's rule, looked for at every step of the simulation.
RULES: tuple[CollisionRule, ...] = get_args(CollisionRule)
# The rule of the human experiment: boxes that overlap, looked for so often.
LOOKS_HZ = 20
BOXES = f"rectangle at {LOOKS_HZ} Hz"
READINGS = (*RULES, BOXES)
UNDECIDED = "undecided"
# Samples at or next to which a rule can see a collision: with centres closer in the plane than the
# diagonal of a box and the way that they can come nearer within a step.
NEAR = """
SELECT trial_id, spec_hash,
    list((step, time_s, left_m, left_mps, right_m, right_mps) ORDER BY step) AS near
FROM (
    SELECT *, left_m - merge_m AS left_past_m, right_m - merge_m AS right_past_m,
        sine * (least(left_past_m, 0) + least(right_past_m, 0)) AS across_m,
        if(left_past_m < 0, cosine * left_past_m, left_past_m)
            - if(right_past_m < 0, cosine * right_past_m, right_past_m) AS along_m,
        {step_s} * (abs(left_mps - right_mps) + sine * (left_mps + right_mps)) AS nearer_m
    FROM vehicle_pairs JOIN (VALUES {tracks}) AS tracks (spec_hash, merge_m, sine, cosine)
        USING (spec_hash)
) WHERE across_m ** 2 + along_m ** 2 < ({reach_m} + nearer_m) ** 2 GROUP BY ALL
"""
# Trials in which both drivers decided something; the others ended before that.
DECIDED = """
SELECT trial_id, spec_hash FROM decisions GROUP BY ALL HAVING count(DISTINCT side) = 2
"""
PLANS = (
    "SELECT trial_id, spec_hash, side, list(applied ORDER BY decision) AS applied, "
    "min(time_s) AS since_s, "
    "arg_max(coalesce(plan, []), decision) AS last_plan FROM decisions "
    "SEMI JOIN (FROM trials WHERE status = 'collided') USING (trial_id, spec_hash) "
    "GROUP BY ALL ORDER BY ALL"
)
# The mean speed in m/s at the start of those trials, which their condition had.
MEAN_SPEEDS = (
    "SELECT trial_id, spec_hash, avg(velocity_mps) AS mean_mps FROM states "
    "SEMI JOIN (FROM trials WHERE status = 'collided' AND source <> 'human') "
    "USING (trial_id, spec_hash) WHERE step = 0 GROUP BY ALL"
)
Outcome = tuple[str, str | None]


class Task(NamedTuple):
    """What a trial is driven by and judged by."""

    config: ScenarioConfig
    track: Track


class Sample(NamedTuple):
    """Both vehicles at one time: travelled distances in m, speeds in m/s."""

    step: int
    time_s: float
    left_m: float
    left_mps: float
    right_m: float
    right_mps: float


def judged(db: Path, trials: pd.DataFrame) -> pd.DataFrame:
    """The trials with whether they collided, by two rules; NA where that stays undecided.

    ``collided``: by the rule of their scenario, looked for at its steps; of humans by the paper's.
    ``collided_boxes``: by the rule of the human experiment.
    """
    found = outcomes(db, trials, ["euclid2d", BOXES])
    recorded = trials["status"].eq("collided").astype("boolean")
    return trials.assign(
        collided=recorded.mask(trials["status"] == "failed").mask(
            trials["source"] == "human", _collided(trials, found, "euclid2d")
        ),
        collided_boxes=_collided(trials, found, BOXES),
    )


def _collided(trials: pd.DataFrame, found: pd.DataFrame, reading: str) -> pd.Series:
    known = found[(found["rule"] == reading) & (found["status"] != UNDECIDED)]
    known = known.set_index(["trial_id", "spec_hash"])["status"]
    keys = pd.MultiIndex.from_frame(trials[["trial_id", "spec_hash"]])
    values = known.eq("collided").astype("boolean").reindex(keys)
    return values.set_axis(trials.index)


def outcomes(db: Path, trials: pd.DataFrame, readings: Sequence[str] = READINGS) -> pd.DataFrame:
    """One row a trial that ended and a reading: trial_id, spec_hash, rule, status, merged_first.

    ``status`` is finished, collided, timeout or undecided. ``trials`` are rows of ``load_trials``,
    and a mirrored one is driven on as it is there.
    """
    ended = trials[trials["status"] != "failed"]
    stored = load_specs(db)
    specs = {name: stored.get(name, {}) for name in ended["spec_hash"].unique()}
    tasks = _tasks(specs)
    found = load_each(
        {"plans": PLANS, "near": _near(tasks), "decided": DECIDED, "speeds": MEAN_SPEEDS}, db
    )
    near = {
        (row.trial_id, row.spec_hash): [Sample(*sample) for sample in row.near]
        for row in found["near"].itertuples()
    }
    decided = set(found["decided"].itertuples(index=False, name=None))
    plans: dict[tuple[str, str], dict[str, Any]] = {}
    for row in found["plans"].itertuples():
        plans.setdefault((row.trial_id, row.spec_hash), {})[row.side] = row
    speeds = {(row.trial_id, row.spec_hash): row.mean_mps for row in found["speeds"].itertuples()}

    def judged_by(trial: Any, reading: str) -> Outcome:  # noqa: ANN401 # a row of pandas
        key = (trial.trial_id, trial.spec_hash)
        task, boxes = tasks[trial.spec_hash, reading], reading == BOXES
        if boxes and trial.source == "human":
            return trial.status, trial.merged_first  # it is the rule of the experiment
        # A trial that ended before both drivers had decided holds nothing to judge by.
        if trial.source != "human" and key not in decided:
            return UNDECIDED, None
        if seen(task, near.get(key, ()), between=boxes):
            return "collided", None
        if trial.status != "collided":  # no other end than a collision depends on the rule
            return trial.status, trial.merged_first
        if key not in speeds:  # humans have no plans that could be driven further
            return UNDECIDED, None
        start = Condition(trial.projected_headway_m, trial.relative_velocity_mps, speeds[key])
        sides = (trial.ego, other_side(trial.ego))
        return _driven_further(
            task, start, specs[trial.spec_hash], plans[key], sides, between=boxes
        )

    columns = ["trial_id", "spec_hash", "source", "status", "merged_first"]
    columns += ["projected_headway_m", "relative_velocity_mps", "ego"]
    rows = [
        (trial.trial_id, trial.spec_hash, reading, *judged_by(trial, reading))
        for trial in ended[columns].itertuples(index=False)
        for reading in readings
    ]
    return pd.DataFrame(rows, columns=["trial_id", "spec_hash", "rule", "status", "merged_first"])


def _driven_further(
    task: Task,
    start: Condition,
    spec: dict[str, Any],
    plans: dict[str, Any],
    order: Sequence[Side],
    *,
    between: bool,
) -> Outcome:
    """How a trial that collided goes on by its plans, under a task with another rule.

    ``order`` says whose plans drive on the left of the condition, and whose on the right.
    """
    sides = [plans[side] for side in order]
    lasting = [pace_of(task.config, spec.get(side, {})).action_steps for side in order]
    return redrive(
        task,
        start,
        [
            [_in_steps(actions, n) for actions in side.applied]
            for side, n in zip(sides, lasting, strict=True)
        ],
        [_in_steps(side.last_plan, n) for side, n in zip(sides, lasting, strict=True)],
        begins=[round(side.since_s / task.config.step_s) for side in sides],
        between=between,
    )


def _near(tasks: Mapping[tuple[str, str], Task]) -> str:
    """The query of the samples at or next to which vehicles can collide."""
    every = [ScenarioConfig(), *(task.config for task in tasks.values())]
    tracks = {spec_hash: task.track for (spec_hash, _), task in tasks.items()} or {"": TRACK}
    step_s = max(one.step_s for one in every)
    # What accelerations against each other, and a resistance, add to the way within a step.
    added_m = 2 * (max(one.max_acceleration_mps2 for one in every) + 2) * step_s**2
    reach_m = max(hypot(one.vehicle_length_m, one.vehicle_width_m) for one in every)
    return NEAR.format(
        tracks=", ".join(
            f"({quoted(spec_hash)}, {t.merge_point_m!r}::DOUBLE, {t.branch_sine!r}::DOUBLE, "
            f"{t.branch_cosine!r}::DOUBLE)"
            for spec_hash, t in tracks.items()
        ),
        step_s=step_s,
        reach_m=reach_m + added_m + 0.01,
    )


def seen(task: Task, samples: Sequence[Sample], *, between: bool) -> bool:
    """Whether a collision is seen at the scenario's steps, and ``between`` them at 20 Hz."""
    config, track = task
    if any(
        collided(config, track, sample.left_m, sample.right_m)
        for sample in samples
        if _is_multiple(sample.time_s, config.step_s)
    ):
        return True
    return between and any(
        rectangles_overlap(track, left_m, right_m, config.vehicle_length_m, config.vehicle_width_m)
        for before, now in pairwise(samples)
        if now.step == before.step + 1
        for left_m, right_m in _looks_between(before, now)
    )


def _looks_between(before: Sample, now: Sample) -> Iterator[tuple[float, float]]:
    """Both positions at the looks within a step, where accelerations are constant."""
    step_s = now.time_s - before.time_s
    looks = ceil(step_s * LOOKS_HZ - 1e-6)
    left = _acceleration(before.left_m, before.left_mps, now.left_m, now.left_mps, step_s)
    right = _acceleration(before.right_m, before.right_mps, now.right_m, now.right_mps, step_s)
    for look in range(1, looks):
        passed_s = step_s * look / looks
        yield (
            advance(before.left_m, before.left_mps, left, passed_s)[0],
            advance(before.right_m, before.right_mps, right, passed_s)[0],
        )


def _acceleration(
    before_m: float, before_mps: float, now_m: float, now_mps: float, step_s: float
) -> float:
    """The constant acceleration within a step, in m/s^2, also where it stopped the vehicle."""
    if now_mps > 0 or now_m <= before_m:
        return (now_mps - before_mps) / step_s
    return before_mps**2 / (-2 * (now_m - before_m))


def _is_multiple(time_s: float, step_s: float) -> bool:
    return isclose(time_s / step_s, round(time_s / step_s), abs_tol=1e-6)


def _tasks(specs: Mapping[str, Mapping[str, Any]]) -> dict[tuple[str, str], Task]:
    """The task of each spec under each reading; that of humans is the default one."""
    return {
        (spec_hash, reading): Task(
            ScenarioConfig.model_validate(
                spec.get("scenario", {})
                | {"collision_rule": "rectangle" if reading == BOXES else reading}
            ),
            track_of(spec),
        )
        for spec_hash, spec in specs.items()
        for reading in READINGS
    }


def _in_steps(actions: Iterable[float], lasting: int) -> list[float]:
    """Actions that each last so many steps of the world, step by step."""
    return [action for action in actions for _ in range(lasting)]


def redrive(
    task: Task,
    condition: Condition,
    applied: Sequence[Sequence[Sequence[float]]],
    last_plans: Sequence[Sequence[float]],
    *,
    begins: Sequence[int] = (0, 0),
    between: bool = False,
) -> Outcome:
    """Drive a trial's plans again: (status, merged_first).

    ``between``: collisions are looked for at 20 Hz between the steps too.
    ``applied`` holds, for left and right, the normalised actions of each decision, one a step of
    the world; until the step at which it ``begins`` a vehicle cruises. ``last_plans`` are whole
    plans, empty if unknown.
    """
    world = World(task.config, condition, task.track)
    queues: list[list[float | None]] = []
    for begin, side, last in zip(begins, applied, last_plans, strict=True):
        rest = last[len(side[-1]) :] if side else []
        queues.append([*[None] * begin, *(action for own in side for action in own), *rest])
    for left, right in zip(*queues, strict=False):
        if world.status is not None:
            break
        world.advance({"left": left, "right": right})
    if between and seen(task, _samples(world), between=True):
        return "collided", None
    return world.status or UNDECIDED, world.merged_first() if world.status else None


def _samples(world: World) -> list[Sample]:
    found = []
    for _, rows in groupby(world.states(), key=lambda row: row.step):
        left, right = rows
        found.append(
            Sample(
                left.step,
                left.time_s,
                left.position_m,
                left.velocity_mps,
                right.position_m,
                right.velocity_mps,
            )
        )
    return found
