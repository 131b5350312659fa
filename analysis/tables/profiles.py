"""The shape of velocity profiles (the numbers behind indicator I5), and how plans are revised."""

from __future__ import annotations

from merge_runner_analysis.data.study import Group, Study, of_group
from merge_runner_analysis.stats.likeness import NO_ACTION, gains, held, less_humans, mean_gain
from merge_runner_analysis.tables.model import GROUP_COLUMNS, Column, Row, Table, Value, row_of
from merge_runner_analysis.tables.notes import intermittency_notes, sample_notes


def velocity_profiles(study: Study) -> Table:
    """A row per group: how far accelerations are held, compared with humans, and plan revisions."""
    return Table(
        "velocity-profiles",
        (
            *GROUP_COLUMNS,
            Column("n", "n", "count", 0, "finished trials"),
            Column("no_action", "no action", "count", 0, "trials in which no vehicle acted"),
            Column("gain", "gain", "number", 2, "mean gain of lines over cubics (I5)"),
            Column("gain_ci", "95 % CI", "interval", 2, "t, of humans over pairs", optional=True),
            Column("held_percent", "held (%)", "percent", 1, "trials with a gain above 0"),
            Column(
                "clocked_gain",
                "gain at 1 Hz",
                "number",
                2,
                "gain of the same speeds, one acceleration a second",
                optional=True,
            ),
            Column(
                "difference_sd",
                "- humans (SD)",
                "number",
                2,
                "difference from the humans within conditions, in human SD",
                optional=True,
            ),
            Column("difference_sd_ci", "95 % CI", "interval", 2, "Welch, by pair", optional=True),
            Column(
                "revision",
                "revision",
                "number",
                3,
                "mean |new plan - old plan| over the instants of both, in units of full throttle",
                optional=True,
            ),
            Column(
                "revised_percent", "> 0.1 (%)", "percent", 1, "revisions above 0.1", optional=True
            ),
            Column(
                "coarse_percent",
                "coarse plans (%)",
                "percent",
                1,
                "plans of at most two distinct values",
                optional=True,
            ),
        ),
        [_row(study, group) for group in study.groups],
        (*intermittency_notes(study), *sample_notes(study, study.groups)),
    )


def _row(study: Study, group: Group) -> Row:
    values: dict[str, Value] = {"n": len(group.finished)}
    if not group.measured:
        return row_of(group, values, "no human traces are imported")
    # A trial in which no vehicle acted has no gain.
    share = held(study, group)
    values |= {"no_action": int(gains(study, group)["steady"].sum())} | gain_values(study, group)
    values["clocked_gain"] = mean_gain(study, group, "clocked_gain").value
    if share.value is not None:
        values["held_percent"] = 100 * share.value
    if found := less_humans(study, group):
        values |= {"difference_sd": found.value, "difference_sd_ci": found.bounds()}
    # Plans are revised in trials that collide, too: ``ended`` here, ``finished`` above.
    plans = of_group(study.plans, group, group.ended)[
        ["plans", "coarse_plans", "revised_plans", "total_revision", "large_revisions"]
    ].sum()
    if plans["plans"]:
        # Sums are divided at the end: every plan weighs the same, not every trial.
        values["coarse_percent"] = float(100 * plans["coarse_plans"] / plans["plans"])
    if plans["revised_plans"]:
        values["revision"] = float(plans["total_revision"] / plans["revised_plans"])
        values["revised_percent"] = float(100 * plans["large_revisions"] / plans["revised_plans"])
    return row_of(group, values, "" if share.n else NO_ACTION)


def gain_values(
    study: Study, group: Group, value: str = "gain", interval: str = "gain_ci"
) -> dict[str, Value]:
    """The mean gain and its interval under these column names; empty if speeds are unknown."""
    if not group.measured:
        return {}
    found = mean_gain(study, group)
    return {value: found.value, interval: found.bounds()}
