"""Tables V to VII: indicators of human behaviour beside the human ceiling, and metrics."""

from __future__ import annotations

from merge_runner.scenarios.merge.measures import NO_CONFLICT_MPS
from merge_runner_analysis.data.reference_data import HUMAN_GAP_SD_M
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.metrics import (
    INTERVALS,
    RULES_NOTE,
    Bounded,
    HumanReference,
    Metric,
    shown_in,
)
from merge_runner_analysis.stats.indicators import (
    INDICATORS,
    Score,
    disagree,
    gains,
    mean_gain,
    score,
    total,
)
from merge_runner_analysis.stats.intervals import Estimate
from merge_runner_analysis.stats.measures import (
    estimate_or_reference,
    no_human_value,
    outcomes_note,
    undecided_note,
)
from merge_runner_analysis.stats.regressions import GAP_MARGIN_M
from merge_runner_analysis.tables.model import (
    ENDED,
    FINISHED,
    GROUP_COLUMNS,
    Column,
    Kind,
    Optional,
    Row,
    Table,
    Value,
    interval,
    row_of,
)

# The indicators that rest on who merged first.
OF_OUTCOMES = ("I1", "I2")
SCORE = "Score"
RESAMPLED = "share of resampled human data sets of this size that pass"
NOTES = (
    "✓ by the paper's rule: signs and p < .05 of Wald tests; robust: likelihood-ratio tests of "
    "Firth's fit (I1, I2), HC3 errors (I3), gaps that relative velocity alone moves by less than "
    f"{GAP_MARGIN_M:g} m (I4), gains above 0 (I5, which the paper judged by eye)",
    *(f"{name}: {text}" for name, text in INDICATORS.items()),
    "humans pass: share of 1000 human data sets with as many trials in each condition as the row "
    "has on average; outcomes from the published counts, gaps from the published regression with "
    f"residuals of SD {HUMAN_GAP_SD_M} m; at the score: I1 to I4 together. So often a perfect copy "
    "of the humans passes",
    "I5: piecewise-constant acceleration, by the gain of straight lines over cubics in the speeds "
    "under control, BIC per sample at 5 Hz; above 0 accelerations are held and jump, below 0 they "
    "move. Robust: the 95 % interval of the mean gain lies above 0. Vehicles that took no action "
    "do not count",
)
NO_CEILING = "not all conditions of the humans were played: no ceiling"


def indicators(study: Study) -> Table:
    """Table V: I1 to I5 and the quantitative measures, each with a row per driver."""
    groups = study.baselines
    return Table(
        "indicators",
        (
            Column("indicator", "indicator"),
            Column("driver", "driver"),
            Optional("paper", "paper's rule", "verdict", meaning="by the paper's rule"),
            Optional("robust", "robust", "verdict", meaning="by robust tests"),
            Optional("differ", "", meaning="where the two rules disagree"),
            Optional("value", "value", "number", 2, "mean gain (I5) or measure"),
            interval("interval", "Wilson for rates, t for means"),
            *_ceiling_columns("humans pass (%)", "humans, robust (%)"),
            Optional("n", "n", "count", 0, "trials"),
        ),
        [
            *(
                _verdict_row(study, group, name)
                for name in (*INDICATORS, SCORE)
                for group in groups
            ),
            *(_metric_row(group, metric) for metric in shown_in("tables") for group in groups),
        ],
        (*NOTES, RULES_NOTE),
    )


