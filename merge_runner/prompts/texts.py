"""Texts of the prompt blocks, of the paper and further ones for studies."""

from __future__ import annotations

import re

TACTICAL, OUTPUT_FORMAT = "C4", "C5"


_APPROACHING = """\
You drive a car towards a merge. Two roads join at a merge point and go on as a single lane. You \
are on one of the two roads and another car is on the other one. Neither of you has the right of \
way. """
_MERGED = """\
You drive a car on a straight road: you have passed a merge point where two roads join to a \
single lane. Another car comes from the other road and is ahead of you or behind you. """
_SITUATION = """\
You cannot steer and you cannot communicate with the other driver: you control only the \
acceleration of your own car. You are asked for a new plan every {prompt_interval_s} s.

Situation now:
- Road type: ROAD
- Length of each car: {vehicle_length} m
- Your speed: {own_speed} m/s
- Speed of the other car: {other_speed} m/s
- Relative distance (how far the other car is ahead of you along the road; negative if it is \
behind): {relative_distance} m"""
_DISTANCE_LEFT = "\n- Your distance to the merge point: {distance_to_merge} m"
_SITUATIONS = (
    _APPROACHING + _SITUATION.replace("ROAD", "merge") + _DISTANCE_LEFT,
    _MERGED + _SITUATION.replace("ROAD", "straight"),
)


def _tabled(situation: str) -> str:
    introduction, *items = situation.split("\n- ")
    rows = (re.sub(r"(.*): (\S+) ?(.*)", r"| \1 | \2 | \3 |", item) for item in items)
    return "\n".join([introduction, "| quantity | value | unit |", "|---|---|---|", *rows])


_HISTORY = """\
History of the last {memory_s} s, one value every {step_s} s, oldest first:
- Your executed accelerations (m/s^2): {own_accelerations}
- Observed speeds of the other car (m/s): {other_speeds}"""

_HUMAN = "Drive the way a human driver would drive in this situation."
_DISTANCE = "Be risk-averse: keep a conservative distance to the other car."
_REASSESS = (
    "Reassess the situation regularly: when the other car behaves differently from what you "
    "expected, adapt your plan."
)
_TACTICAL = (
    "Tactical decision: before you plan your accelerations, decide whether you merge "
    "first (M) or yield to the other car (Y)."
)

_SCHEMA = """\
Output format:
1. If a tactical decision is asked for above, write its letter alone on the first line.
2. Explain in two or three sentences what you do and why.
3. Give your acceleration plan for the next {horizon_s} s as a list of exactly {plan_actions} \
numbers, one for every {step_s} s. Each number lies between -1 and 1, where 1 stands for an \
acceleration of {max_acceleration} m/s^2 and -1 for a deceleration of {max_acceleration} m/s^2. \
Write the list in a Python code block that holds nothing but the list."""

_HEADWAY = """\
Projected headway (which car is ahead when the first of you reaches the merge point at present \
speeds): {projected_headway}"""
_TIMES = """\
Time to the merge point at present speeds:
- You: {own_time_to_merge}
- The other car: {other_time_to_merge}"""
_GAP = "Time gap (how long the car behind takes to where the car ahead is now): {time_gap}"
_KMH = "In km/h: your speed is {own_speed_kmh}, the speed of the other car {other_speed_kmh}"
_MPH = "In mph: your speed is {own_speed_mph}, the speed of the other car {other_speed_mph}"

# Name, meaning, and a text for both roads, or one for each.
PAPER = (
    ("C0", "situation", *_SITUATIONS),
    ("C1", "history", _HISTORY),
    (
        "C2",
        "previous plan",
        "Previous plan (the part of it that has not been executed yet): {remaining_plan}",
    ),
    ("C3.safety", "avoid a collision", "Avoid a collision with the other car."),
    ("C3.human", "drive like a human", _HUMAN),
    ("C3.distance", "keep a distance", _DISTANCE),
    ("C3.reassess", "reassess", _REASSESS),
    (TACTICAL, "tactical decision", _TACTICAL, None),
    (OUTPUT_FORMAT, "output format", _SCHEMA),
)
FURTHER = (
    ("state.projected_headway", "projected headway", _HEADWAY, None),
    ("state.time_to_merge", "times to the merge point", _TIMES, None),
    ("state.time_gap", "time gap", _GAP),
    (
        "state.relative_speed",
        "relative speed in words",
        "Relative speed: {relative_speed_in_words}",
    ),
    ("state.kmh", "speeds in km/h", _KMH),
    ("state.mph", "speeds in mph", _MPH),
    ("state.table", "situation as a table, in place of C0", *map(_tabled, _SITUATIONS)),
)
# Ablations of the paper: name, blocks that it leaves out, title in tables (Table VI).
ABLATIONS: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("A1", ("C1",), "A1 (-History)"),
    ("A2", ("C2",), "A2 (-Prev. acc. plan)"),
    ("A3", ("C3.safety",), "A3 (-Safety)"),
    ("A4", ("C3.human",), "A4 (-Human)"),
    ("A5", ("C3.distance",), "A5 (-Distance)"),
    ("A6", ("C3.reassess",), "A6 (-Reassess)"),
    ("A7", ("C4",), "A7 (-Tactical plan)"),
)
