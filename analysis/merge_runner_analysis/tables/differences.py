"""Differences from the humans, between prompts, and between the levels of factors.

Headlines, sentences, the report and the pages read the table ``verdicts`` and nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from math import isinf

from merge_runner.records import SIDES
from merge_runner.registry import require
from merge_runner.text_safety import quoted
from merge_runner_analysis.data.driver_words import language_models
from merge_runner_analysis.data.reference_data import HUMAN_TRIALS
from merge_runner_analysis.data.study import Group, Study, levels_of
from merge_runner_analysis.metrics import INTERVALS, METRICS, RULES_NOTE, Metric, shown_in
from merge_runner_analysis.names import HUMAN
from merge_runner_analysis.stats.contrasts import (
    contrast,
    copied_of_shared,
    corrected,
    trials_by_cell,
)
from merge_runner_analysis.stats.factors import (
    Level,
    balance,
    difference_of_medians,
    levels_by_factor,
)
from merge_runner_analysis.stats.measures import estimate, undecided_note
from merge_runner_analysis.stats.verdicts import Comparison, Known, compared, of_humans
from merge_runner_analysis.tables.model import Column, Optional, Row, Table, Value, interval
from merge_runner_analysis.verdict_words import (
    HUMANS,
    LANGUAGE_MODEL,
    MEASURES,
    MOCK,
    PROGRAM,
    TABLE,
    sentences,
)

VERDICT_COLUMNS = (
    Column("driver", "driver"),
    Column("setting", "prompt"),
    Column("kind", "kind", meaning="language model, program or mock model"),
    Optional("measure", "measure"),
    Optional("n", "n", "count", 0, "trials that the estimate rests on"),
    Optional("k", "k", "count", 0, "trials that collided", "collided_boxes"),
    Optional("undecided", "undecided", "count", 0, "ended by another rule"),
    Column("estimate", "estimate", "number", 2, "in the unit of the measure"),
    Optional("ci", "CI", "interval", 2, "95 %; with a margin (I4, I5) at the level of the row"),
    Optional("human", "humans", "number", 2, "in the same conditions"),
    interval("human_ci", "of the humans"),
    Optional("difference", "difference", "number", 2, "driver minus humans"),
    Optional("difference_ci", "CI", "interval", 2, "of the difference, at the level of the row"),
    Optional("level", "level", "number", 1, "of the interval that the verdict rests on, in %"),
    Optional("p", "p", "p", 3, "of no difference; with a margin (I4, I5) of being within it"),
    Optional("p_holm", "Holm", "p", 3, "corrected over the measures of the driver"),
    Optional("detectable", "detectable", "number", 2, "smallest difference found with power .8"),
    Optional("state", "verdict", meaning="what is shown"),
    Optional("rule", "rule", meaning="how the verdict is set", noted=True),
)
WITHIN = (
    "compared within the {} that both have: rates by the weights of Mantel and Haenszel, with "
    "Fisher's exact test and the melded interval that agrees with it; means by Welch's test in a "
    "model with a level for each of them"
)
INTERACTION = " × "
FAMILY = (
    "Holm: a family is one measure over the levels of one factor, its reference apart; in "
    "`contrasts` over the prompts of one driver"
)
DIFFERENCES = (
    f"Levels are {WITHIN.format('cells')}; medians without a test. The reference is the level that "
    "stands first; a cell is a condition with one level of each other factor"
)
INTERACTIONS = (
    "an interaction (×) is the difference at that level minus the one at the first level of {by}, "
    "in the cells that all four have: of rates by Newcombe's intervals, p being the level at which "
    "they exclude 0; of means by Welch's t test"
)
NO_INTERACTION = (
    "no interaction without cells that all four have, spread within cells, or with undecided "
    "trials or the same ones at two levels"
)
SAME_TRIALS = (
    "programs play no trial at one of both levels that they do not play at the other: no test"
)


def verdicts(study: Study) -> Table:
    """Every driver and prompt that is judged, and the humans first, by every measure."""
    rows = [] if study.human not in study.groups else [*_human_rows(study)]
    for group in study.models:
        if not group.caution:
            rows += [_compared(group, _kind(study, group), one) for one in compared(study, group)]
    rows += [
        Row(group.id, (group.id,), _driver(group, _kind(study, group)), group.unjudged)
        for group in study.unjudged
    ]
    return Table(
        TABLE,
        VERDICT_COLUMNS,
        rows,
        (
            *sentences(rows),
            *(
                f"{one.name}: {one.trait}, {one.unit}; verdict: {one.rule}"
                for one in MEASURES.values()
            ),
            "shown: as in humans; weaker, stronger: shown, and the p that is corrected over the "
            "driver's measures (Holm) is below .05; unlike: not shown, and it is below .05; "
            "inconclusive: neither. The interval of the difference has the level at which Holm "
            "tests it, so that it leaves 0 out where the verdict says so",
            "collisions: by the rule of the human experiment, outlines that overlap, looked for at "
            "20 Hz; Fisher's exact test within conditions, and the melded interval that agrees "
            "with it; without p where trials are undecided. The humans' share weighs conditions as "
            "the driver's trials do, and so does their mean gap as its trials with a gap do",
            f"intervals take trials as independent. The {HUMAN_TRIALS} human trials are of nine "
            "pairs who differ, which only the mean gap and imported gaps allow for",
            *(
                f"{group.id}: {group.caution}: it is not judged, nor compared with the humans"
                for group in study.baselines
                if group.caution
            ),
        ),
    )


def _kind(study: Study, group: Group) -> str:
    if group.scripted:
        return MOCK
    models = dict(zip(SIDES, (*group.models, *group.models), strict=False))
    asked = language_models(models, study.specs.get(group.spec_hash or "", {}))
    return LANGUAGE_MODEL if asked else PROGRAM


def _driver(group: Group, kind: str) -> dict[str, Value]:
    return {"driver": group.label, "setting": group.setting, "kind": kind}


def _compared(group: Group, kind: str, found: Comparison) -> Row:
    measure = found.measure
    values: dict[str, Value] = _driver(group, kind) | {
        "measure": measure.name,
        **_known(found.own),
        "human": found.human.estimate.value,
        "human_ci": found.human.estimate.bounds(),
        "difference": found.difference,
        "difference_ci": found.interval,
        "level": None if found.level is None else 100 * found.level,
        "p": found.p,
        "p_holm": found.p_holm,
        "detectable": found.detectable,
        "state": found.state or None,
        "rule": measure.rule,
    }
    return Row(f"{group.id}/{measure.name}", (group.id,), values, found.note, measure.counts)


def _human_rows(study: Study) -> Iterator[Row]:
    for name, found in of_humans(study).items():
        values = _driver(study.human, HUMANS) | {"measure": name, **_known(found)}
        note = "; ".join(filter(None, (found.problem, found.remark)))
        # What is published rests on no trials here.
        counts = "" if found.remark or not study.human.measured else MEASURES[name].counts
        yield Row(f"{HUMAN}/{name}", (HUMAN,), values, note, counts)


def _known(found: Known) -> dict[str, Value]:
    return {
        "n": found.estimate.n,
        "k": found.k,
        "undecided": found.undecided or None,
        "estimate": found.estimate.value,
        "ci": found.estimate.bounds(),
    }


def contrasts(study: Study) -> Table:
    """Every prompt against its driver's reference."""
    # A family is one question asked of several variants. Correcting over all metrics at once would
    # make the result depend on how many are registered.
    rows = [
        row
        for driver in dict.fromkeys(group.driver for group in study.models)
        for metric in shown_in("tables")
        for row in _family(study, driver, metric)
    ]
    return Table(
        "contrasts",
        (
            Column("driver", "driver"),
            Column("setting", "setting"),
            Column("reference", "against"),
            Column("measure", "measure"),
            Column("difference", "difference", "number", 2, "first minus second"),
            interval("ci", "of the same test"),
            Column("p", "p", "p", 3, "Fisher's exact test or Welch's"),
            Column("p_holm", "Holm", "p", 3, "corrected by Holm"),
            Optional("detectable", "detectable", "number", 2, "at p < .05 with power .8"),
            Column("n", "n", "count", 0, "trials of the setting in the shared conditions"),
            Column("n_reference", "n ref.", "count", 0, "trials of the reference in these"),
            Optional("freedom", "df", "number", 0, "of a t test"),
        ),
        rows,
        (
            f"{WITHIN.format('conditions')}. {FAMILY}. Detectable: before correction; of rates by "
            "the exact power of Fisher's test of all these trials as if of one condition, in the "
            "direction in which less is enough, of means (t.975 + t.8) times the standard error",
            RULES_NOTE,
            *_same_as_reference(study),
            *([] if rows else ["there is no pair of judged groups to compare"]),
        ),
    )