def ablation_qualitative(study: Study) -> Table:
    """Table VI: I1 to I5 of every driver and prompt."""
    columns = [*GROUP_COLUMNS, Column("n", "n", "count", 0, "trials that ended")]
    for name, text in INDICATORS.items():
        prefix = name.lower()
        columns += [
            Optional(f"{prefix}_paper", name, "verdict", meaning=text),
            Optional(f"{prefix}_robust", f"{name} rob.", "verdict", meaning="by robust tests"),
            Optional(f"{prefix}_differ", "", meaning="where the two rules disagree"),
        ]
    hold = "indicators that hold, of those that can be judged, by"
    columns += [
        Optional("score_paper", "S", meaning=f"{hold} the paper's rule"),
        Optional("score_robust", "S rob.", meaning=f"{hold} the robust rule"),
        *_ceiling_columns("humans I1-I4 (%)", "humans, rob. (%)"),
    ]
    rows = [_group_row(study, group) for group in study.groups]
    return Table("ablation-qualitative", columns, rows, NOTES)


def _ceiling_columns(paper: str, robust: str) -> list[Column]:
    return [
        Optional("ceiling_paper", paper, "percent", 0, f"{RESAMPLED} by the paper's rule"),
        Optional("ceiling_robust", robust, "percent", 0, f"{RESAMPLED} by the robust rule"),
    ]


def _group_row(study: Study, group: Group) -> Row:
    found = score(study, group)
    values: dict[str, Value] = {"n": len(group.ended_outcomes)}
    for name in INDICATORS:
        values |= _verdicts(found, name, f"{name.lower()}_")
    values |= _verdicts(found, SCORE, "score_") | _ceilings(group, found, SCORE)
    remarks = _why(found, *INDICATORS), _no_ceiling(group), outcomes_note(group)
    return row_of(group, values, *remarks, counts=ENDED)


def _verdict_row(study: Study, group: Group, name: str) -> Row:
    found = score(study, group)
    trials = group.outcomes if name in OF_OUTCOMES else group.trials
    values: dict[str, Value] = {
        "indicator": name,
        **_verdicts(found, name),
        **_ceilings(group, found, name),
        "n": int((trials["status"] == "finished").sum()),
    }
    remarks = [_why(found, name)]
    # I5 compares with human traces directly and has no ceiling.
    if name != "I5":
        remarks.append(_no_ceiling(group))
    elif group.measured:
        gain, still = mean_gain(study, group), int(gains(study, group)["steady"].sum())
        values |= {"value": gain.value, "interval": gain.bounds()}
        of = f"{still} of {len(group.finished)} trials"
        remarks.append(f"I5 without {of}: no control action" if still else "")
    item = name.lower() if name == SCORE else name
    return row_of(group, values, *remarks, outcomes_note(group), item=item)


def _metric_row(group: Group, metric: Metric) -> Row:
    found, remarks = measured(group, [metric])
    values: dict[str, Value] = {"indicator": metric.heading}
    one = found.get(metric.name)
    if one:
        values |= {"value": one.value, "interval": one.bounds()}
    if isinstance(one, Estimate):
        values["n"] = one.n
    counts = metric.counts if isinstance(one, Estimate) else FINISHED
    return row_of(group, values, *remarks, item=metric.name, counts=counts)


def _verdicts(found: Score, name: str, prefix: str = "") -> dict[str, Value]:
    """An indicator by both rules, and whether they disagree; or the score by both."""
    if name == SCORE:
        return {f"{prefix}paper": total(found.paper), f"{prefix}robust": total(found.robust)}
    paper, robust = found.paper[name], found.robust[name]
    return {
        f"{prefix}paper": paper.passed,
        f"{prefix}robust": robust.passed,
        f"{prefix}differ": "≠" if disagree(paper, robust) else None,
    }


def _ceilings(group: Group, found: Score, name: str) -> dict[str, Value]:
    """Which percentages of human data sets pass an indicator, or I1 to I4 together, by rule."""
    # A ceiling is for as many trials as there are outcomes. It does not fit indicators of the gap
    # or the speeds where only some of these trials have traces.
    if name not in OF_OUTCOMES and outcomes_note(group):
        return {}
    key = "I1-I4" if name == SCORE else name
    shares = found.ceiling.items()
    return {f"ceiling_{rule}": 100 * share[key] for rule, share in shares if key in share}


