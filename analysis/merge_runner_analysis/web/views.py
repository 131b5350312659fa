"""Conditions, prompts and trials in words; one trial as it is read, and what its page draws."""

from __future__ import annotations

import json
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from duckdb import DuckDBPyConnection

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.pace import Pace, pace_of
from merge_runner.prompts.blocks import BLOCKS, Variant, title_of
from merge_runner.records import SIDES, Side
from merge_runner.results.database import by_name, names_of
from merge_runner.scenarios.merge.collision import collided
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner_analysis.web.collision_account import Account, Course, account
from merge_runner_analysis.web.display_text import visible
from merge_runner_analysis.web.reading import Row, records

UNKNOWN = "no meaning is known here"
# The part of the plane that a picture of the track shows: x, y, width, height in m.
_HALF_M = TRACK.start_distance_m / 2 + 4.5
VIEW_BOX = f"-3 {-_HALF_M:g} {TRACK.end_y_m + 8.8:.1f} {2 * _HALF_M:g}"
DRAWN = {"t": "time_s", "x": "position_m", "v": "velocity_mps", "a": "acceleration_mps2"}
ONE = "WHERE trial_id = $trial AND spec_hash = $spec"
STATES = f"""
SELECT side, list(time_s ORDER BY step) AS time_s,
    list(position_m ORDER BY step) AS position_m, list(velocity_mps ORDER BY step) AS velocity_mps,
    list(acceleration_mps2 ORDER BY step) AS acceleration_mps2
FROM states {ONE} GROUP BY ALL ORDER BY side
"""  # noqa: S608 # constants
DECISIONS = f"SELECT *, false AS lost FROM decisions {ONE}"  # noqa: S608 # constants
CALLS = f"SELECT * EXCLUDE request FROM calls {ONE} ORDER BY attempt"  # noqa: S608 # constants
PERCEIVED = f"FROM perceptions {ONE}"
TASKS = f"""
SELECT source, spec
FROM (FROM trials {ONE}) LEFT JOIN specs USING (spec_hash)
"""  # noqa: S608 # constants
# Recordings do not describe their task: collisions were judged by the outlines, at 20 Hz.
HUMAN_TASK = {"collision_rule": "rectangle", "step_s": 0.05}


def condition_text(headway: float, velocity: float) -> str:
    """A condition in words, from its projected headway in m and its relative velocity in m/s."""
    if headway == 0:
        ahead = "both would reach the merge point together"
    else:
        leader = "left" if headway > 0 else "right"
        ahead = f"the {leader} vehicle would be {abs(headway):g} m ahead at the merge point"
    if velocity == 0:
        return f"{ahead}, at equal speeds"
    compared = "faster" if velocity > 0 else "slower"
    return f"{ahead}, and the left one is {abs(velocity):g} m/s {compared}"


def ordered(names: Iterable[str]) -> list[str]:
    """Conditions in their usual order, those that no human drove last."""
    places = {name: place for place, name in enumerate(HUMAN_CONDITIONS)}
    return sorted(names, key=lambda name: (places.get(name, len(places)), name))


def changes_text(variant: Variant, shown: Callable[[str], str]) -> str:
    """What a variant's prompt leaves out and adds, each block as it is to be shown."""
    return " and ".join(
        f"{word} {', '.join(shown(name) for name in sorted(names))}"
        for word, names in (("without", variant.removes), ("with", variant.adds))
        if names
    )


def block_meaning(name: str) -> str:
    """What a block of a prompt is for."""
    block = BLOCKS.get(name)
    return UNKNOWN if block is None else block.meaning


def clock(time_s: float) -> str:
    """A time in seconds, to a tenth or, where that is not exact, a hundredth."""
    return f"{time_s:.1f}" if abs(time_s - round(time_s, 1)) < 1e-6 else f"{time_s:.2f}"


def outcome_text(row: Row) -> str:
    """How a trial ended, in a sentence."""
    end = f"{row['end_time_s']:.1f} s"
    without_first = {
        "collided": f"The vehicles collided after {end}.",
        "failed": f"The trial failed after {end}: {row['error']}.",
        "timeout": f"Nobody had left the track after {end}.",
    }
    first = row["merged_first"]
    if first is None:
        merged = f"The trial ended after {end}; no vehicle merged first."
        return without_first.get(row["status"], merged)
    other = "right" if first == "left" else "left"
    when = "" if row["time_to_merge_s"] is None else f", after {row['time_to_merge_s']:.1f} s"
    gap = "" if row["gap_m"] is None else f", with a gap of {row['gap_m']:.1f} m"
    return f"The {other} vehicle yielded: the {first} one reached the merge point first{when}{gap}."