def _same_as_reference(study: Study) -> Iterator[str]:
    """Which prompts have no row, since programs do not read them."""
    own = {g.driver: g for g in study.models if g.setting == study.reference}
    same = []
    for group in study.models:
        other = own.get(group.driver)
        if other in (None, group):
            continue
        if copied_of_shared((group, other), "condition")[0]:
            same.append(group.id)
    if same:
        yield f"{', '.join(same)}, beside {study.reference}: {SAME_TRIALS}"


def _family(study: Study, driver: str, metric: Metric) -> Iterator[Row]:
    """One measure of a driver's prompts against its reference; p are corrected for their number."""
    groups = {group.setting: group for group in study.models if group.driver == driver}
    other = groups.pop(study.reference, None)
    found = {
        group: difference
        for group in groups.values()
        if other and (difference := contrast(study, (group, other), metric))
    }
    holm = corrected([difference.p for difference in found.values()])
    for (group, difference), p_holm in zip(found.items(), holm, strict=True):
        assert other is not None
        first, second = (
            frame["condition"]
            for frame in trials_by_cell(study, (group, other), metric, "condition", shared=True)
        )
        named = ", ".join(quoted(name) for name in sorted({*first}))
        factor, least = 100 if metric.rate else 1, difference.detectable
        values: dict[str, Value] = {
            "driver": group.label,
            "setting": group.setting,
            "reference": other.setting,
            "measure": metric.heading,
            "difference": factor * difference.value,
            "ci": difference.bounds(factor),
            "p": difference.p,
            "p_holm": p_holm,
            "detectable": None if least is None else factor * least,
            "n": len(first),
            "n_reference": len(second),
            "freedom": None if isinf(difference.freedom) else difference.freedom,
        }
        few = f"{metric.heading}: so few trials can show no difference, however large"
        yield Row(
            f"{group.id}/{other.setting}/{metric.name}",
            (group.id, other.id),
            values,
            few if least is None else "",
            f"{metric.counts} AND condition IN ({named})",
        )


