"""First actions of every driver beside the humans', by own relative velocity."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from merge_runner_analysis.data.reference_data import citation, published
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.stats.first_action import (
    HOLD_MPS2,
    exchange_rate,
    first_actions,
    human_exchange_rate,
    repeats_itself,
    seats,
    slope,
)
from merge_runner_analysis.stats.intervals import Estimate
from merge_runner_analysis.tables.model import (
    ENDED,
    GROUP_COLUMNS,
    Optional,
    Row,
    Table,
    Value,
    interval,
    row_of,
)

FILE = "human_first_actions"
NOTHING = (
    "no trial that ended has a first action of both: none did, or with control_start = "
    '"own_exit" one driver acts while the other is in its tunnel yet'
)
REPEATS = (
    "{name} declares no chance, and does the same first in all repetitions of a situation: each "
    "situation counts once"
)
ONLY_ASKED = (
    "asked without the loop (`merge-runner sweep --first`), in {trials} trials that end before a "
    "second decision"
)
# By the sign of the own relative velocity.
VELOCITIES = {-1: "slower", 0: "equal", 1: "faster"}
COLUMNS = (
    Optional("n", "n", "count", 0, "first actions: two a trial, one of a mixed pair"),
    *(
        Optional(f"mean_{name}", name, "number", 3, f"mean (m/s²) where the own velocity is {name}")
        for name in VELOCITIES.values()
    ),
    Optional("brake_percent", "brake (%)", "percent", 1, f"below -{HOLD_MPS2} m/s²"),
    Optional("hold_percent", "hold (%)", "percent", 1, f"within {HOLD_MPS2} m/s² of 0"),
    Optional("go_percent", "go (%)", "percent", 1, f"above {HOLD_MPS2} m/s²"),
    Optional("slope", "slope", "number", 3, "on own relative velocity, m/s² per m/s"),
    Optional("slope_se", "SE", "number", 3, "of the slope, clustered by trial"),
    interval("slope_ci", "of the slope", 3),
    Optional("exchange_rate", "exchange rate", "number", 2, "m of headway that are worth 1 m/s"),
    interval("exchange_rate_ci", "of the rate, by the delta method"),
)


def first_action(study: Study) -> Table:
    """Make the table: a row per driver and prompt, two for a mixed pair."""
    groups = (*study.groups, *study.asked)
    return Table(
        "first-action",
        (*GROUP_COLUMNS, *COLUMNS),
        [row for group in groups for row in _rows(study, group)],
        (
            "the first action is the net acceleration of the first step under control, drag "
            "included; own relative velocity is own minus other. A first decision without a valid "
            "plan holds, and counts",
            "slope: least squares with errors clustered by trial. Exchange rate: minus the ratio "
            "of the slopes on own relative velocity and own projected headway in a logit of M as "
            "the first word, of humans in one of who merged first; empty where a driver has no "
            "word, or the logit no finite estimate",
            *_human_notes(study),
        ),
    )


def _rows(study: Study, group: Group) -> Iterator[Row]:
    if group is study.human and not study.complete:
        yield _published_row(group)
        return
    for seat in seats(group):
        rows = first_actions(study, seat)
        rate = human_exchange_rate() if group is study.human else exchange_rate(rows)
        values: dict[str, Value] = {"driver": seat.name, "n": len(rows)}
        values |= _values(rows, rate) if len(rows) else {}
        remarks = (
            "" if len(rows) else NOTHING,
            REPEATS.format(name=seat.name) if repeats_itself(study, seat) else "",
            ONLY_ASKED.format(trials=len(group.ended)) if group in study.asked else "",
        )
        yield row_of(group, values, *remarks, item=seat.side, counts=ENDED)


def _values(rows: pd.DataFrame, rate: Estimate | None) -> dict[str, Value]:
    action, sign = rows["first_mps2"], np.sign(rows["velocity_mps"].round(6))
    means = action.groupby(sign).mean()
    fitted = slope(rows)
    return {
        **{f"mean_{name}": float(means[at]) for at, name in VELOCITIES.items() if at in means},
        "brake_percent": float(100 * (action < -HOLD_MPS2).mean()),
        "hold_percent": float(100 * (action.abs() <= HOLD_MPS2).mean()),
        "go_percent": float(100 * (action > HOLD_MPS2).mean()),
        **_estimate("slope", fitted),
        "slope_se": fitted.se if fitted else None,
        **_estimate("exchange_rate", rate),
    }


def _published_row(group: Group) -> Row:
    by_velocity, known = published(FILE), _published_slope()
    weights = by_velocity["n"] / by_velocity["n"].sum()
    values: dict[str, Value] = {
        "n": int(by_velocity["n"].sum()),
        **{
            f"mean_{VELOCITIES[np.sign(row.relative_velocity_mps)]}": row.mean_mps2
            for row in by_velocity.itertuples()
        },
        **{
            f"{name}_percent": float((weights * by_velocity[f"{published_name}_percent"]).sum())
            for name, published_name in (("brake", "slow"), ("hold", "hold"), ("go", "go"))
        },
        "slope": float(known["value"]),
        "slope_ci": (float(known["low"]), float(known["high"])),
        **_estimate("exchange_rate", human_exchange_rate()),
    }
    return row_of(group, values, f"published ({citation(FILE)})", counts="")


def _estimate(name: str, estimate: Estimate | None) -> dict[str, Value]:
    return {name: estimate.value, f"{name}_ci": estimate.bounds()} if estimate else {}


def _published_slope() -> pd.Series:
    slopes = published("human_first_action_trials").set_index("measure")
    return slopes.loc["slope_mps2_per_mps"]


def _human_notes(study: Study) -> Iterator[str]:
    if study.human not in study.groups:
        return
    yield f"human: slope as published: {_published_slope()['caution']}"
    yield f"human: exchange rate: {citation('human_outcomes')}"
