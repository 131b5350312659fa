"""First actions by own relative velocity."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from merge_runner_analysis.grouping import Group
from merge_runner_analysis.published import citation, published
from merge_runner_analysis.stats import first_action as first
from merge_runner_analysis.stats.estimate import Estimate
from merge_runner_analysis.stats.first_action import HOLD_MPS2, KINDS, human_exchange_rate
from merge_runner_analysis.study import StudyResults
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

FIRST_FILE = "human_first_actions"
NO_ACTION = (
    "no trial that ended has a first action of both: none did, or with control_start = "
    '"own_exit" one driver acts while the other is in its tunnel yet'
)
# By the sign of the own relative velocity.
VELOCITIES = {-1: "slower", 0: "equal", 1: "faster"}
FIRST_ACTIONS = (
    Optional("n", "n", "count", "first actions: two a trial, one of a mixed pair"),
    *(
        Optional(f"mean_{x}", x, "number", f"mean (m/s²) where the own velocity is {x}", digits=3)
        for x in VELOCITIES.values()
    ),
    Optional(
        "brake_percent", "brake (%)", "percent", f"below -{HOLD_MPS2} m/s²", "brake", digits=1
    ),
    Optional(
        "hold_percent", "hold (%)", "percent", f"within {HOLD_MPS2} m/s² of 0", "hold", digits=1
    ),
    Optional("go_percent", "go (%)", "percent", f"above {HOLD_MPS2} m/s²", "go", digits=1),
    Optional("slope", "slope", "number", "on own relative velocity, m/s² per m/s", digits=3),
    Optional("slope_se", "SE", "number", "of the slope, clustered by trial", digits=3),
    interval("slope_ci", "of the slope", digits=3),
    Optional("exchange_rate", "exchange rate", "number", "m of headway that are worth 1 m/s"),
    interval("exchange_rate_ci", "of the rate, by Fieller"),
)


def first_action(study: StudyResults) -> Table:
    """Make the table: a row per driver and prompt, two for a mixed pair."""
    groups = (*study.groups, *study.probes)
    return Table(
        "first-action",
        (*GROUP_COLUMNS, *FIRST_ACTIONS),
        [row for group in groups for row in _first_rows(study, group)],
        (
            "the first action is the net acceleration of the first step under control, drag "
            "included; own relative velocity is own minus other. A first decision without a valid "
            "plan holds, and counts",
            "slope: least squares with errors clustered by trial. Exchange rate: minus the ratio "
            "of the slopes on own relative velocity and own projected headway in a logit of M as "
            "the first word, of humans in one of who merged first; empty where a driver has no "
            "word, or the logit no finite estimate",
            *(
                [
                    f"human: slope as published: {_published_slope()['caution']}",
                    f"human: exchange rate: {citation('human_outcomes')}",
                ]
                if study.human in study.groups
                else []
            ),
        ),
    )


def _first_rows(study: StudyResults, group: Group) -> Iterator[Row]:
    if group is study.human and not study.complete:
        yield _published_row(group)
        return
    for driver in first.drivers_of(group):
        rows = first.first_actions(study, driver)
        rate = human_exchange_rate() if group is study.human else first.exchange_rate(rows)
        values: dict[str, Value] = {"driver": driver.name, "n": len(rows)}
        if len(rows):
            action, sign = rows["first_mps2"], np.sign(rows["velocity_mps"].round(6))
            means, fitted = action.groupby(sign).mean(), first.slope(rows)
            values |= {f"mean_{VELOCITIES[at]}": float(mean) for at, mean in means.items()}
            values |= {
                **{f"{name}_percent": float(100 * of(action).mean()) for name, of in KINDS.items()},
                "slope_se": fitted.se if fitted else None,
                **_estimate("slope", fitted),
                **_estimate("exchange_rate", rate),
            }
        remarks = [] if len(rows) else [NO_ACTION]
        if first.repeats_itself(study, driver):
            remarks.append(
                f"{driver.name} is deterministic, and its first action is the same in all "
                "repetitions of a condition: each condition counts once"
            )
        if len(rows) and rate and rate.low is None:
            remarks.append(
                "exchange rate: no finite interval, as the slope on headway may be 0 (Fieller 1954)"
            )
        if group in study.probes:
            remarks.append(
                f"asked without the loop (`merge-runner sweep --first`), in {len(group.ended)} "
                "trials that end before a second decision"
            )
        yield row_of(group, values, *remarks, item=driver.side, rests_on=ENDED)


def _published_row(group: Group) -> Row:
    rows, known = published(FIRST_FILE), _published_slope()
    weights = rows["n"] / rows["n"].sum()
    names = "mean_" + np.sign(rows["relative_velocity_mps"]).map(VELOCITIES)
    shares = {"brake": "slow", "hold": "hold", "go": "go"}
    values: dict[str, Value] = {
        "n": int(rows["n"].sum()),
        **dict(zip(names, rows["mean_mps2"], strict=True)),
        **{
            f"{name}_percent": float((weights * rows[f"{of}_percent"]).sum())
            for name, of in shares.items()
        },
        "slope": float(known["value"]),
        "slope_ci": (float(known["low"]), float(known["high"])),
        **_estimate("exchange_rate", human_exchange_rate()),
    }
    return row_of(group, values, f"published ({citation(FIRST_FILE)})", rests_on="")


def _estimate(name: str, estimate: Estimate | None) -> dict[str, Value]:
    return {name: estimate.value, f"{name}_ci": estimate.bounds()} if estimate else {}


def _published_slope() -> pd.Series:
    return published("human_first_action_trials").set_index("measure").loc["slope_mps2_per_mps"]
