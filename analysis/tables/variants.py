"""Tables III and IV for every prompt variant, with its differences from the reference prompt."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from analysis.data.study import Group, Study, in_one_study
from analysis.stats.group_scores import Fits, fits
from analysis.stats.intervals import POWER
from analysis.stats.penalised import firth_intervals
from analysis.stats.regressions import GAP_TERMS, WHO_FIRST_TERMS, Regression
from analysis.stats.variants import (
    Corrected,
    Differences,
    corrected_differences,
    gap_differences,
    variants,
    who_first_differences,
)
from analysis.tables.contrasts import shared_notes
from analysis.tables.model import Column, Kind, Row, Table
from analysis.tables.notes import sample_notes
from analysis.tables.regressions import WITH_GAP, WITH_MERGER, gap_row, key_columns, who_first_row

FAMILY_NOTE = (
    "difference: from the {} prompt of the same driver; Holm, BH: corrected over the variants of a "
    "driver, one term a family; detectable: the smallest difference that one such test, not yet "
    f"corrected, shows in {100 * POWER:.0f} % of studies of this size"
)


def who_first_variants(study: Study) -> Table:
    """Table III with a row per group and term, and the differences from the reference prompt."""
    return Table(
        "who-first-variants",
        "Logistic regression of which driver merged first (1: left), for every prompt variant",
        (
            *key_columns(WITH_MERGER, Column("setting", "setting")),
            *_fit_columns("", "", "", "p", "Wald", WITH_MERGER),
            *_fit_columns("firth_", "Firth ", "", "LR p", "penalised likelihood", WITH_MERGER),
            *_difference_columns(WITH_MERGER),
        ),
        _rows(study, WHO_FIRST_TERMS, _who_first_row, who_first_differences, lambda fit: fit.logit),
        (
            FAMILY_NOTE.format(study.reference),
            "differences are tested by Wald's test; there is none where one of the two fits has no "
            "finite estimate",
            *shared_notes(study),
            *sample_notes(study, study.groups),
        ),
    )


def gap_variants(study: Study) -> Table:
    """Table IV with a row per group and term, and the differences from the reference prompt."""
    return Table(
        "gap-variants",
        "Linear regression of the gap at the merge point (m), for every prompt variant",
        (
            *key_columns(WITH_GAP, Column("setting", "setting")),
            *_fit_columns("", "", "", "p", "Student's t", WITH_GAP),
            *_fit_columns("hc3_", "", "HC3 ", "HC3 p", "Student's t, HC3 errors", WITH_GAP)[1:],
            *_difference_columns(WITH_GAP),
        ),
        _rows(study, GAP_TERMS, gap_row, gap_differences, lambda fit: fit.hc3),
        (
            FAMILY_NOTE.format(study.reference),
            "differences are tested by Welch's t test with HC3 errors",
            *shared_notes(study),
            *sample_notes(study, study.groups),
        ),
    )


def _fit_columns(
    name: str, estimate: str, other: str, p: str, test: str, counts: str
) -> tuple[Column, ...]:
    """Columns of one fit's coefficient, error, interval and p.

    ``estimate`` is the prefix of the coefficient's heading, ``other`` that of the next two.
    """
    # The first fit is the table's subject: where it is missing, a note must say why.
    optional = bool(name)
    return (
        Column(f"{name}b", f"{estimate}b", "number", 2, "coefficient", counts, optional),
        Column(f"{name}se", f"{other}SE", "number", 3, "standard error", counts, optional),
        Column(f"{name}ci", f"{other}95 % CI", "interval", 2, test, counts, optional),
        Column(f"{name}p", p, "p", 3, test, counts, optional),
    )


def _difference_columns(counts: str) -> tuple[Column, ...]:
    def column(name: str, heading: str, kind: Kind, digits: int, meaning: str) -> Column:
        return Column(name, heading, kind, digits, meaning, counts, optional=True, of="both")

    return (
        column(
            "difference",
            "difference",
            "number",
            2,
            "of the coefficients",
        ),
        column("difference_ci", "95 % CI", "interval", 2, "of the difference"),
        column("difference_p", "p", "p", 3, "of the difference, two-sided"),
        column("p_holm", "Holm", "p", 3, "corrected by Holm"),
        column("p_bh", "BH", "p", 3, "corrected by Benjamini and Hochberg"),
        column("detectable", "detectable", "number", 2, "smallest difference that would be shown"),
    )


def _who_first_row(group: Group, term: str) -> Row:
    """The row of Table III, with the profile interval of Firth's coefficient."""
    # A penalised likelihood can be skewed, where b +- z SE misleads (Heinze and Schemper 2002).
    row, profiles = who_first_row(group, term), firth_intervals(group)
    return replace(row, values={**row.values, "firth_ci": profiles.get(term)})


def _rows(
    study: Study,
    terms: Sequence[str],
    row: Callable[[Group, str], Row],
    differences: Differences,
    compared: Callable[[Fits], Regression],
) -> list[Row]:
    """A row per group for each term; ``compared`` is the fit that a difference requires."""
    found, baselines = corrected_differences(study, differences), dict(variants(study))
    rows = []
    for term in terms:
        for group in study.groups:
            one = found.get((group.id, term))
            plain = row(group, term)
            if one is not None:
                plain = _with_difference(plain, baselines[group], one)
            elif group in baselines:
                why = _why_none(study, group, baselines[group], compared)
                plain = replace(plain, note="; ".join(filter(None, (plain.note, why))))
            rows.append(plain)
    return rows


def _with_difference(row: Row, baseline: Group | None, one: Corrected) -> Row:
    assert baseline is not None
    found = one.found
    return replace(
        row,
        references=(baseline.id,),
        values={
            **row.values,
            "difference": found.value,
            "difference_ci": found.bounds(),
            "difference_p": found.p,
            "p_holm": one.holm,
            "p_bh": one.bh,
            "detectable": found.detectable,
        },
    )


def _why_none(
    study: Study, group: Group, baseline: Group | None, compared: Callable[[Fits], Regression]
) -> str:
    """Why a variant has no difference from its reference, unless its own note already says so."""
    if baseline is None:
        return f"no difference: its driver has no {study.reference} prompt to compare with"
    if not in_one_study(study, group, baseline):
        return f"no difference from {baseline.id}: no study was played with all trials of both"
    problem = compared(fits(baseline)).problem
    # The note of its own regression names its own problem.
    if not problem and compared(fits(group)).problem:
        return ""
    return f"no difference from {baseline.id}: {problem or 'neither fit leaves an error'}"
