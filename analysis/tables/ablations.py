"""Tables VI and VII: indicators and measures across the prompt variants."""

from __future__ import annotations

from analysis.data.reference_data import citation
from analysis.data.study import Group, Study
from analysis.stats.group_scores import score
from analysis.stats.indicators import INDICATORS
from analysis.stats.measures import (
    BOXES,
    COLLISIONS,
    MEASURES,
    RULES_NOTE,
    estimate,
    known,
    outcomes_note,
    published_human,
    undecided,
)
from analysis.tables.indicators import (
    BOXES_ALONE,
    RULES,
    SOURCE,
    percent,
    score_note,
    score_text,
    verdict_note,
    verdict_values,
)
from analysis.tables.model import Column, Row, Table, Value
from analysis.tables.notes import ceiling_notes, intermittency_notes, sample_notes

# Columns that rest on who merged first.
OF_OUTCOMES = tuple(
    f"{name}_{rule}" for name in ("i1", "i2") for rule in ("paper", "robust", "differ")
)


def ablation_qualitative(study: Study) -> Table:
    """Table VI: I1 to I5 of every driver and prompt variant."""
    columns = [*_key_columns()]
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
        "Alignment with qualitative indicators of human behaviour across prompt ablations",
        columns,
        [_qualitative_row(study, group) for group in study.groups],
        (
            RULES,
            *(f"{name}: {text}" for name, text in INDICATORS.items()),
            *ceiling_notes(study),
            *intermittency_notes(study),
            *sample_notes(study, study.groups),
        ),
        "Table VI",
    )


def ablation_quantitative(study: Study) -> Table:
    """Table VII: collisions, gap, RMSE and joint rate of every driver and prompt variant."""
    columns = [*_key_columns()]
    for measure in MEASURES:
        columns += [
            Column(
                measure.name,
                measure.heading,
                "percent" if measure.rate else "number",
                2,
                measure.meaning,
                measure.counts,
            ),
            Column(
                f"{measure.name}_ci", "95 % CI", "interval", 2, "", measure.counts, optional=True
            ),
        ]
    return Table(
        "ablation-quantitative",
        "Quantitative measures across prompt ablations",
        columns,
        [_quantitative_row(group) for group in study.groups],
        (
            "collisions over all ended trials; gap, RMSE and joint rate over finished ones; "
            "intervals: Wilson for rates, Student's t for means",
            RULES_NOTE,
            *sample_notes(study, study.groups),
        ),
        "Table VII",
    )


def _key_columns() -> tuple[Column, ...]:
    return (
        Column("driver", "driver"),
        Column("setting", "setting"),
        Column("n", "n", "count", 0, "trials that ended", "status <> 'failed'"),
    )


def _keys(group: Group) -> dict[str, Value]:
    return {
        "driver": group.label,
        "setting": group.setting,
        "n": len(group.ended_outcomes),
    }


def _qualitative_row(study: Study, group: Group) -> Row:
    found = score(study, group)
    values = _keys(group)
    for name in INDICATORS:
        values |= verdict_values(found, name, f"{name.lower()}_")
    values |= {
        "score_paper": score_text(found.paper),
        "score_robust": score_text(found.robust),
        "ceiling_paper": percent(found.ceiling.paper["I1-I4"]),
        "ceiling_robust": percent(found.ceiling.robust["I1-I4"]),
    }
    of_both = outcomes_note(group)
    if of_both:
        values |= {"ceiling_paper": None, "ceiling_robust": None}
        of_both += "; no ceiling: the indicators rest on different trials"
    notes = filter(None, (verdict_note(found, *INDICATORS), score_note(found), of_both))
    return Row(group.id, (group.id,), values, "; ".join(notes), published=("n", *OF_OUTCOMES))


def _quantitative_row(group: Group) -> Row:
    values, missing, shipped = _keys(group), [], []
    remarks = [outcomes_note(group), *(undecided(group, measure) for measure in MEASURES)]
    for measure in MEASURES:
        if measure is COLLISIONS and not known(group, measure):
            remarks.append(BOXES_ALONE)
            continue
        if not known(group, measure):
            values[measure.name] = published_human(measure)
            shipped.append(measure.name)
            continue
        found = estimate(group, measure)
        values[measure.name] = found.value
        if (interval := found.bounds()) is not None:
            values[f"{measure.name}_ci"] = interval
        if found.value is None:
            missing.append(measure.heading)
    if missing:
        remarks.append(f"no trial with {', '.join(missing)}")
    if shipped:
        remarks.append(
            "gap, RMSE and joint rate are published values, no human traces are imported "
            f"({citation(SOURCE)})"
        )
    return Row(
        group.id,
        (group.id,),
        values,
        "; ".join(filter(None, remarks)),
        printed=tuple(shipped),
        published=("n", BOXES.name, f"{BOXES.name}_ci"),
    )