def _why(found: Score, *names: str) -> str:
    """Why a verdict is missing, or what it rests on if not on a test."""
    reasons: dict[str, list[str]] = {}
    for rule, judged in found.rules.items():
        for name in names:
            if name in judged and judged[name].why:
                reasons.setdefault(f"{rule}: {judged[name].why}", []).append(name)
    return "; ".join(f"{', '.join(which)} {why}" for why, which in reasons.items())


def _no_ceiling(group: Group) -> str:
    return "" if min(group.sizes) else NO_CEILING


def ablation_quantitative(study: Study) -> Table:
    """Table VII: collisions, gap, RMSE and joint rate of every driver and prompt."""
    ended = ", ".join(one.heading for one in shown_in("tables") if one.trials == "ended")
    trials = f"{ended}: of all trials that ended; the rest: of the finished ones"
    return _table("ablation-quantitative", study.groups, "tables", trials, RULES_NOTE)


def criticality(study: Study) -> Table:
    """Surrogate measures of safety of every group whose traces are known."""
    note = (
        "a conflict is resolved when no vehicle, at its present speed, would meet the other at the "
        "first possible contact, the merge point or the end of the track; vehicles that after the "
        f"merge never close in faster than {NO_CONFLICT_MPS} m/s are in no conflict, and have no "
        "time to collision"
    )
    ended = ", ".join(one.heading for one in shown_in("criticality") if one.trials == "ended")
    medians = (
        "medians are of finished trials that have the measure; their number stands before each"
    )
    if ended:
        medians += f". {ended}: of all trials that ended"
    return _table("criticality", study.measured, "criticality", medians, note)


def _table(name: str, groups: list[Group], place: str, *notes: str) -> Table:
    metrics = shown_in(place)
    columns = [*GROUP_COLUMNS, Column("n", "n", "count", 0, "trials that ended")]
    for one in metrics:
        kind: Kind = "percent" if one.rate else "number"
        counts = one.column if one.rate else ""
        meaning, trials = one.meaning, ""
        if one.estimator == "median":
            of, trials = f"{one.trials} trials that have the measure", one.counts
            meaning = f"median over the {of}: {meaning}"
            columns.append(Optional(f"{one.name}_n", "n", "count", 0, of, trials=trials))
        columns += [
            Column(one.name, one.heading, kind, one.decimals, meaning, counts, trials=trials),
            interval(f"{one.name}_ci", f"of {one.label}", one.decimals, trials),
        ]
    rows = []
    for group in groups:
        found, remarks = measured(group, metrics)
        values = {name: one.value for name, one in found.items()}
        intervals = {f"{name}_ci": one.bounds() for name, one in found.items()}
        sizes = {
            f"{one.name}_n": estimate.n or None
            for one in metrics
            if one.estimator == "median" and isinstance(estimate := found.get(one.name), Estimate)
        }
        cells = {"n": len(group.ended_outcomes), **sizes, **values, **intervals}
        rows.append(row_of(group, cells, *remarks, counts=ENDED))
    return Table(name, columns, rows, (f"intervals: {INTERVALS}", *notes))


def measured(group: Group, metrics: list[Metric]) -> tuple[dict[str, Bounded], list[str]]:
    """What a group comes to by each metric, and remarks on those that are published or missing."""
    found: dict[str, Bounded] = {}
    remarks = [outcomes_note(group)]
    reasons: dict[str, list[str]] = {}
    for metric in metrics:
        one = estimate_or_reference(group, metric)
        if one is None:
            remarks.append(no_human_value(metric))
            continue
        found[metric.name] = one
        if isinstance(one, HumanReference):
            why = f"published, no human traces are imported ({one.source})"
            reasons.setdefault(why, []).append(metric.heading)
        elif one.value is None and one.bounds() is None:
            reasons.setdefault("no trial has it", []).append(metric.heading)
        else:
            remarks.append(undecided_note(group, metric))
    return found, [*remarks, *(f"{', '.join(names)}: {why}" for why, names in reasons.items())]
