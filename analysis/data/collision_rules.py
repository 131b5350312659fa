"""Whether trials collided, by the rule that ended them and by that of the human experiment.

A trial is judged by its stored trace. Where it ended in a collision that the other rule does not
see, nobody knows what would have followed: it is undecided by that rule.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, pairwise
from math import ceil, hypot, isclose
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from merge_runner.config import ScenarioConfig
from merge_runner.scenarios.merge.collision import collided, rectangles_overlap
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.vehicle import advance
from merge_runner.text_safety import quoted
from merge_runner_analysis.data.load import load_each, load_specs

# The rule of the human experiment is boxes that overlap, looked for so often.
LOOKS_HZ = 20
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
    FROM (SELECT *, merge_point_m() AS merge_m, branch_sine() AS sine, sqrt(1 - sine ** 2) AS cosine
        FROM vehicle_pairs WHERE spec_hash IN ({specs}))
) WHERE across_m ** 2 + along_m ** 2 < ({reach_m} + nearer_m) ** 2 GROUP BY ALL
"""


class Sample(NamedTuple):
    """Both vehicles at one time: travelled distances in m, speeds in m/s."""

    step: int
    time_s: float
    left_m: float
    left_mps: float
    right_m: float
    right_mps: float


def judged(db: Path, trials: pd.DataFrame) -> pd.DataFrame:
    """The trials with whether they collided, by two rules; NA where that is undecided.

    ``collided``: by the rule of their scenario, looked for at its steps; of humans by the paper's.
    ``collided_boxes``: by the rule of the human experiment. ``trials`` are rows of ``load_trials``.
    """
    ended = trials["status"] != "failed"
    recorded = trials["status"].eq("collided").astype("boolean")
    human = trials["source"] == "human"
    specs = load_specs(db)
    tasks = {name: _task(specs.get(name, {})) for name in trials.loc[ended, "spec_hash"].unique()}
    near = {
        (row.trial_id, row.spec_hash): [Sample(*sample) for sample in row.near]
        for row in load_each({"near": _near(tasks)}, db)["near"].itertuples()
    }
    keys = [*trials[["trial_id", "spec_hash"]].itertuples(index=False, name=None)]
    found = pd.Series(
        [
            key in near and seen(tasks[key[1]], near[key], boxes=not of_humans)
            for key, of_humans in zip(keys, human, strict=True)
        ],
        index=trials.index,
        dtype="boolean",
    )
    # What a trace does not show of a trial that another rule ended is open.
    by_other = found.mask(recorded & ~found)
    return trials.assign(
        collided=recorded.mask(human, by_other).where(ended),
        collided_boxes=by_other.mask(human, recorded).where(ended),
    )


def _near(tasks: Mapping[str, ScenarioConfig]) -> str:
    """The query of the samples at or next to which vehicles can collide."""
    every = [ScenarioConfig(), *tasks.values()]
    step_s = max(one.step_s for one in every)
    # What accelerations against each other, and a resistance, add to the way within a step.
    added_m = 2 * (max(one.max_acceleration_mps2 for one in every) + 2) * step_s**2
    reach_m = max(hypot(one.vehicle_length_m, one.vehicle_width_m) for one in every)
    return NEAR.format(
        specs=", ".join(map(quoted, tasks)) or "NULL",
        step_s=step_s,
        reach_m=reach_m + added_m + 0.01,
    )


def seen(config: ScenarioConfig, samples: Sequence[Sample], *, boxes: bool) -> bool:
    """Whether a collision is seen: of ``boxes`` at 20 Hz, else by the paper's rule at the steps."""
    size = (config.vehicle_length_m, config.vehicle_width_m)
    looks = (
        (sample.left_m, sample.right_m)
        for sample in samples
        if _is_multiple(sample.time_s, config.step_s)
    )
    if not boxes:
        return any(collided(config, TRACK, *look) for look in looks)
    between = (
        look
        for before, now in pairwise(samples)
        if now.step == before.step + 1
        for look in _looks_between(before, now)
    )
    return any(rectangles_overlap(TRACK, *look, *size) for look in chain(looks, between))


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


def _task(spec: Mapping[str, Any]) -> ScenarioConfig:
    """Return the scenario of a spec with the paper's rule; that of humans is the default one."""
    scenario = {**spec.get("scenario", {}), "collision_rule": "euclid2d"}
    return ScenarioConfig.model_validate(scenario)