def judged_text(scenario: ScenarioConfig) -> str:
    """What the picture draws of the rule by which the scenario judges a collision."""
    length = f"{scenario.vehicle_length_m:g} m"
    drawn = {
        "euclid2d": f"circles of {length}, a vehicle's length, about the centres",
        "shared_lane": f"bars of {length} along the road, once a vehicle is past the merge point",
        "rectangle": f"outlines of {length} by {scenario.vehicle_width_m:g} m",
    }[scenario.collision_rule]
    return f"{drawn}: it is a collision where they overlap"


def facts(row: Row) -> list[str]:
    """What a trial was about and what was measured, in short sentences."""
    condition = condition_text(row["projected_headway_m"], row["relative_velocity_mps"])
    programs = "no prompt, since only programs drive"
    prompt = programs if row["source"] == "driver" else f"the prompt {title_of(row['variant'])}"
    texts = (
        f"{row['condition']}: {condition}",
        row["variant"] and f"{row['variant']}: {prompt}",
        ", ".join(row["levels"] or ()),
        row["rmse_mps"] is not None and f"RMSE of the speed {row['rmse_mps']:.2f} m/s",
        row["asked"] and f"{row['invalid']} of {row['asked']} decisions invalid",
        row["cost_usd"] is not None and f"{row['cost_usd']:.3f} USD",
        row["caution"] and f"Note: {row['caution']}",
    )
    return [f"{text}." for text in texts if text]


