"""Databases for the analysis: trials driven by constant actions, written as any sweep's are."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from merge_runner.config import Scenario
from merge_runner.records import (
    SIDES,
    Decision,
    DecisionRow,
    TrialRecord,
    TrialSpec,
)
from merge_runner.simulator.conditions import CONDITIONS
from merge_runner.simulator.world import World
from merge_runner.store import Store, SweepRow

SCENARIO = Scenario()


@dataclass(frozen=True)
class Drive:
    """One trial: its cell, and the normalised action of either driver in every second."""

    driver: str
    variant: str
    condition: str
    rep: int
    left: tuple[float, ...]
    right: tuple[float, ...]


def played(drive: Drive, scenario: Scenario = SCENARIO) -> TrialRecord:
    """Play a trial; after the last given second the drivers keep their speed."""
    world = World(scenario, CONDITIONS[drive.condition])
    decisions = []
    number = 0
    while world.status is None:
        plans = {
            side: tuple(
                actions[number + later] if number + later < len(actions) else 0.0
                for later in range(4)
                for _ in range(5)
            )
            for side, actions in (("left", drive.left), ("right", drive.right))
        }
        decisions += [
            DecisionRow(number, world.time_s, side, Decision(plans[side], plans[side][:5]))
            for side in SIDES
        ]
        for index in range(5):
            if world.status is None:
                world.advance({side: plans[side][index] for side in SIDES})
        number += 1
    return TrialRecord(
        spec=TrialSpec(
            trial_id=f"{drive.driver}/{drive.variant}/{drive.condition}/rep{drive.rep:02d}",
            spec_hash=f"{drive.driver}-{drive.variant}",
            source="llm",
            model_left=drive.driver,
            model_right=drive.driver,
            variant=drive.variant,
            condition=drive.condition,
            repetition=drive.rep,
            sample_set=0,
            order=0,
        ),
        status=world.status,
        merged_first=world.merged_first(),
        end_time_s=world.time_s,
        error=None,
        states=world.states(),
        decisions=tuple(decisions),
    )


def write_study(path: Path, drives: Iterable[Drive], scenario: Scenario = SCENARIO) -> Path:
    """Write the trials of a sweep into a new database."""
    records = [played(drive, scenario) for drive in drives]
    store = Store(path)
    specs = {
        record.spec.spec_hash: json.dumps({"scenario": scenario.model_dump()}) for record in records
    }
    sweep = SweepRow(
        "sweep-1",
        "test",
        datetime(2026, 11, 21, tzinfo=UTC).replace(tzinfo=None),
        "{}",
        None,
        None,
        "{}",
    )
    store.begin_sweep(sweep, specs, [])
    store.write("sweep-1", records, patience_s=5)
    return path


def yielding(driver: str, variant: str = "baseline", reps: int = 3) -> list[Drive]:
    """A driver like the humans: who is ahead, or slower where level, goes first."""
    drives = []
    for condition in CONDITIONS.values():
        ahead = condition.projected_headway_m - 2 * condition.relative_velocity_mps
        for rep in range(1, reps + 1):
            # One repetition in five, and every second where nobody is ahead, is decided otherwise.
            left = ahead > 0 or (ahead == 0 and rep % 2 == 0)
            if rep % 5 == 0:
                left = not left
            strength = 0.30 + 0.04 * rep + 0.02 * abs(condition.projected_headway_m)
            faster, slower = (strength,) * 3, (-strength,) * 3
            drives.append(
                Drive(
                    driver,
                    variant,
                    condition.name,
                    rep,
                    faster if left else slower,
                    slower if left else faster,
                )
            )
    return drives
