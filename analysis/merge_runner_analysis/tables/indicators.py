"""Table V: indicators of human behaviour beside the human ceiling, and metrics."""

from __future__ import annotations

from merge_runner_analysis.grouping import Group
from merge_runner_analysis.metrics import RULES_NOTE, Metric, shown_in
from merge_runner_analysis.published import HUMAN_GAP_SD_M
from merge_runner_analysis.stats.indicators import Score, disagree, gains, mean_gain, score, total
from merge_runner_analysis.stats.measures import outcomes_note
from merge_runner_analysis.stats.regressions import GAP_MARGIN_M
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables.ablation_quantitative import measured
from merge_runner_analysis.tables.model import (
    FINISHED,
    Column,
    Optional,
    Row,
    Table,
    Value,
    interval,
    row_of,
)
from merge_runner_analysis.wording import INDICATORS

# The indicators that rest on who merged first.
OF_OUTCOMES = ("I1", "I2")
SCORE = "Score"
RULES = ("by the paper's test", "by the robust tests")
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


def indicators(study: StudyResults) -> Table:
    """Return Table V: I1 to I5 and the quantitative measures, each with a row per driver."""
    groups = study.baselines
    return Table(
        "indicators",
        (
            Column("indicator", "indicator"),
            Column("driver", "driver"),
            Optional("paper", "paper's rule", "verdict", meaning="by the paper's rule"),
            Optional("robust", "robust", "verdict", meaning="by robust tests"),
            Optional("differ", "", meaning="where the two rules disagree"),
            Optional("value", "value", "number", "mean gain (I5) or measure"),
            interval("interval", "Wilson for rates, t for means"),
            *ceiling_columns("humans pass (%)", "humans, robust (%)"),
            Optional("n", "n", "count", "trials"),
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


def ceiling_columns(paper: str, robust: str) -> list[Column]:
    """Return the columns of how often human data sets pass, by both rules."""
    return [
        Optional("ceiling_paper", paper, "percent", f"{RESAMPLED} by the paper's rule", digits=0),
        Optional("ceiling_robust", robust, "percent", f"{RESAMPLED} by the robust rule", digits=0),
    ]


def _verdict_row(study: StudyResults, group: Group, name: str) -> Row:
    judged = score(study, group)
    trials = group.outcomes if name in OF_OUTCOMES else group.trials
    values: dict[str, Value] = {
        "indicator": name,
        **verdict_values(judged, name),
        **ceiling_values(group, judged, name),
        "n": int((trials["status"] == "finished").sum()),
    }
    remarks: list[object] = [reasons(judged, name)]
    # I5 compares with human traces directly and has no ceiling.
    if name != "I5":
        remarks.append(no_ceiling(group))
    elif group.measured:
        gain, still = mean_gain(study, group), int(gains(study, group)["steady"].sum())
        values |= {"value": gain.value, "interval": gain.bounds()}
        of = f"{still} of {len(group.finished)} trials"
        remarks.append(f"I5 without {of}: no control action" if still else "")
    item = name.lower() if name == SCORE else name
    return row_of(group, values, *remarks, outcomes_note(group), item=item)


def _metric_row(group: Group, metric: Metric) -> Row:
    estimates, remarks = measured(group, [metric])
    values: dict[str, Value] = {"indicator": metric.heading}
    rests_on = FINISHED
    if estimate := estimates.get(metric.name):
        values |= {"value": estimate.value, "interval": estimate.bounds()}
        if not estimate.source:
            values["n"], rests_on = estimate.n, metric.column
    return row_of(group, values, *remarks, item=metric.name, rests_on=rests_on)


def verdict_values(judged: Score, name: str, prefix: str = "") -> dict[str, Value]:
    """Return an indicator by both rules, and whether they disagree; or the score by both."""
    if name == SCORE:
        return {f"{prefix}paper": total(judged.paper), f"{prefix}robust": total(judged.robust)}
    paper, robust = judged.paper[name], judged.robust[name]
    return {
        f"{prefix}paper": paper.passed,
        f"{prefix}robust": robust.passed,
        f"{prefix}differ": "≠" if disagree(paper, robust) else None,
    }


def ceiling_values(group: Group, judged: Score, name: str) -> dict[str, Value]:
    """Return by rule which percentages of human data sets pass an indicator, or I1 to I4."""
    # A ceiling is for as many trials as there are outcomes. It does not fit indicators of the gap
    # or the speeds where only some of these trials have traces.
    if name not in OF_OUTCOMES and outcomes_note(group):
        return {}
    key = "I1-I4" if name == SCORE else name
    shares = judged.ceiling.items()
    return {f"ceiling_{rule}": 100 * share[key] for rule, share in shares if key in share}


def reasons(judged: Score, *names: str) -> str:
    """Return why verdicts are missing, or what they rest on if not on a test."""
    which: dict[str, list[str]] = {}
    for rule, judgements in zip(RULES, (judged.paper, judged.robust), strict=True):
        for name in names:
            if name in judgements and judgements[name].why:
                which.setdefault(f"{rule}: {judgements[name].why}", []).append(name)
    return "; ".join(f"{', '.join(names)} {why}" for why, names in which.items())


def no_ceiling(group: Group) -> str:
    """Return why a group has no ceiling; empty where it has one."""
    return "" if min(group.sizes) else "not all conditions of the humans were played: no ceiling"
