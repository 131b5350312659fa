"""Table V: qualitative and quantitative indicators beside the human ceiling."""

from __future__ import annotations

from analysis.data.study import Group, Study
from analysis.metrics import RULES_NOTE, HumanReference, Metric, shown_in
from analysis.stats.group_scores import PAPER_RULE, ROBUST_RULE, Score, score, total, unjudged
from analysis.stats.indicators import INDICATORS, TESTED, Verdict
from analysis.stats.likeness import gains
from analysis.stats.measures import (
    estimate_or_reference,
    no_human_value,
    outcomes_note,
    undecided,
)
from analysis.tables.model import Column, Row, Table, Value
from analysis.tables.notes import ceiling_notes, intermittency_notes, no_ceiling, sample_notes
from analysis.tables.profiles import gain_values

# The indicators that rest on who merged first, and all columns of their rows.
OF_OUTCOMES = ("I1", "I2")
EVERY = ("paper", "robust", "differ", "value", "interval", "n")
RULES = (
    "✓ by the paper's rule: signs and p < .05 of Wald tests; robust: likelihood-ratio tests of "
    "Firth's fit (I1, I2), HC3 errors (I3), equivalence (I4)"
)


def indicators(study: Study) -> Table:
    """Table V: I1 to I5 and the quantitative measures, one row a driver."""
    rows = []
    for name in INDICATORS:
        rows += [_verdict_row(study, group, name) for group in study.baselines]
    rows += [_total_row(study, group) for group in study.baselines]
    for metric in shown_in("tables"):
        rows += [_metric_row(group, metric) for group in study.baselines]
    return Table(
        "indicators",
        "Qualitative and quantitative indicators of behaviour during merging conflicts",
        (
            Column("indicator", "indicator"),
            Column("driver", "driver"),
            Column(
                "paper", "paper's rule", "verdict", meaning="by the paper's rule", optional=True
            ),
            Column("robust", "robust", "verdict", meaning="by robust tests", optional=True),
            Column("differ", "", meaning="where the two rules disagree", optional=True),
            Column("value", "value", "number", 2, "gain (I5) or measure", optional=True),
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
            *ceiling_notes(study),
            *intermittency_notes(study),
            *sample_notes(study, study.baselines),
        ),
        "Table V",
    )


def verdict_values(found: Score, name: str, prefix: str = "") -> dict[str, Value]:
    """An indicator by both rules, and whether they disagree."""
    paper, robust = found.paper[name].passed, found.robust[name].passed
    disagree = None not in {paper, robust} and paper != robust
    return {
        f"{prefix}paper": paper,
        f"{prefix}robust": robust,
        f"{prefix}differ": "≠" if disagree else None,
    }


def verdict_note(found: Score, *names: str) -> str:
    """Why a verdict is missing or rests on something else than a test."""
    known: dict[str, dict[str, None]] = {}
    for name in names:
        for verdict in (found.paper[name], found.robust[name]):
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


def score_text(verdicts: dict[str, Verdict]) -> str | None:
    """``3 of 4``, or None where no indicator can be judged."""
    found = total(verdicts)
    return str(found) if found.judged else None


def score_note(found: Score) -> str:
    """Which indicators are in neither number of a score, and of which."""
    rules: dict[tuple[str, ...], list[str]] = {}
    for rule, verdicts in ((PAPER_RULE, found.paper), (ROBUST_RULE, found.robust)):
        if left_out := total(verdicts).open:
            rules.setdefault(left_out, []).append(rule)
    return "; ".join(
        f"the score {' and '.join(which)} leaves out {', '.join(left_out)}"
        for left_out, which in rules.items()
    )


def _verdict_row(study: Study, group: Group, name: str) -> Row:
    found = score(study, group)
    of_outcomes = name in OF_OUTCOMES
    trials = group.outcomes if of_outcomes else group.trials
    # A ceiling is drawn with as many trials as there are outcomes.
    drawn = of_outcomes or not outcomes_note(group)
    remarks = (
        verdict_note(found, name),
        _inaction(study, group, name),
        outcomes_note(group),
        no_ceiling(group) if name in TESTED else "",
    )
    return Row(
        f"{group.id}/{name}",
        (group.id,),
        {
            "indicator": name,
            "driver": group.label,
            **verdict_values(found, name),
            **(gain_values(study, group, "value", "interval") if name == "I5" else {}),
            "ceiling_paper": percent(found.ceiling.paper.get(name)) if drawn else None,
            "ceiling_robust": percent(found.ceiling.robust.get(name)) if drawn else None,
            "n": int((trials["status"] == "finished").sum()),
        },
        "; ".join(filter(None, remarks)),
        published=EVERY if of_outcomes else (),
    )


def _inaction(study: Study, group: Group, name: str) -> str:
    """Which trials do not count for I5."""
    still = int(gains(study, group)["steady"].sum()) if name == "I5" and group.measured else 0
    return f"I5 without {still} of {len(group.finished)} trials: no control action" * bool(still)


def _total_row(study: Study, group: Group) -> Row:
    found = score(study, group)
    of_both = outcomes_note(group)
    return Row(
        f"{group.id}/score",
        (group.id,),
        {
            "indicator": "Score",
            "driver": group.label,
            "paper": score_text(found.paper),
            "robust": score_text(found.robust),
            "ceiling_paper": None if of_both else percent(found.ceiling.paper.get("I1-I4")),
            "ceiling_robust": None if of_both else percent(found.ceiling.robust.get("I1-I4")),
            "n": len(group.finished),
        },
        "; ".join(filter(None, (score_note(found), of_both, no_ceiling(group)))),
    )


def _metric_row(group: Group, metric: Metric) -> Row:
    key: dict[str, Value] = {"indicator": metric.heading, "driver": group.label}
    row = f"{group.id}/{metric.name}"
    found = estimate_or_reference(group, metric)
    if found is None:
        return Row(row, (group.id,), key, no_human_value(metric))
    values: dict[str, Value] = {**key, "value": found.value, "interval": found.bounds()}
    if isinstance(found, HumanReference):
        source = f"published value, no human traces are imported ({found.source})"
        return Row(row, (group.id,), values, source, printed=("value",))
    remarks = (
        "" if found.value is not None else f"{metric.heading}: no trial has it",
        undecided(group, metric),
        outcomes_note(group),
    )
    return Row(
        row,
        (group.id,),
        {**values, "n": found.n},
        "; ".join(filter(None, remarks)),
        metric.counts,
        published=EVERY if metric.humans_from == "outcomes" else (),
    )


def percent(share: float | None) -> float | None:
    """A share in percent."""
    return None if share is None else 100 * share
