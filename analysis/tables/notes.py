"""Sentences under the tables: what n rests on, and what was left out."""

from __future__ import annotations

from collections.abc import Iterable

from analysis.ceiling import DATA_SETS, SEED
from analysis.human.counts import findings, human_counts
from analysis.piecewise import THRESHOLDS
from analysis.published import HUMAN_DOI, HUMAN_GAP_SD_M
from analysis.study import Group, Study
from analysis.verdicts import thresholds


def sample_notes(study: Study, groups: Iterable[Group]) -> list[str]:
    """One note a group: its trials, and which of them are left out."""
    notes = []
    for group in groups:
        finished = len(group.finished)
        text = f"{group.id}: {finished} of {len(group.trials)} trials finished, left out: "
        notes.append(text + group.left_out)
    if not study.models:
        notes.append(f"{study.db} holds no trial of a model; `make sweep` plays some")
    if study.human.measured and study.human in study.groups:
        notes += [f"human: {finding}" for finding in findings(human_counts(study.db))]
    if not study.human.measured and study.human in study.groups:
        notes.append(
            "human: the published outcomes of 990 trials; for the rest `merge-runner human import "
            f"PATH` reads the recordings (doi {HUMAN_DOI})"
        )
    notes += [
        f"{group.driver} is a scripted stand-in, no language model"
        for group in dict.fromkeys(
            g for g in groups if g.scripted and g.setting in {"", "baseline"}
        )
    ]
    return notes


def ceiling_notes(study: Study) -> list[str]:
    """What the human ceiling is drawn from."""
    source = (
        "whole trials are resampled from the imported recordings"
        if study.human.measured
        else "outcomes from the published counts, gaps from the published regression with "
        f"residuals of SD {HUMAN_GAP_SD_M} m"
    )
    return [
        f"humans pass: share of {DATA_SETS} human data sets with as many trials per condition as "
        f"the row has (seed {SEED}; {source}); at the score: I1 to I4 together. No driver can be "
        "expected to score above it"
    ]


def piecewise_notes(study: Study) -> list[str]:
    """The thresholds of I5."""
    limits = thresholds(study)
    state = (
        "the reversal limit is the human 95th percentile"
        if study.human.measured
        else "uncalibrated, no human traces are imported"
    )
    return [
        f"I5: a trial passes where both speeds are fitted within {limits.max_rmse_mps:.2f} m/s "
        f"with at most {limits.max_knot_rate_hz:.1f} knots and {limits.max_reversal_rate_hz:.2f} "
        f"reversals per s ({state}); a group passes where at least "
        f"{100 * THRESHOLDS.min_share:.0f} % of its trials do, by the Wilson lower bound"
    ]