def _left_out(level: Level, first: Level) -> str:
    """What is not compared, since programs play the same trials at both levels."""
    copies, shared = copied_of_shared((level.pooled, first.pooled), "cell")
    if not copies:
        return ""
    if copies == shared:
        return SAME_TRIALS
    return (
        f"the difference leaves out {copies} of {shared} shared cells, those of programs that play "
        "the same trials at both levels"
    )


def factors(study: Study) -> Table:
    """A row per factor, measure and level: the level's value, and how far it is from the first.

    Where the study is shown by a factor, each of its levels has rows of its own, and interactions.
    """
    by = study.by or ""
    shown = require(levels_of(study.models, study.order), "factor", by) if by else [""]
    found = [levels for at in shown for levels in levels_by_factor(study, by, at)]
    rows = [
        _level_row(study, level, levels[0], metric)
        for levels in found
        for metric in METRICS.values()
        for level in levels
    ]
    rows += _interactions(study, found) if by else []
    families: dict[tuple[Value, ...], dict[str, float]] = {}
    for row in rows:
        if isinstance(value := row.values.get("p"), float):
            family = tuple(row.values.get(name) for name in ("factor", "drivers", "measure"))
            family += () if INTERACTION in str(family[0]) else (row.values.get("at"),)
            families.setdefault(family, {})[row.id] = value
    holm = {
        name: p_holm
        for p in families.values()
        for name, p_holm in zip(p, corrected([*p.values()]), strict=True)
    }
    rows = [replace(row, values={**row.values, "p_holm": holm.get(row.id)}) for row in rows]
    return Table(
        "factors",
        (
            *([Column("at", by)] if by else []),
            Column("factor", "factor"),
            Optional("drivers", "drivers"),
            Column("measure", "measure"),
            Column("level", "level"),
            Column("trials", "trials", "count", 0, "trials of the level that ended"),
            Column("n", "n", "count", 0, "of these, trials that count for the measure"),
            Optional("value", "value", "number", 2, "the measure"),
            interval("ci", "of the measure"),
            Optional("difference", "difference", "number", 2, "from the factor's reference"),
            interval("difference_ci", "of the difference"),
            Optional("p", "p", "p", 3, "Fisher's exact test or Welch's"),
            Optional("p_holm", "Holm", "p", 3, "corrected by Holm"),
        ),
        rows,
        (
            *([] if found else ["the trials of judged drivers differ in no factor"]),
            f"intervals: {INTERVALS}. {DIFFERENCES}",
            *([INTERACTIONS.format(by=by)] if by else []),
            *([FAMILY] if any(row.values["p_holm"] is not None for row in rows) else []),
            *_copies(found),
            *(f"{_name(levels[0])}: {balance(levels)}" for levels in found),
            RULES_NOTE,
        ),
    )


