"""Tables V and VI: indicators of human behaviour beside the human ceiling; the numbers of I5."""

from __future__ import annotations

from merge_runner_analysis.data.intermittency import RANDOM_GAIN, STEADY_MPS
from merge_runner_analysis.data.reference_data import HUMAN_GAP_SD_M
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.metrics import RULES_NOTE, Metric, shown_in
from merge_runner_analysis.stats.indicators import (
    INDICATORS,
    NO_ACTION,
    TESTED,
    Score,
    disagree,
    gains,
    held,
    less_humans,
    mean_gain,
    score,
    total,
)
from merge_runner_analysis.stats.intervals import Estimate
from merge_runner_analysis.stats.measures import outcomes_note
from merge_runner_analysis.stats.regressions import GAP_MARGIN_M
from merge_runner_analysis.tables.measures import measured
from merge_runner_analysis.tables.model import (
    ENDED,
    FINISHED,
    GROUP_COLUMNS,
    Column,
    Optional,
    Row,
    Table,
    Value,
    interval,
    row_of,
)

# The indicators that rest on who merged first.
OF_OUTCOMES = ("I1", "I2")
CEILING = (
    "humans pass: share of 1000 human data sets with as many trials in each condition as the row "
    "has on average; outcomes from the published counts, gaps from the published regression with "
    f"residuals of SD {HUMAN_GAP_SD_M} m; at the score: I1 to I4 together. So often a perfect copy "
    "of the humans passes"
)
GAIN = (
    "I5: piecewise-constant acceleration, by the gain of straight lines over cubics in the speeds "
    "under control, BIC per sample at 5 Hz; above 0 accelerations are held and jump, below 0 they "
    "move. Robust: the 95 % interval of the mean gain lies above 0. Vehicles that took no action "
    "do not count"
)
RESAMPLED = "share of resampled human data sets of this size that pass"
NOTES = (
    "✓ by the paper's rule: signs and p < .05 of Wald tests; robust: likelihood-ratio tests of "
    "Firth's fit (I1, I2), HC3 errors (I3), gaps that relative velocity alone moves by less than "
    f"{GAP_MARGIN_M:g} m (I4), gains above 0 (I5, which the paper judged by eye)",
    *(f"{name}: {text}" for name, text in INDICATORS.items()),
    CEILING,
    GAIN,
)


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
            Optional(
                "ceiling_paper", "humans pass (%)", "percent", 0, f"{RESAMPLED} the paper's rule"
            ),
            Optional(
                "ceiling_robust", "humans, robust (%)", "percent", 0, f"{RESAMPLED} the robust rule"
            ),
            Optional("n", "n", "count", 0, "trials"),
        ),
        [
            *(_verdict_row(study, group, name) for name in INDICATORS for group in groups),
            *(_total_row(study, group) for group in groups),
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
        Column(
            "ceiling_paper",
            "humans I1-I4 (%)",
            "percent",
            0,
            f"{RESAMPLED} I1 to I4 by the paper's rule",
        ),
        Column("ceiling_robust", "humans, rob. (%)", "percent", 0, "the same by the robust rule"),
    ]
    rows = [_group_row(study, group) for group in study.groups]
    return Table("ablation-qualitative", columns, rows, NOTES)


def _group_row(study: Study, group: Group) -> Row:
    found = score(study, group)
    values: dict[str, Value] = {"n": len(group.ended_outcomes)}
    for name in INDICATORS:
        values |= _verdicts(found, name, f"{name.lower()}_")
    values |= {"score_paper": total(found.paper), "score_robust": total(found.robust)}
    # A ceiling is for one data set of one size; indicators of different trials have no common size.
    remarks = [_verdict_note(found, *INDICATORS), no_ceiling(group)]
    if of_both := outcomes_note(group):
        remarks += [of_both, "no ceiling: the indicators rest on different trials"]
    else:
        values |= _ceilings(found, "I1-I4")
    return row_of(group, values, *remarks, counts=ENDED)


def _verdict_row(study: Study, group: Group, name: str) -> Row:
    found = score(study, group)
    of_outcomes = name in OF_OUTCOMES
    trials = group.outcomes if of_outcomes else group.trials
    values: dict[str, Value] = {"indicator": name, **_verdicts(found, name)}
    # A ceiling is drawn for as many trials as there are outcomes. It does not fit indicators of the
    # gap or the speeds where only some of these trials have traces.
    if of_outcomes or not outcomes_note(group):
        values |= _ceilings(found, name)
    # I5 compares with human traces directly and has no ceiling.
    remarks = [_verdict_note(found, name), no_ceiling(group) if name in TESTED else ""]
    if name == "I5" and group.measured:
        gain, still = mean_gain(study, group), int(gains(study, group)["steady"].sum())
        values |= {"value": gain.value, "interval": gain.bounds()}
        if still:
            of = f"{still} of {len(group.finished)} trials"
            remarks.append(f"I5 without {of}: no control action")
    values["n"] = int((trials["status"] == "finished").sum())
    return row_of(group, values, *remarks, outcomes_note(group), item=name)