@dataclass(frozen=True, slots=True)
class Trial:
    """A trial's samples by side, its decisions, and the task it is of.

    ``paces`` say when each driver decided. A decision is a row with the one ``before`` on its side,
    its ``attempts`` and the last ``reply``, what was ``perceived`` where that was imperfect,
    whether its call was ``lost`` and whether it was ``driven``.
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
        decisions = self.decisions
        return {
            side: mine for side in SIDES if (mine := [d for d in decisions if d["side"] == side])
        }

    def interval_s(self, side: Side) -> float:
        """How long a decision of a side is driven."""
        return self.paces[side].interval_steps * self.scenario.step_s


def read_trial(connection: DuckDBPyConnection, trial_id: str, spec_hash: str) -> Trial:
    """Read a trial that is known to be there."""
    key = {"trial": trial_id, "spec": spec_hash}
    states, calls, (task,) = (records(connection, sql, key) for sql in (STATES, CALLS, TASKS))
    result = connection.execute(DECISIONS, key)
    lost = dict.fromkeys(names_of(result)) | {"valid": False, "fallback": False, "lost": True}
    made = {(row["decision"], row["side"]): row for row in by_name(result)}
    for call in calls:
        place = call["decision"], call["side"]
        # Where it got no answer the trial ended, and what the other driver decided is never driven.
        row = made.setdefault(place, lost | dict(zip(("decision", "side"), place, strict=True)))
        row.setdefault("attempts", []).append(call)
    decisions = [made[place] for place in sorted(made)]
    is_told = any(row["other_seen"] is not None for row in decisions)
    perceived = {
        (row["decision"], row["side"]): row
        for row in (records(connection, PERCEIVED, key) if is_told else ())
    }
    told = json.loads(task["spec"] or "{}")
    scenario = scenario_of(task["source"], told.get("scenario"))
    trial = Trial(
        scenario,
        {side: pace_of(scenario, told.get(side, {})) for side in SIDES},
        {row["side"]: row for row in states},
        decisions,
    )
    before: dict[str, Row] = {}
    for row in decisions:
        row.setdefault("attempts", [])
        replies = [call["reply"] for call in row["attempts"] if call["reply"] is not None]
        row["reply"] = replies[-1] if replies else None
        row["perceived"] = perceived.get((row["decision"], row["side"]))
        if row["lost"]:
            row["time_s"] = trial.end_s
        row |= {"driven": row["time_s"] < trial.end_s, "before": before.get(row["side"])}
        before[row["side"]] = row
    return trial


def scenario_of(source: str, told: Mapping[str, Any] | None) -> ScenarioConfig:
    """The task of a trial, as its spec tells it, or as it usually is."""
    usual = HUMAN_TASK if source == "human" else {}
    return ScenarioConfig.model_validate(usual if told is None else told)


def summary(trial: Trial) -> list[str]:
    """What the charts of a trial show, in sentences."""
    lines = []
    for side, samples in trial.states.items():
        speeds = controlled(samples, "velocity_mps")
        # A sample's acceleration is that of the step before it.
        hardest = max(controlled(samples, "acceleration_mps2")[1:], key=abs, default=0.0)
        if speeds:
            lines.append(
                f"The {side} vehicle began at {speeds[0]:.1f} m/s, drove between "
                f"{min(speeds):.1f} and {max(speeds):.1f} m/s, and ended at {speeds[-1]:.1f} m/s; "
                f"its hardest acceleration was {hardest:+z.1f} m/s²."
            )
    return lines


def controlled(samples: Row, name: str) -> list[float]:
    """The samples of a vehicle from the start of control on; in the tunnels nobody controls it."""
    return [x for t, x in zip(samples["time_s"], samples[name], strict=True) if t >= 0]


def account_of(row: Row, trial: Trial) -> Account | None:
    """Why a trial went as it did; None where there is nothing to explain."""
    if row["account"] is None:
        return None
    times, places, speeds = (
        {side: controlled(samples, name) for side, samples in trial.states.items()}
        for name in ("time_s", "position_m", "velocity_mps")
    )
    course = Course(trial.scenario, TRACK, times["left"], places, speeds)
    return account(course, trial.decisions, row)


def replay_data(row: Row, trial: Trial, account: Account | None) -> dict[str, Any]:
    """What the replay draws: samples, the track, the bounds of a collision."""
    scenario = trial.scenario
    return {
        "spec": row["spec_hash"],
        "outcome": visible(outcome_text(row)),
        "label": visible(
            f"human {row['pair']}, {row['condition']}"
            if row["source"] == "human"
            else f"{row['model']}, {row['variant']}, {row['condition']}, rep {row['rep']}"
        ),
        "status": row["status"],
        "end": trial.end_s,
        "every": {side: trial.interval_s(side) for side in SIDES},
        "sides": {
            side: {short: [round(x, 3) for x in samples[name]] for short, name in DRAWN.items()}
            for side, samples in trial.states.items()
        },
        "bounds": collision_bounds(trial),
        "marks": marks(row, trial, account),
        "track": {
            "tunnel": TRACK.tunnel_exit_m,
            "merge": TRACK.merge_point_m,
            "end": TRACK.end_m,
            "lateral": TRACK.branch_sine,
            "forward": TRACK.branch_cosine,
            "length": scenario.vehicle_length_m,
            "width": scenario.vehicle_width_m,
            "rule": scenario.collision_rule,
            "hardest": scenario.max_acceleration_mps2,
        },
    }


def marks(row: Row, trial: Trial, account: Account | None) -> list[dict[str, Any]]:
    """The moments that matter, in order: merges, a collision, and those of the account."""
    found: list[tuple[float, str, str, str]] = [
        (reached_s, side, "merge", f"{side} merges")
        for side, samples in trial.states.items()
        if (reached_s := reaches_s(samples, TRACK.merge_point_m)) is not None
    ]
    if row["status"] == "collided":
        found.append((trial.end_s, "", "collision", "collision"))
    if account:
        found += [(mark.time_s, mark.side, mark.kind, mark.text) for mark in account.marks]
    return [
        {"t": round(time_s, 3), "side": side, "kind": kind, "text": text}
        for time_s, side, kind, text in sorted(found, key=lambda mark: mark[0])
    ]


def reaches_s(samples: Row, place_m: float) -> float | None:
    """When a vehicle is at a place, between two samples in proportion; None where it never is."""
    places, times = samples["position_m"], samples["time_s"]
    i = bisect_left(places, place_m)  # no vehicle drives backwards
    if i in {0, len(places)}:
        return float(times[0]) if i == 0 else None
    part = (place_m - places[i - 1]) / (places[i] - places[i - 1])
    return float(times[i - 1] + part * (times[i] - times[i - 1]))


def collision_bounds(trial: Trial) -> list[float | None]:
    """The headway below which the vehicles collide, for each sample; None where they cannot.

    To a millimetre, at their mean position: the further apart they are along the road, the less
    they overlap.
    """
    scenario, length_m = trial.scenario, trial.scenario.vehicle_length_m
    places = [samples["position_m"] for samples in trial.states.values()]
    pairs = list(zip(*places, strict=False)) if len(places) == len(SIDES) else []
    if scenario.collision_rule == "shared_lane":
        return [length_m if max(pair) >= TRACK.merge_point_m else None for pair in pairs]
    most_m = length_m + scenario.vehicle_width_m

    @cache
    def bound_m(mean_m: float) -> float | None:
        apart_mm = bisect_left(
            range(round(2000 * most_m)),
            True,
            key=lambda mm: not collided(scenario, TRACK, mean_m + mm / 2000, mean_m - mm / 2000),
        )
        return apart_mm / 1000 or None

    # Where the road is straight the bound stays the same.
    return [bound_m(min(sum(pair) / 2, TRACK.merge_point_m + most_m)) for pair in pairs]


def plan_chart(row: Row, trial: Trial) -> dict[str, Any] | None:
    """A plan as steps over its horizon, beside what the previous plan intended for that time.

    None where there is no plan.
    """
    pace, before = trial.paces[row["side"]], row["before"]
    applied = (row["applied"] or []) if row["driven"] else []
    old = (before["plan"] or [])[len(before["applied"]) :] if before else []
    if row["lost"] or not (row["plan"] or old or applied):
        return None
    return {
        "plan": row["plan"] or [],
        "before": old,
        "applied": applied,
        "step_s": pace.action_steps * trial.scenario.step_s,
        "most_mps2": trial.scenario.max_acceleration_mps2,
        "steps": pace.plan_actions,
    }
