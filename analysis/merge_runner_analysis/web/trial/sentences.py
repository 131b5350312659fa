"""Sentences on a trial: its outcome, its condition and measures, and its charts."""

from __future__ import annotations

from merge_runner.config import ScenarioConfig
from merge_runner.prompts.blocks import title_of
from merge_runner.records import SIDES
from merge_runner_analysis.outlines import first_overlap
from merge_runner_analysis.web.phrases import clock, condition_text
from merge_runner_analysis.web.reading import Row
from merge_runner_analysis.web.trial.prompt_parts import words_of
from merge_runner_analysis.web.trial.reader import Trial, controlled
from merge_runner_analysis.wording import (
    NO_CRASH_YET,
    PLAYED_RULES,
    RULES_MEAN,
    capital,
    money,
    number,
)

MOVED = ("position_m", "velocity_mps")


def outcome_text(row: Row) -> str:
    """Return how a trial ended, in a sentence."""
    end = f"{row['end_time_s']:.1f} s"
    without_first = {
        "collided": f"The vehicles crashed after {end}.",
        "failed": f"The trial failed after {end}: {row['error']}.",
        "timeout": f"Nobody had left the track after {end}.",
    }
    first = row["merged_first"]
    if first is None:
        merged = f"The trial ended after {end}; no vehicle merged first."
        return without_first.get(row["status"], merged)
    other = "right" if first == "left" else "left"
    when = "" if row["time_to_merge_s"] is None else f", after {number(row['time_to_merge_s'])} s"
    gap = "" if row["gap_m"] is None else f", with a gap of {number(row['gap_m'])} m"
    return f"The {other} vehicle yielded: the {first} one reached the merge point first{when}{gap}."


def by_peoples_rule(row: Row, trial: Trial) -> str:
    """Say whether a trial is a crash by people's rule; empty where that was played, or for none.

    Both rules are named where they disagree.
    """
    task, rule = trial.scenario, trial.scenario.collision_rule
    if rule == "rectangle" or row["status"] == "failed" or len(trial.states) < len(SIDES):
        return ""
    left, right = (trial.states[side] for side in SIDES)
    columns = left["time_s"], *(of[name] for of in (left, right) for name in MOVED)
    samples = [(i, *sample) for i, sample in enumerate(zip(*columns, strict=False))]
    overlap = first_overlap(task, samples)
    if row["status"] == "collided":
        if overlap:
            return f"By people's rule it crashed, too, at {clock(overlap.time_s)} s."
        return "Not known by people's rule: the outlines had not overlapped when the trial ended."
    if overlap is None:
        return ""
    at, length = clock(overlap.time_s), task.vehicle_length_m
    texts = [
        f"By people's rule it crashed at {at} s: the outlines overlapped, with the centres "
        f"{number(overlap.apart_m)} m apart",
        f"By {PLAYED_RULES[rule]}, which was played, it did not: a crash is when "
        f"{RULES_MEAN[rule]} ({length:g} m), checked every {task.step_s:g} s",
        rule in NO_CRASH_YET and overlap.apart_m >= length and capital(NO_CRASH_YET[rule]),
        row["gap_m"] is not None and "The gap is that at the first merge",
    ]
    return " ".join(f"{text}." for text in texts if text)


def judged_text(scenario: ScenarioConfig) -> str:
    """Describe the outlines that the picture draws for the scenario's collision rule."""
    length = f"{scenario.vehicle_length_m:g} m"
    drawn = {
        "euclid2d": f"circles {length} across, a vehicle's length, about the centres",
        "shared_lane": f"bars of {length} along the road, once a vehicle is past the merge point",
        "rectangle": f"outlines of {length} by {scenario.vehicle_width_m:g} m",
    }[scenario.collision_rule]
    return f"{drawn}: it is a crash where they overlap"


def facts(row: Row) -> list[str]:
    """Return a trial's condition and measures, in short sentences."""
    condition = condition_text(row["projected_headway_m"], row["relative_velocity_mps"])
    programs = "no prompt, since only programs drive"
    title = title_of(row["variant"]) if row["variant"] else ""
    prompt = programs if row["source"] == "driver" else f"the prompt {title}"
    texts = (
        f"{row['condition']}: {condition}",
        f"prompt {title}" if title == row["variant"] else title and f"{row['variant']}: {prompt}",
        ", ".join(row["levels"] or ()),
        row["rmse_mps"] is not None and f"RMSE of the speed {number(row['rmse_mps'])} m/s",
        row["asked"] and f"{row['invalid']} of {row['asked']} decisions of models invalid",
        row["cost_usd"] is not None and money(row["cost_usd"], " USD"),
        row["caution"] and f"Note: {row['caution']}",
    )
    return [f"{text}." for text in texts if text]


def study_words(row: Row, trial: Trial) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return the words of a study by driver: a heading, and the levels with their text.

    Empty where neither prompt has any.
    """
    words = {
        side: words_of(decisions[0]["prompt"] or "", trial.blocks[side])
        for side, decisions in trial.by_side.items()
    }
    if len(words) == len(SIDES) and words["left"] == words["right"]:
        return [("Both drivers read", words["left"])] if words["left"] else []
    if not any(words.values()):
        return []
    role = {row["focal"]: ", the ego,"}
    return [(f"The {side} driver{role.get(side, '')} read", words.get(side, [])) for side in SIDES]


def summary(trial: Trial) -> list[str]:
    """Describe the charts of a trial, a sentence for each vehicle."""
    lines = []
    for side, samples in trial.states.items():
        speeds = controlled(samples, "velocity_mps")
        # A sample's acceleration covers the step before it.
        hardest = max(controlled(samples, "acceleration_mps2")[1:], key=abs, default=0.0)
        if speeds:
            lines.append(
                f"The {side} vehicle began at {speeds[0]:.1f} m/s, drove between "
                f"{min(speeds):.1f} and {max(speeds):.1f} m/s, and ended at {speeds[-1]:.1f} m/s; "
                f"its hardest acceleration or braking was {hardest:+z.1f} m/s²."
            )
    return lines
