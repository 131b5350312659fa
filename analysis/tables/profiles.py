"""How velocity profiles look: the numbers behind indicator I5, and the size of plan revisions."""

from __future__ import annotations

from analysis.intervals import mean
from analysis.study import Group, Study, of_group
from analysis.tables.model import Column, Row, Table, Value
from analysis.tables.notes import piecewise_notes, sample_notes
from analysis.verdicts import piecewise_share


def velocity_profiles(study: Study) -> Table:
    """One row a group: share of piecewise-linear trials, knots, residuals, reversals, plans."""
    profile = "of the piecewise-linear fit, mean of both vehicles of finished trials"
    return Table(
        "velocity-profiles",
        "Piecewise-linear velocity profiles (I5) and plan revisions",
        (
            Column("driver", "driver"),
            Column("setting", "setting"),
            Column("n", "n", "count", 0, "finished trials"),
            Column("passing_percent", "passing (%)", "percent", 1, "trials that pass I5"),
            Column("passing_percent_ci", "95 % CI", "interval", 1, "Wilson", optional=True),
            Column("knot_rate_hz", "knots (1/s)", "number", 2, f"knots per s {profile}"),
            Column("residual_mps", "residual (m/s)", "number", 3, f"RMSE {profile}"),
            Column("reversal_rate_hz", "reversals (1/s)", "number", 2, "sign changes of a per s"),
            Column(
                "revision",
                "revision",
                "number",
                3,
                "mean |new plan - old plan| over the instants of both, in units of full throttle",
                "true",
                True,
            ),
            Column(
                "revised_percent", "> 0.1 (%)", "percent", 1, "revisions above 0.1", "true", True
            ),
            Column(
                "coarse_percent",
                "coarse plans (%)",
                "percent",
                1,
                "plans of at most two distinct values",
                "true",
                True,
            ),
        ),
        [_row(study, group) for group in study.groups],
        (*piecewise_notes(study), *sample_notes(study, study.groups)),
    )


def _row(study: Study, group: Group) -> Row:
    values: dict[str, Value] = {
        "driver": group.label,
        "setting": group.setting or None,
        "n": len(group.finished),
    }
    if not group.measured:
        return Row(group.id, (group.id,), values | {"setting": ""}, "no human traces are imported")
    values["setting"] = group.setting
    share = piecewise_share(study, group)
    profiles = of_group(study.profiles, group, group.finished)
    note = "" if len(profiles) else "no finished trial"
    if share.value is not None and share.low is not None and share.high is not None:
        values["passing_percent"] = 100 * share.value
        values["passing_percent_ci"] = (100 * share.low, 100 * share.high)
    for name, column in (
        ("knot_rate_hz", "knot_rate_hz"),
        ("residual_mps", "rmse_mps"),
        ("reversal_rate_hz", "reversal_rate_hz"),
    ):
        values[name] = mean(profiles[column].to_numpy(float)).value
    plans = of_group(study.plans, group, group.ended)[
        ["plans", "coarse_plans", "revised_plans", "total_revision", "large_revisions"]
    ].sum()
    if plans["plans"]:
        values["coarse_percent"] = float(100 * plans["coarse_plans"] / plans["plans"])
    if plans["revised_plans"]:
        values["revision"] = float(plans["total_revision"] / plans["revised_plans"])
        values["revised_percent"] = float(100 * plans["large_revisions"] / plans["revised_plans"])
    return Row(group.id, (group.id,), values, note)