def _total_row(study: Study, group: Group) -> Row:
    found, of_both = score(study, group), outcomes_note(group)
    values: dict[str, Value] = {
        "indicator": "Score",
        "paper": total(found.paper),
        "robust": total(found.robust),
        "n": len(group.finished),
    }
    if not of_both:  # no single ceiling fits a score whose indicators rest on different trials
        values |= _ceilings(found, "I1-I4")
    return row_of(group, values, of_both, no_ceiling(group), item="score")


def _metric_row(group: Group, metric: Metric) -> Row:
    found, remarks = measured(group, [metric])
    values: dict[str, Value] = {"indicator": metric.heading}
    of_trials = False
    if one := found.get(metric.name):
        of_trials = isinstance(one, Estimate)
        n = one.n if isinstance(one, Estimate) else None
        values |= {"value": one.value, "interval": one.bounds(), "n": n}
    counts = metric.counts if of_trials else FINISHED
    return row_of(group, values, *remarks, item=metric.name, counts=counts)


def _verdicts(found: Score, name: str, prefix: str = "") -> dict[str, Value]:
    """An indicator by both rules, and whether they disagree."""
    paper, robust = found.paper[name], found.robust[name]
    return {
        f"{prefix}paper": paper.passed,
        f"{prefix}robust": robust.passed,
        f"{prefix}differ": "≠" if disagree(paper, robust) else None,
    }


def _ceilings(found: Score, name: str) -> dict[str, Value]:
    """Which percentages of human data sets pass an indicator, or ``I1-I4`` together, by rule."""
    return {
        f"ceiling_{rule}": 100 * shares[name]
        for rule, shares in found.ceiling.items()
        if name in shares
    }


def _verdict_note(found: Score, *names: str) -> str:
    """Why a verdict is missing, or what it rests on if not on a test."""
    reasons: dict[str, list[str]] = {}
    for rule, judged in found.rules.items():
        for name in names:
            if why := judged[name].why:
                reasons.setdefault(f"{rule}: {why}", []).append(name)
    return "; ".join(f"{', '.join(which)} {why}" for why, which in reasons.items())


def no_ceiling(group: Group) -> str:
    """Why a group has no human ceiling; empty where it has one."""
    if min(group.sizes):
        return ""
    if any(group.sizes):
        return "not all conditions of the humans were played: no ceiling"
    played = len(group.ended_outcomes)
    return f"{'no human drove its conditions' if played else 'no trial ended'}: no ceiling"


def velocity_profiles(study: Study) -> Table:
    """A row per group: how far accelerations are held, compared with humans."""
    return Table(
        "velocity-profiles",
        (
            *GROUP_COLUMNS,
            Column("n", "n", "count", 0, "finished trials"),
            Column("no_action", "no action", "count", 0, "trials in which no vehicle acted"),
            Column("gain", "gain", "number", 2, "mean gain of lines over cubics (I5)"),
            interval("gain_ci", "t, of humans over pairs"),
            Column("held_percent", "held (%)", "percent", 1, "trials with a gain above 0"),
            Optional("clocked_gain", "gain at 1 Hz", "number", 2, "one acceleration a second"),
            Optional("difference_sd", "- humans (SD)", "number", 2, "within conditions"),
            interval("difference_sd_ci", "Welch, by pair"),
        ),
        [_profile_row(study, group) for group in study.groups],
        (
            f"{GAIN}: those that stay within {STEADY_MPS} m/s, with or without the simulator's "
            "resistance",
            "gain at 1 Hz: of the same speeds with one acceleration from each full second to the "
            "next, as any driver has that decides once a second and holds. Accelerations that are "
            f"drawn by chance each second have {RANDOM_GAIN}, on average over 10 s: so much the "
            "clock alone can make",
            "the difference from the humans, in human SD, is no part of I5, and needs human traces "
            "of every condition",
        ),
    )


def _profile_row(study: Study, group: Group) -> Row:
    values: dict[str, Value] = {"n": len(group.finished)}
    if not group.measured:
        return row_of(group, values, "no human traces are imported")
    gain, share = mean_gain(study, group), held(study, group)
    values |= {
        "no_action": int(gains(study, group)["steady"].sum()),
        "gain": gain.value,
        "gain_ci": gain.bounds(),
        "clocked_gain": mean_gain(study, group, "clocked_gain").value,
        "held_percent": None if share.value is None else 100 * share.value,
    }
    if found := less_humans(study, group):
        values |= {"difference_sd": found.value, "difference_sd_ci": found.bounds()}
    return row_of(group, values, "" if share.n else NO_ACTION)
