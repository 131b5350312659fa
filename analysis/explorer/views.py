"""What the pages show of trials and decisions, as plain values for the templates."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from typing import Any

from merge_runner.config import ScenarioConfig
from merge_runner.prompts.blocks import BLOCKS, VARIANTS, Variant
from merge_runner.records import SIDES
from merge_runner.scenarios.merge.collision import collided
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner_analysis.accounts import Account, Course, account
from merge_runner_analysis.explorer.details import Trial
from merge_runner_analysis.explorer.display_text import visible
from merge_runner_analysis.explorer.reading import Row

# Vehicles touch up to some 13 m apart: halved so often, that is less than a millimetre.
BISECTIONS = 14
# What a picture shows of the plane around the track, in m.
BEFORE_M, BEYOND_M, BESIDE_M = 3.0, 5.8, 4.5
UNKNOWN = "no meaning is known here"
DRAWN = {"t": "time_s", "x": "position_m", "v": "velocity_mps", "a": "acceleration_mps2"}


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


def prompt_text(variant: str | None) -> str:
    """A prompt variant in words."""
    if variant is None:
        return ""
    known = VARIANTS.get(variant)
    if known is None:
        return f"a prompt of which {UNKNOWN}"
    changes = changes_text(known, str)
    return f"the prompt {changes}" if changes else "the whole prompt"


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


def outcome_text(row: Row, scenario: ScenarioConfig) -> str:
    """How a trial ended, in a sentence."""
    end = f"{row['end_time_s']:.1f} s"
    if row["status"] == "collided":
        return f"The vehicles collided after {end}: {collision_text(scenario)}."
    if row["status"] == "failed":
        return f"The trial failed after {end}: {row['error']}."
    if row["status"] == "timeout":
        return f"Nobody had left the track after {end}."
    first = row["merged_first"]
    if first is None:
        return f"The trial ended after {end}; no vehicle merged first."
    other = "right" if first == "left" else "left"
    when = "" if row["time_to_merge_s"] is None else f", after {row['time_to_merge_s']:.1f} s"
    gap = "" if row["gap_m"] is None else f", with a gap of {row['gap_m']:.1f} m"
    return f"The {other} vehicle yielded: the {first} one reached the merge point first{when}{gap}."


def collision_text(scenario: ScenarioConfig) -> str:
    """What counts as a collision in the scenario."""
    length = f"{scenario.vehicle_length_m:g} m"
    return {
        "euclid2d": f"their centres came closer than {length}, a vehicle's length",
        "shared_lane": f"past the merge point one was less than {length} behind the other",
        "rectangle": "their outlines overlapped",
    }[scenario.collision_rule]


def judged_text(scenario: ScenarioConfig) -> str:
    """What the picture draws of the rule by which the scenario judges a collision."""
    length = f"{scenario.vehicle_length_m:g} m"
    return {
        "euclid2d": f"circles of {length}, a vehicle's length, about the centres: "
        "it is a collision where they overlap",
        "shared_lane": f"bars of {length} along the road: it is a collision where they overlap, "
        "once a vehicle is past the merge point",
        "rectangle": f"outlines of {length} by {scenario.vehicle_width_m:g} m: "
        "it is a collision where they overlap",
    }[scenario.collision_rule]


def view_box() -> str:
    """Return the part of the plane that a picture of the track shows: x, y, width, height in m."""
    half = TRACK.start_distance_m / 2 + BESIDE_M
    width = TRACK.end_y_m + BEFORE_M + BEYOND_M
    return f"{-BEFORE_M:g} {-half:g} {width:.1f} {2 * half:g}"


def facts(row: Row) -> list[str]:
    """What a trial was about and what was measured, in short sentences."""
    text = condition_text(row["projected_headway_m"], row["relative_velocity_mps"])
    found = [f"{row['condition']}: {text}."]
    if row["variant"] is not None:
        programs = row["source"] == "driver"
        said = "no prompt, since only programs drive" if programs else prompt_text(row["variant"])
        found.append(f"{row['variant']}: {said}.")
    if row["levels"]:
        found.append(f"{', '.join(row['levels'])}.")
    if row["rmse_mps"] is not None:
        found.append(f"RMSE of the speed {row['rmse_mps']:.2f} m/s.")
    if row["decisions"]:
        found.append(f"{row['invalid']} of {row['decisions']} decisions invalid.")
    if row["cost_usd"] is not None:
        found.append(f"{row['cost_usd']:.3f} USD.")
    if row["caution"]:
        found.append(f"Note: {row['caution']}.")
    return found


def summary(row: Row, trial: Trial) -> list[str]:
    """What the charts of a trial show, in sentences."""
    lines = []
    for side, samples in trial.states.items():
        speeds = controlled(samples, "velocity_mps")
        if speeds:
            lines.append(
                f"The {side} vehicle began at {speeds[0]:.1f} m/s, drove between "
                f"{min(speeds):.1f} and {max(speeds):.1f} m/s, and ended at {speeds[-1]:.1f} m/s"
                f"{_hardest(samples)}."
            )
    for side, mine in trial.by_side.items():
        words = [d["tactical"] for d in mine]
        letters = " ".join(word or "–" for word in words)
        said = letters if any(words) else f"{len(words)}, none in words"
        bad = [str(d["decision"]) for d in mine if not d["valid"] and not d["lost"]]
        lost = [str(d["decision"]) for d in mine if not d["driven"]]
        lines.append(
            f"Decisions of the {side} driver: {said}"
            + (f"; without a valid plan: {', '.join(bad)}" if bad else "")
            + (f"; the trial ended before {', '.join(lost)} was driven." if lost else ".")
        )
    return lines


def _hardest(samples: Row) -> str:
    """The hardest acceleration under control: a sample's is that of the step before it."""
    accelerations = controlled(samples, "acceleration_mps2")[1:]
    if not accelerations:
        return ""
    return f"; its hardest acceleration was {max(accelerations, key=abs):+z.1f} m/s²"


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
    return {
        "spec": row["spec_hash"],
        "outcome": visible(outcome_text(row, trial.scenario)),
        "label": label(row),
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
            "length": trial.scenario.vehicle_length_m,
            "width": trial.scenario.vehicle_width_m,
            "rule": trial.scenario.collision_rule,
            "hardest": trial.scenario.max_acceleration_mps2,
        },
    }


