"""The shape of velocity profiles: the numbers behind indicator I5."""

from __future__ import annotations

from merge_runner_analysis.data.intermittency import RANDOM_SECONDS, STEADY_MPS, random_gain
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.stats.likeness import NO_ACTION, gains, held, less_humans, mean_gain
from merge_runner_analysis.tables.model import (
    GROUP_COLUMNS,
    Column,
    Optional,
    Row,
    Table,
    Value,
    interval,
    row_of,
)
from merge_runner_analysis.tables.notes import GAIN


def velocity_profiles(study: Study) -> Table:
    """A row per group: how far accelerations are held, compared with humans."""
    return Table(
        "velocity-profiles",
        (
            *GROUP_COLUMNS,
            Column("n", "n", "count", 0, "finished trials"),
            Column("no_action", "no action", "count", 0, "trials in which no vehicle acted"),
            Column("gain", "gain", "number", 2, "mean gain of lines over cubics (I5)"),
            interval("gain_ci", "t, of humans over pairs"),
            Column("held_percent", "held (%)", "percent", 1, "trials with a gain above 0"),
            Optional("clocked_gain", "gain at 1 Hz", "number", 2, "one acceleration a second"),
            Optional("difference_sd", "- humans (SD)", "number", 2, "within conditions"),
            interval("difference_sd_ci", "Welch, by pair"),
        ),
        [_row(study, group) for group in study.groups],
        (
            f"{GAIN}: those that stay within {STEADY_MPS} m/s, with or without the simulator's "
            "resistance",
            "gain at 1 Hz: of the same speeds with one acceleration from each full second to the "
            "next, as any driver has that decides once a second and holds. Accelerations that are "
            f"drawn by chance each second have {random_gain():.2f}, on average over "
            f"{RANDOM_SECONDS} s: so much the clock alone can make",
            "the difference from the humans, in human SD, is no part of I5, and needs human traces "
            "of every condition; a revision is over the instants of both plans, in units of full "
            "throttle",
        ),
    )


def _row(study: Study, group: Group) -> Row:
    values: dict[str, Value] = {"n": len(group.finished)}
    if not group.measured:
        return row_of(group, values, "no human traces are imported")
    gain, share = mean_gain(study, group), held(study, group)
    values |= {
        "no_action": int(gains(study, group)["steady"].sum()),
        "gain": gain.value,
        "gain_ci": gain.bounds(),
        "clocked_gain": mean_gain(study, group, "clocked_gain").value,
        "held_percent": None if share.value is None else 100 * share.value,
    }
    if found := less_humans(study, group):
        values |= {"difference_sd": found.value, "difference_sd_ci": found.bounds()}
    return row_of(group, values, "" if share.n else NO_ACTION)
