"""The gap, and its regression, under each definition of the gap."""

from __future__ import annotations

from analysis.data.study import Group, Study
from analysis.metrics import GAP
from analysis.stats.intervals import mean
from analysis.stats.regressions import Regression, gap_ols
from analysis.tables.model import GROUP_COLUMNS, Column, Row, Table, Value, row_of
from analysis.tables.notes import measured_notes

# Maps a column of the trials to the definition that it follows.
DEFINITIONS = {
    GAP.value: "interpolated, first vehicle at the merge point (ours)",
    "gap_first_sample_m": "first sample, first vehicle at the merge point",
    "gap_mean100_m": "first sample, mean position at the merge point",
}
TERMS = {"headway": "abs_projected_headway", "velocity": "abs_relative_velocity"}


def gap_definitions(study: Study) -> Table:
    """A row per group and definition: the mean gap, and the coefficients behind I3 and I4."""
    return Table(
        "gap-definitions",
        "The gap and its dependence on headway and velocity, by the definition of the gap",
        (
            *GROUP_COLUMNS,
            Column("definition", "definition"),
            Column("n", "n", "count", 0, "finished trials with this gap"),
            Column(GAP.name, GAP.heading, GAP.kind, 2, "mean, net of the vehicle length"),
            Column("gap_m_ci", "95 % CI", "interval", 2, "Student's t", optional=True),
            Column("headway_b", "b of |h|", "number", 2, "coefficient of |h| (I3)"),
            Column("headway_p", "p", "p", 3, "its t test"),
            Column("velocity_b", "b of |Δv|", "number", 2, "coefficient of |Δv| in s (I4)"),
            Column("velocity_p", "p", "p", 3, "its t test"),
        ),
        [_row(group, column) for group in study.measured for column in DEFINITIONS],
        (
            "coefficients: least squares of the gap on |h|, |Δv| and h·Δv, as in the table gap; "
            "the mean position is that of Siebinga et al.",
            *measured_notes(study),
        ),
    )


def _row(group: Group, column: str) -> Row:
    found = mean(group.finished[column].to_numpy(float))
    fit = gap_ols(group.trials, column)
    values: dict[str, Value] = {
        "definition": DEFINITIONS[column],
        "n": found.n,
        GAP.name: found.value,
        "gap_m_ci": found.bounds(),
        **_coefficients(fit),
    }
    return row_of(group, values, fit.problem, item=column, counts=f"{column} IS NOT NULL")


def _coefficients(fit: Regression) -> dict[str, Value]:
    if not fit.terms:
        return {}
    found = {name: fit.terms[term] for name, term in TERMS.items()}
    return {
        **{f"{name}_b": term.b for name, term in found.items()},
        **{f"{name}_p": term.p for name, term in found.items()},
    }
