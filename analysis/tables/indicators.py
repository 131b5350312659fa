"""Table V: qualitative and quantitative indicators beside the human ceiling."""

from __future__ import annotations

from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.metrics import RULES_NOTE, HumanReference, Metric, shown_in
from merge_runner_analysis.stats.group_scores import Score, score, total, unjudged
from merge_runner_analysis.stats.indicators import (
    INDICATORS,
    TESTED,
    Verdict,
    disagree,
)
from merge_runner_analysis.stats.likeness import gains, held, less_humans, mean_gain
from merge_runner_analysis.stats.measures import (
    estimate_or_reference,
    no_human_value,
    outcomes_note,
    undecided_note,
)
from merge_runner_analysis.stats.regressions import GAP_MARGIN_M
from merge_runner_analysis.tables.model import Column, Row, Table, Value, row_of
from merge_runner_analysis.tables.notes import (
    ceiling_notes,
    intermittency_notes,
    no_ceiling,
    sample_notes,
)
from merge_runner_analysis.tables.profiles import gain_values

# The indicators that rest on who merged first.
OF_OUTCOMES = ("I1", "I2")
BESIDE_I5 = {"held": "I5 held (%)", "clock": "I5 at 1 Hz", "humans": "I5 - humans (SD)"}
RULES = (
    "✓ by the paper's rule: signs and p < .05 of Wald tests; robust: likelihood-ratio tests of "
    "Firth's fit (I1, I2), HC3 errors (I3), gaps that relative velocity alone moves by less than "
    f"{GAP_MARGIN_M:g} m (I4), gains above 0 (I5, which the paper judged by eye)"
)


def indicators(study: Study) -> Table:
    """Table V: I1 to I5 and the quantitative measures, each with a row per driver."""
    rows = []
    for name in INDICATORS:
        rows += [_verdict_row(study, group, name) for group in study.baselines]
    beside = [_beside_i5(study, group) for group in study.baselines if group.measured]
    rows += [found[name] for name in BESIDE_I5 for found in beside if name in found]
    rows += [_total_row(study, group) for group in study.baselines]
    for metric in shown_in("tables"):
        rows += [_metric_row(group, metric) for group in study.baselines]
    return Table(
        "indicators",
        (
            Column("indicator", "indicator"),
            Column("driver", "driver"),
            Column(
                "paper", "paper's rule", "verdict", meaning="by the paper's rule", optional=True
            ),
            Column("robust", "robust", "verdict", meaning="by robust tests", optional=True),
            Column("differ", "", meaning="where the two rules disagree", optional=True),
            Column("value", "value", "number", 2, "mean gain (I5) or measure", optional=True),
            Column(
                "interval", "95 % CI", "interval", 2, "Wilson for rates, t for means", optional=True
            ),
            Column(
                "ceiling_paper",
                "humans pass (%)",
                "percent",
                0,
                "share of resampled human data sets of this size that pass the paper's rule",
                optional=True,
            ),
            Column(
                "ceiling_robust",
                "humans, robust (%)",
                "percent",
                0,
                "share of resampled human data sets of this size that pass the robust rule",
                optional=True,
            ),
            Column("n", "n", "count", 0, "trials", optional=True),
        ),
        rows,
        (
            RULES,
            *(f"{name}: {text}" for name, text in INDICATORS.items()),
            RULES_NOTE,
            *ceiling_notes(),
            *intermittency_notes(study),
            *sample_notes(study, study.baselines),
        ),
    )


def verdict_values(found: Score, name: str, prefix: str = "") -> dict[str, Value]:
    """An indicator by both rules, and whether they disagree."""
    paper, robust = found.paper[name], found.robust[name]
    return {
        f"{prefix}paper": paper.passed,
        f"{prefix}robust": robust.passed,
        f"{prefix}differ": "≠" if disagree(paper, robust) else None,
    }


def ceiling_values(found: Score, name: str) -> dict[str, Value]:
    """Which percentages of human data sets pass an indicator, or ``I1-I4`` together, by rule."""
    return {
        f"ceiling_{rule}": 100 * shares[name] if name in shares else None
        for rule, shares in found.ceiling.items()
    }


