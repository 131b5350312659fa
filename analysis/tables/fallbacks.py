"""Outcomes with and without trials that had a fallback, to see whether failures bias them."""

from __future__ import annotations

from analysis.data.study import Group, Study, of_group
from analysis.metrics import GAP, LEFT_FIRST, RULES_NOTE, Metric, intervals_of, shown_in
from analysis.stats.group_scores import Fits, fits
from analysis.stats.indicators import INDICATORS, PAPER, ROBUST, TESTED, Verdict, disagree, verdicts
from analysis.stats.intervals import Estimate
from analysis.stats.measures import estimate, undecided_note, values
from analysis.tables.attempts import FALLBACK
from analysis.tables.indicators import RULES
from analysis.tables.model import GROUP_COLUMNS, Column, Row, Table, Value, row_of
from analysis.tables.notes import sample_notes

# The metric that each indicator's regression is fitted to.
FITTED = {"I1": LEFT_FIRST, "I2": LEFT_FIRST, "I3": GAP, "I4": GAP}
# The two sides of the comparison: name, suffix of the columns, predicate for the trials.
ALL = ("all", "", "")
WITHOUT = ("without", "_without", f"NOT {FALLBACK}")


def fallbacks(study: Study) -> Table:
    """A row per group and measure or indicator: over all trials, and without fallbacks."""
    rows = [row for group in study.models for row in _rows(study, group)]
    judged = "judged " if study.unjudged else ""
    return Table(
        "fallbacks",
        "Outcomes with and without the trials that had a fallback",
        (
            *GROUP_COLUMNS,
            Column("measure", "measure"),
            *_numbers(*ALL),
            *_numbers(*WITHOUT),
            Column("difference", "difference", "number", 2, "without minus all", optional=True),
            _verdict("paper", "paper's rule", *ALL),
            _verdict("paper", "paper's rule", *WITHOUT),
            _verdict("robust", "robust", *ALL),
            _verdict("robust", "robust", *WITHOUT),
            Column("differ", "", meaning="where a verdict changes", optional=True),
        ),
        rows,
        (
            "all: every trial; without: those in which every decision was driven from its own "
            f"answer. Intervals: {intervals_of(shown_in('fallbacks'))}. Where the two are far "
            "apart, failed answers bias the result",
            RULES_NOTE,
            RULES,
            *(f"{name}: {INDICATORS[name]}" for name in TESTED),
            *([] if rows else [f"there is no trial of a {judged}driver to compare"]),
            *sample_notes(study, study.models),
        ),
    )


def _numbers(name: str, suffix: str, within: str) -> tuple[Column, ...]:
    return (
        Column(f"n{suffix}", f"n {name}", "count", 0, f"trials that count, {name}", within=within),
        Column(name, name, "number", 2, f"the measure, {name}", optional=True, within=within),
        Column(
            f"ci{suffix}",
            "95 % CI",
            "interval",
            2,
            f"Wilson or t, {name}",
            optional=True,
            within=within,
        ),
    )


def _verdict(rule: str, heading: str, name: str, suffix: str, within: str) -> Column:
    return Column(
        f"{rule}{suffix}",
        f"{heading}, {name}",
        "verdict",
        meaning=f"whether the indicator holds, {heading}, {name}",
        optional=True,
        within=within,
    )


def _rows(study: Study, group: Group) -> list[Row]:
    clean = without_fallbacks(study, group)
    why = _why(group, clean)
    return [
        *(_metric_row(group, clean, metric, why) for metric in shown_in("fallbacks")),
        *(_verdict_row(group, clean, name, why) for name in TESTED),
    ]


def without_fallbacks(study: Study, group: Group) -> Group:
    """The group without its trials that had a fallback; the same object where none had."""
    own = of_group(study.calls.decisions, group, group.trials)
    had = set(own.loc[own["fallback"], "trial_id"])
    # The same object, because fits are cached by group and ``_why`` compares by identity.
    if not had:
        return group
    return group.part(lambda trials: ~trials["trial_id"].isin(had))


def _why(group: Group, clean: Group) -> str:
    """Why there is nothing to compare, where that is so."""
    if group.ended.empty:
        return "no trial ended"
    if len(clean.ended) == len(group.ended):
        whose = "no trial had" if clean is group else "no trial that ended had"
        return f"{whose} a fallback: nothing differs"
    if clean.ended.empty:
        return "every trial had a fallback: nothing is left without"
    return ""


def _metric_row(group: Group, clean: Group, metric: Metric, why: str) -> Row:
    found, without = estimate(group, metric), estimate(clean, metric)
    cells: dict[str, Value] = {
        "measure": metric.heading,
        **_estimated(found, "all", ""),
        **_estimated(without, "without", "_without"),
    }
    if found.value is not None and without.value is not None:
        # No test: the two sides share trials, so they are not independent samples.
        cells["difference"] = without.value - found.value
    # A side that is empty because of ``why`` needs no second explanation.
    missing = found.bounds() is None or (without.bounds() is None and not why)
    nothing = f"{metric.heading}: no trial with this measure" if missing else ""
    remarks = (why, nothing, undecided_note(group, metric))
    return row_of(group, cells, *remarks, item=metric.name, counts=metric.counts)


def _estimated(found: Estimate, name: str, suffix: str) -> dict[str, Value]:
    return {f"n{suffix}": found.n, name: found.value, f"ci{suffix}": found.bounds()}


def _verdict_row(group: Group, clean: Group, name: str, why: str) -> Row:
    found, without = _judged(fits(group), name), _judged(fits(clean), name)
    changed = any(disagree(*pair) for pair in zip(found, without, strict=True))
    # Where nothing differs or nothing is left, ``why`` already explains the second side.
    sides = (("", found), *(() if why else ((" without", without),)))
    reasons = dict.fromkeys(
        f"{name}{side}: {verdict.why}" for side, both in sides for verdict in both if verdict.why
    )
    cells: dict[str, Value] = {
        "measure": name,
        "n": len(values(group, FITTED[name])),
        "paper": found[0].passed,
        "robust": found[1].passed,
        "n_without": len(values(clean, FITTED[name])),
        "paper_without": without[0].passed,
        "robust_without": without[1].passed,
        "differ": "≠" if changed else None,
    }
    return row_of(group, cells, why, *reasons, item=name, counts=FITTED[name].counts)


def _judged(found: Fits, name: str) -> tuple[Verdict, Verdict]:
    """An indicator by the paper's rule and by the robust one."""
    return (
        verdicts(PAPER, found.logit, found.ols)[name],
        verdicts(ROBUST, found.firth, found.hc3)[name],
    )
