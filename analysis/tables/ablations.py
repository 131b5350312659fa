"""Tables VI and VII: indicators and measures across the prompt variants."""

from __future__ import annotations

from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.metrics import RULES_NOTE, HumanReference, Metric, intervals_of, shown_in
from merge_runner_analysis.stats.group_scores import score
from merge_runner_analysis.stats.indicators import INDICATORS
from merge_runner_analysis.stats.measures import (
    estimate_or_reference,
    no_human_value,
    outcomes_note,
    undecided_note,
)
from merge_runner_analysis.tables.indicators import (
    RULES,
    ceiling_values,
    score_note,
    score_text,
    verdict_note,
    verdict_values,
)
from merge_runner_analysis.tables.model import (
    ENDED,
    GROUP_COLUMNS,
    Column,
    Row,
    Table,
    Value,
    row_of,
)
from merge_runner_analysis.tables.notes import (
    ceiling_notes,
    intermittency_notes,
    listed,
    no_ceiling,
    sample_notes,
)

KEYS = (*GROUP_COLUMNS, Column("n", "n", "count", 0, "trials that ended"))


def ablation_qualitative(study: Study) -> Table:
    """Table VI: I1 to I5 of every driver and prompt variant."""
    columns = [*KEYS]
    for name in INDICATORS:
        prefix = f"{name.lower()}_"
        columns += [
            Column(f"{prefix}paper", name, "verdict", meaning=INDICATORS[name], optional=True),
            Column(
                f"{prefix}robust",
                f"{name} rob.",
                "verdict",
                meaning=f"{name} by robust tests",
                optional=True,
            ),
            Column(f"{prefix}differ", "", meaning="where the two rules disagree", optional=True),
        ]
    columns += [
        Column(
            "score_paper",
            "S",
            meaning="indicators that hold by the paper's rule, of those that it can judge",
            optional=True,
        ),
        Column(
            "score_robust",
            "S rob.",
            meaning="indicators that hold by the robust rule, of those that it can judge",
            optional=True,
        ),
        Column(
            "ceiling_paper",
            "humans I1-I4 (%)",
            "percent",
            0,
            "share of resampled human data sets of this size that pass I1 to I4, paper's rule",
        ),
        Column("ceiling_robust", "humans, rob. (%)", "percent", 0, "the same by the robust rule"),
    ]
    return Table(
        "ablation-qualitative",
        columns,
        [_qualitative_row(study, group) for group in study.groups],
        (
            RULES,
            *(f"{name}: {text}" for name, text in INDICATORS.items()),
            *ceiling_notes(),
            *intermittency_notes(study),
            *sample_notes(study, study.groups),
        ),
    )


def ablation_quantitative(study: Study) -> Table:
    """Table VII: collisions, gap, RMSE and joint rate of every driver and prompt variant."""
    metrics = shown_in("tables")
    return Table(
        "ablation-quantitative",
        [*KEYS, *(column for metric in metrics for column in _metric_columns(metric))],
        [_quantitative_row(group) for group in study.groups],
        (
            f"{_denominators(metrics)}; intervals: {intervals_of(metrics)}",
            RULES_NOTE,
            *sample_notes(study, study.groups),
        ),
    )


def _metric_columns(metric: Metric) -> tuple[Column, Column]:
    digits, counts = metric.decimals, metric.column if metric.rate else ""
    return (
        Column(metric.name, metric.heading, metric.kind, digits, metric.meaning, counts),
        Column(f"{metric.name}_ci", "95 % CI", "interval", digits, optional=True),
    )


def _denominators(metrics: list[Metric]) -> str:
    """Which trials count for which metrics: ``collisions over all ended trials; gap over ...``."""
    ended, finished = (
        listed([metric.label for metric in metrics if metric.trials == trials])
        for trials in ("ended", "finished")
    )
    return f"{ended} over all ended trials; {finished} over finished ones"


def _qualitative_row(study: Study, group: Group) -> Row:
    found = score(study, group)
    values: dict[str, Value] = {"n": len(group.ended_outcomes)}
    for name in INDICATORS:
        values |= verdict_values(found, name, f"{name.lower()}_")
    values |= {
        "score_paper": score_text(found.paper),
        "score_robust": score_text(found.robust),
    }
    # A ceiling is for one data set of one size; indicators of different trials have no common size.
    remarks = [verdict_note(found, *INDICATORS), score_note(found)]
    if of_both := outcomes_note(group):
        remarks += [of_both, "no ceiling: the indicators rest on different trials"]
    else:
        values |= ceiling_values(found, "I1-I4")
    remarks.append(no_ceiling(group))
    return row_of(group, values, *remarks, counts=ENDED)


def _quantitative_row(group: Group) -> Row:
    metrics = shown_in("tables")
    values: dict[str, Value] = {"n": len(group.ended_outcomes)}
    missing, absent = [], []
    # Metrics from the same source share one note.
    shipped: dict[str, list[Metric]] = {}
    for metric in metrics:
        found = estimate_or_reference(group, metric)
        if found is None:
            absent.append(no_human_value(metric))
            continue
        values[metric.name] = found.value
        # A published value may come without an interval.
        if (interval := found.bounds()) is not None:
            values[f"{metric.name}_ci"] = interval
        if isinstance(found, HumanReference):
            shipped.setdefault(found.source, []).append(metric)
        elif found.bounds() is None and found.value is None:
            missing.append(metric.heading)
    remarks = [
        outcomes_note(group),
        *(undecided_note(group, metric) for metric in metrics),
        *absent,
    ]
    if missing:
        remarks.append(f"no trial with {', '.join(missing)}")
    remarks += [_shipped_note(found, source) for source, found in shipped.items()]
    return row_of(group, values, *remarks, counts=ENDED)


def _shipped_note(metrics: list[Metric], source: str) -> str:
    names = listed([metric.label for metric in metrics])
    what = "is a published value" if len(metrics) == 1 else "are published values"
    return f"{names} {what}, no human traces are imported ({source})"