def verdict_note(found: Score, *names: str) -> str:
    """Why a verdict is missing, or what it rests on if not on a test."""
    known: dict[str, dict[str, None]] = {}
    for name in names:
        for judged in found.rules.values():
            verdict = judged[name]
            if verdict.why and verdict.passed is not None:
                known.setdefault(verdict.why, {})[name] = None
    return "; ".join(
        [
            *(f"{', '.join(which)} {why}" for why, which in known.items()),
            *(
                f"{', '.join(which)} cannot be judged {' or '.join(rules)}: {why}"
                for why, (which, rules) in unjudged(found, *names).items()
            ),
        ]
    )


def score_text(judged: dict[str, Verdict]) -> str | None:
    """``3 of 4``, or None where no indicator can be judged."""
    found = total(judged)
    return str(found) if found.judged else None


def score_note(found: Score) -> str:
    """Which indicators a score leaves out of both its numbers, by rule.

    But for those that a rule never judges, whatever is driven.
    """
    rules: dict[tuple[str, ...], list[str]] = {}
    for rule, judged in found.rules.items():
        if left_out := tuple(name for name in total(judged).open if judged[name].why):
            rules.setdefault(left_out, []).append(rule)
    return "; ".join(
        f"the score {' and '.join(which)} leaves out {', '.join(left_out)}"
        for left_out, which in rules.items()
    )


def _verdict_row(study: Study, group: Group, name: str) -> Row:
    found = score(study, group)
    of_outcomes = name in OF_OUTCOMES
    trials = group.outcomes if of_outcomes else group.trials
    # A ceiling is drawn for as many trials as there are outcomes. It does not fit indicators of the
    # gap or the speeds where only some of these trials have traces.
    drawn = of_outcomes or not outcomes_note(group)
    remarks = (
        verdict_note(found, name),
        _inaction(study, group, name),
        outcomes_note(group),
        # I5 compares with human traces directly and has no ceiling.
        no_ceiling(group) if name in TESTED else "",
    )
    return row_of(
        group,
        {
            "indicator": name,
            **verdict_values(found, name),
            **(gain_values(study, group, "value", "interval") if name == "I5" else {}),
            **(ceiling_values(found, name) if drawn else {}),
            "n": int((trials["status"] == "finished").sum()),
        },
        *remarks,
        item=name,
    )


def _beside_i5(study: Study, group: Group) -> dict[str, Row]:
    """The numbers beside the gain of I5, by name; none of them decides."""
    share, clock = held(study, group), mean_gain(study, group, "clocked_gain")
    if share.value is None or share.low is None or share.high is None:
        return {}
    numbers: dict[str, tuple[Value, Value]] = {
        "held": (100 * share.value, (100 * share.low, 100 * share.high)),
        "clock": (clock.value, clock.bounds()),
    }
    if found := less_humans(study, group):
        numbers["humans"] = (found.value, found.bounds())
    return {
        name: row_of(
            group,
            {
                "indicator": BESIDE_I5[name],
                "value": value,
                "interval": bounds,
                "n": len(group.finished),
            },
            _inaction(study, group, "I5"),
            item=f"I5-{name}",
        )
        for name, (value, bounds) in numbers.items()
    }


def _inaction(study: Study, group: Group, name: str) -> str:
    """How many trials do not count for I5."""
    still = int(gains(study, group)["steady"].sum()) if name == "I5" and group.measured else 0
    return f"I5 without {still} of {len(group.finished)} trials: no control action" * bool(still)


def _total_row(study: Study, group: Group) -> Row:
    found = score(study, group)
    of_both = outcomes_note(group)
    return row_of(
        group,
        {
            "indicator": "Score",
            "paper": score_text(found.paper),
            "robust": score_text(found.robust),
            # No single ceiling fits a score whose indicators rest on different trials.
            **({} if of_both else ceiling_values(found, "I1-I4")),
            "n": len(group.finished),
        },
        score_note(found),
        of_both,
        no_ceiling(group),
        item="score",
    )


def _metric_row(group: Group, metric: Metric) -> Row:
    item = metric.name
    values: dict[str, Value] = {"indicator": metric.heading}
    found = estimate_or_reference(group, metric)
    if found is None:
        return row_of(group, values, no_human_value(metric), item=item)
    values |= {"value": found.value, "interval": found.bounds()}
    if isinstance(found, HumanReference):
        source = f"published value, no human traces are imported ({found.source})"
        return row_of(group, values, source, item=item)
    return row_of(
        group,
        values | {"n": found.n},
        "" if found.n or found.bounds() else f"{metric.heading}: no trial has it",
        undecided_note(group, metric),
        outcomes_note(group),
        item=item,
        counts=metric.counts,
    )
