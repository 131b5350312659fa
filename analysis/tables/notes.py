"""Sentences under the tables: what n rests on, and what was left out."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache

from analysis.ceiling import DATA_SETS, SEED
from analysis.piecewise import THRESHOLDS
from analysis.published import HUMAN_DOI, HUMAN_GAP_SD_M
from analysis.study import Group, Study
from analysis.verdicts import thresholds


def sample_notes(study: Study, groups: Iterable[Group]) -> list[str]:
    """One note a group on its trials and those left out, and what else to know of the drivers."""
    shown = list(groups)
    notes = [
        f"{group.id}: {len(group.finished)} of {len(group.trials)} trials finished, left out: "
        + group.left_out
        for group in shown
    ]
    if study.empty:
        notes.append(f"{study.db} holds no trial of a model; `make sweep` plays some")
    if study.human in study.groups:
        notes += _human_notes(study)
    scripted = dict.fromkeys(group.driver for group in shown if group.scripted)
    return [*notes, *(f"{driver} is a scripted stand-in, no language model" for driver in scripted)]


@cache
def _human_notes(study: Study) -> tuple[str, ...]:
    if study.imported is None:
        return (
            "human: the published outcomes of 990 trials; for the rest `merge-runner human import "
            f"PATH` reads the recordings (doi {HUMAN_DOI})",
        )
    return (
        *(f"human: {finding}" for finding in study.imported.findings()),
        "human: intervals and tests take the trials as independent, but the imported ones come "
        f"from {study.imported.pairs} pairs who differ: they are too narrow",
    )


def ceiling_notes(study: Study) -> list[str]:
    """What the human ceiling is drawn from."""
    source = (
        "whole trials are resampled from the imported recordings"
        if study.complete
        else "outcomes from the published counts, gaps from the published regression with "
        f"residuals of SD {HUMAN_GAP_SD_M} m"
    )
    return [
        f"humans pass: share of {DATA_SETS} human data sets with as many trials per condition as "
        f"the row has (seed {SEED}; {source}); at the score: I1 to I4 together. So often a perfect "
        "copy of the humans passes"
    ]


def piecewise_notes(study: Study) -> list[str]:
    """The thresholds of I5."""
    limits = thresholds(study)
    state = (
        "the reversal limit is the human 95th percentile, the others are uncalibrated"
        if study.calibrated
        else "uncalibrated: human traces of every condition are not imported"
    )
    return [
        f"I5: a trial passes where both speeds are fitted within {limits.max_rmse_mps:.2f} m/s "
        f"with at most {limits.max_knot_rate_hz:.1f} knots and {limits.max_reversal_rate_hz:.2f} "
        f"reversals per s ({state}); a group passes where at least "
        f"{100 * THRESHOLDS.min_share:.0f} % of its trials do, by the Wilson lower bound"
    ]