def marks(row: Row, trial: Trial, account: Account | None) -> list[dict[str, Any]]:
    """The moments that matter, in order: merges, a collision, and those of the account."""
    found = [
        {"t": round(reached_s, 3), "side": side, "kind": "merge", "text": f"{side} merges"}
        for side, samples in trial.states.items()
        if (reached_s := reaches_s(samples, TRACK.merge_point_m)) is not None
    ]
    if row["status"] == "collided":
        found.append({"t": round(trial.end_s, 3), "side": "", "kind": "collision",
                      "text": "collision"})  # fmt: skip
    if account:
        found += [
            {"t": round(mark.time_s, 3), "side": mark.side, "kind": mark.kind, "text": mark.text}
            for mark in account.marks
        ]
    return sorted(found, key=lambda mark: mark["t"])


def reaches_s(samples: Row, place_m: float) -> float | None:
    """When a vehicle is at a place, between two samples in proportion; None where it never is."""
    places, times = samples["position_m"], samples["time_s"]
    i = bisect_left(places, place_m)  # no vehicle drives backwards
    if i in {0, len(places)}:
        return float(times[0]) if i == 0 else None
    part = (place_m - places[i - 1]) / (places[i] - places[i - 1])
    return float(times[i - 1] + part * (times[i] - times[i - 1]))


def label(row: Row) -> str:
    """A trial in a few words."""
    if row["source"] == "human":
        return visible(f"human {row['pair']}, {row['condition']}")
    return visible(f"{row['model']}, {row['variant']}, {row['condition']}, rep {row['rep']}")


def collision_bounds(trial: Trial) -> list[float | None]:
    """The headway below which the vehicles collide, for each sample; None where they cannot."""
    left, right = trial.states.get("left"), trial.states.get("right")
    if left is None or right is None:
        return []
    scenario = trial.scenario
    pairs = list(zip(left["position_m"], right["position_m"], strict=False))
    if scenario.collision_rule == "shared_lane":
        length_m = scenario.vehicle_length_m
        return [length_m if max(pair) >= TRACK.merge_point_m else None for pair in pairs]
    # From there on the road is straight, and the bound stays the same.
    straight_m = TRACK.merge_point_m + scenario.vehicle_length_m + scenario.vehicle_width_m
    means = [min((a + b) / 2, straight_m) for a, b in pairs]
    bounds = {mean_m: _bound(scenario, mean_m) for mean_m in {*means}}
    return [bounds[mean_m] for mean_m in means]


def _bound(scenario: ScenarioConfig, mean_m: float) -> float | None:
    """At the vehicles' mean position; by bisection.

    The further apart two vehicles are along the road, the less they overlap.
    """
    if not collided(scenario, TRACK, mean_m, mean_m):
        return None
    low, high = 0.0, 2 * (scenario.vehicle_length_m + scenario.vehicle_width_m)
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        if collided(scenario, TRACK, mean_m + middle / 2, mean_m - middle / 2):
            low = middle
        else:
            high = middle
    return round(high, 3)


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


def older_plan(trial: Trial, row: Row) -> str:
    """On which plan a driver went on whose reply held none, and from which of its steps."""
    side, number, scenario = row["side"], row["decision"], trial.scenario
    pace = trial.paces[side]
    old = row["before"]
    while old and not old["plan"]:
        old = old["before"]
    if old is None:
        return "it had no earlier plan, and kept its speed"
    since = 0 if scenario.fallback == "restart" else number - old["decision"]
    begun, steps = since * pace.executed_actions, len(old["plan"])
    if begun >= steps:
        return f"its last plan, of decision {old['decision']}, had ended, and it kept its speed"
    last = min(begun + pace.executed_actions, steps)
    ended = "" if last - begun == pace.executed_actions else ", and then kept its speed"
    return (
        f"it drove steps {begun + 1} to {last} of the {steps} that it had planned in decision "
        f"{old['decision']}, starting {clock(begun * pace.action_steps * scenario.step_s)} s into "
        f"that plan{ended}"
    )


def aftermath(trial: Trial, decision: Row) -> list[dict[str, Any]]:
    """Both vehicles where a decision was made and where the next one was, or at the end."""
    if decision["lost"]:
        return []
    start = decision["time_s"]
    until = start + trial.interval_s(decision["side"])
    found = []
    for side, samples in trial.states.items():
        times = samples["time_s"]
        inside = [i for i, t in enumerate(times) if start - 1e-9 <= t <= until + 1e-9]
        if len(inside) > 1:
            first, last = inside[0], inside[-1]
            found.append(
                {
                    "side": side,
                    "own": side == decision["side"],
                    "lasted_s": times[last] - times[first],
                    "from_mps": samples["velocity_mps"][first],
                    "to_mps": samples["velocity_mps"][last],
                    "moved_m": samples["position_m"][last] - samples["position_m"][first],
                    "to_merge_m": TRACK.merge_point_m - samples["position_m"][last],
                }
            )
    return sorted(found, key=lambda vehicle: not vehicle["own"])