def _copies(found: list[list[Level]]) -> Iterator[str]:
    """Which levels have copies of trials from levels of other factors."""
    counts = [
        f"{level.id}: {level.pooled.repeated} of {len(level.pooled.stored.trials)}"
        for levels in found
        for level in levels
        if level.pooled.repeated
    ]
    if counts:
        yield (
            f"{', '.join(counts)} trials of programs are equal to others of the level to the last "
            "state, at another level of another factor: each counts once, in one cell"
        )


def _name(level: Level) -> str:
    return f"{level.factor}{level.mark}" + (f" at {level.at}" if level.at else "")


def _level_row(study: Study, level: Level, first: Level, metric: Metric) -> Row:
    found = estimate(level.pooled, metric)
    cells = _cells(level, metric) | {"n": found.n, "value": found.value, "ci": found.bounds()}
    if level is not first and metric.estimator == "median":
        cells |= {"difference": difference_of_medians(study, metric, level, first)}
    elif level is not first:
        cells |= _difference(study, metric, level, first)
    nothing = "" if found.n or found.bounds() else f"{metric.heading}: no trial with this measure"
    same = "" if level is first else _left_out(level, first)
    note = "; ".join(filter(None, (nothing, undecided_note(level.pooled, metric), same)))
    return Row(f"{level.id}/{metric.name}", level.groups, cells, note, _counts(level, metric))


def _counts(level: Level, metric: Metric) -> str:
    return " AND ".join(filter(None, (metric.counts, level.predicate)))


def _cells(level: Level, metric: Metric) -> dict[str, Value]:
    """What every row of a level says."""
    return {
        "at": level.at.partition("=")[2],
        "factor": level.factor,
        "drivers": "mock" if level.posing else None,
        "measure": metric.heading,
        "level": level.name,
        "trials": len(level.pooled.ended),
    }


def _difference(study: Study, metric: Metric, *levels: Level) -> dict[str, Value]:
    """A difference of levels, or of differences, in the cells that all of them have."""
    found = contrast(study, [level.pooled for level in levels], metric, "cell")
    if found is None:
        return {}
    unit = 100 if metric.rate else 1
    return {
        "difference": unit * found.value,
        "difference_ci": found.bounds(unit),
        "p": found.p,
    }


def _interactions(study: Study, found: list[list[Level]]) -> Iterator[Row]:
    """A row for each level of a factor at each level of the other one, but for their references."""
    known: dict[tuple[str, str], list[list[Level]]] = {}
    for levels in found:
        known.setdefault((levels[0].factor, levels[0].mark), []).append(levels)
    tested = [metric for metric in METRICS.values() if metric.estimator != "median"]
    for ((base, *twins), *more), metric in product(known.values(), tested):
        for (first, *levels), twin in product(more, twins):
            for level in levels:
                if level.name == twin.name and first.name == base.name:
                    yield _interaction(study, level, first, twin, base, metric)


def _interaction(
    study: Study, level: Level, first: Level, twin: Level, base: Level, metric: Metric
) -> Row:
    by, _, at = level.at.partition("=")
    different = _difference(study, metric, level, first, twin, base)
    cells = _cells(level, metric) | {
        "at": f"{at} - {base.at.partition('=')[2]}",
        "factor": f"{level.factor}{INTERACTION}{by}",
        "n": estimate(level.pooled, metric).n,
        **different,
    }
    note = "" if different else f"{metric.heading}: {NO_INTERACTION}"
    row_id = f"{level.id}/interaction/{metric.name}"
    return Row(row_id, level.groups, cells, note, _counts(level, metric))
