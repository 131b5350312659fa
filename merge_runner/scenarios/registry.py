"""The scenarios that a sweep can play."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, get_args

from merge_runner.config import USUAL_SCENARIO, CollisionRule, ScenarioConfig
from merge_runner.errors import UsageError
from merge_runner.registry import Registry
from merge_runner.scenarios.base import Scenario, World
from merge_runner.scenarios.merge import world as merge
from merge_runner.scenarios.merge.conditions import CONDITIONS, HUMAN_CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK

SCENARIOS = Registry[Scenario]("scenario")
SCENARIOS.register(
    USUAL_SCENARIO,
    Scenario(
        track=TRACK,
        conditions=tuple(HUMAN_CONDITIONS),
        collision_rules=get_args(CollisionRule),
        make_world=merge.World,
    ),
)


def task_of(config: ScenarioConfig) -> dict[str, Any]:
    """What a spec holds of the task: the knobs, and what is not the experiment's.

    The track, so that the measures of a database need no package that registered its scenario; and
    the hash of the source of a world from outside, so that one that is edited is another scenario.
    """
    scenario = SCENARIOS[config.name]
    return {
        "scenario": config.model_dump(),
        **({} if scenario.track == TRACK else {"track": asdict(scenario.track)}),
        **({} if scenario.source is None else {"world_source": scenario.source}),
    }


def new_world(config: ScenarioConfig, condition: str, starts: merge.Starts | None = None) -> World:
    """The world of a new trial, whose vehicles may start elsewhere than the condition says.

    Raises UsageError where the condition cannot be played.
    """
    scenario = SCENARIOS.require(config.name)
    world = scenario.make_world(config, CONDITIONS.require(condition), scenario.track)
    if starts is not None:
        if not isinstance(world, merge.World):
            raise UsageError(f"the vehicles of the scenario {config.name} start by its own rules")
        world.start_at(starts)
    return world
