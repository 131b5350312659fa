"""Tables III and IV: who merged first, and the gap; first actions by own relative velocity."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple

import numpy as np
import pandas as pd

from merge_runner_analysis.data.reference_data import citation, printed_value, published
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.stats.first_action import (
    HOLD_MPS2,
    exchange_rate,
    first_actions,
    human_exchange_rate,
    repeats_itself,
    seats,
    slope,
)
from merge_runner_analysis.stats.indicators import fits
from merge_runner_analysis.stats.intervals import Estimate
from merge_runner_analysis.stats.measures import outcomes_note
from merge_runner_analysis.stats.regressions import (
    GAP_MARGIN_M,
    GAP_TERMS,
    WHO_FIRST_TERMS,
    Regression,
    by_pairs,
    gap_ols,
    who_first_logit,
)
from merge_runner_analysis.tables.model import (
    ENDED,
    GROUP_COLUMNS,
    Column,
    Optional,
    Row,
    Table,
    Value,
    interval,
    row_of,
)

TERM_NAMES = {
    "intercept": "Intercept",
    "projected_headway": "Projected headway",
    "relative_velocity": "Relative velocity",
    "abs_projected_headway": "Abs. projected headway",
    "abs_relative_velocity": "Abs. relative velocity",
    "headway_x_velocity": "Headway : relative velocity",
}
WITH_MERGER = "status = 'finished' AND merged_first IS NOT NULL"
WITH_GAP = "gap_m IS NOT NULL"
TESTED_ELSEWHERE = (
    "whether two drivers differ cannot be read off their p-values: for drivers and humans the "
    "table verdicts tests it"
)
KEYS = (
    Column("term", "term"),
    *GROUP_COLUMNS,
    Column("n", "n", "count", 0, "trials in the regression"),
    Column("b", "b", "number", 2, "coefficient"),
    Column("se", "SE", "number", 3, "standard error"),
)
P = Column("p", "p", "p", 3, "Wald test")
# Fits of the same trials: how their rows differ in name and label from the first ones, and the fit
# and a robust one by the prefix of their values' names.
Fits = list[tuple[str, str, dict[str, Regression]]]
BY_PAIR = ", errors by pair"
FIRST_FILE = "human_first_actions"
NO_ACTION = (
    "no trial that ended has a first action of both: none did, or with control_start = "
    '"own_exit" one driver acts while the other is in its tunnel yet'
)
REPEATS = (
    "{name} declares no chance, and does the same first in all repetitions of a situation: each "
    "situation counts once"
)
UNBOUNDED = "exchange rate: no finite interval, as the slope on headway may be 0 (Fieller 1954)"
ONLY_ASKED = (
    "asked without the loop (`merge-runner sweep --first`), in {trials} trials that end before a "
    "second decision"
)
# By the sign of the own relative velocity.
VELOCITIES = {-1: "slower", 0: "equal", 1: "faster"}
FIRST_ACTIONS = (
    Optional("n", "n", "count", 0, "first actions: two a trial, one of a mixed pair"),
    *(
        Optional(f"mean_{name}", name, "number", 3, f"mean (m/s²) where the own velocity is {name}")
        for name in VELOCITIES.values()
    ),
    Optional("brake_percent", "brake (%)", "percent", 1, f"below -{HOLD_MPS2} m/s²"),
    Optional("hold_percent", "hold (%)", "percent", 1, f"within {HOLD_MPS2} m/s² of 0"),
    Optional("go_percent", "go (%)", "percent", 1, f"above {HOLD_MPS2} m/s²"),
    Optional("slope", "slope", "number", 3, "on own relative velocity, m/s² per m/s"),
    Optional("slope_se", "SE", "number", 3, "of the slope, clustered by trial"),
    interval("slope_ci", "of the slope", 3),
    Optional("exchange_rate", "exchange rate", "number", 2, "m of headway that are worth 1 m/s"),
    interval("exchange_rate_ci", "of the rate, by Fieller"),
)


def who_first(study: Study) -> Table:
    """Table III: logistic regression of left-first on h (m) and dv (m/s)."""
    return Table(
        "who-first",
        (
            *KEYS,
            Column("z", "z", "number", 2, "b / SE"),
            P,
            Optional("firth_b", "Firth b", "number", 2, "Firth's penalised estimate"),
            Optional("firth_se", "SE", "number", 3, "its standard error"),
            Optional("firth_p", "LR p", "p", 3, "its likelihood-ratio test"),
        ),
        _rows(study, WHO_FIRST_TERMS, _who_first_fits, WITH_MERGER),
        (TESTED_ELSEWHERE, *_mixed_note(study, "S4", "random intercept per pair")),
    )


def gap(study: Study) -> Table:
    """Table IV: linear regression of the gap (m) on |h|, |dv| and h*dv."""
    mean100 = "random intercept per pair, gap where the mean position reaches 100 m"
    return Table(
        "gap",
        (
            *KEYS,
            Column("t", "t", "number", 2, "b / SE"),
            P,
            Optional("hc3_se", "HC3 SE", "number", 3, "HC3 standard error"),
            Optional("hc3_p", "HC3 p", "p", 3, "its t test"),
            Optional("equivalence_p", "equiv. p", "p", 3, "two one-sided tests of the margin"),
            Optional("velocity_p", "joint p", "p", 3, "F test of all terms with relative velocity"),
        ),
        _rows(study, GAP_TERMS, _gap_fits, WITH_GAP),
        (
            "of all terms with relative velocity together: equiv. p, that the predicted gaps of "
            "any two played conditions that differ in relative velocity alone are less than "
            f"{GAP_MARGIN_M:g} m apart (two one-sided tests of each with HC3 errors, the largest "
            "p: a small one shows it); joint p, that none of them has an effect",
            TESTED_ELSEWHERE,
            *_mixed_note(study, "S6", mean100),
        ),
    )


def _who_first_fits(group: Group) -> Fits:
    """By maximum likelihood and by Firth's fit, the humans also with errors by pair."""
    # Wald's p fails where conditions nearly separate the outcomes, as those of humans do (Hauck and
    # Donner 1977); Firth's penalty (1993) keeps estimates finite there.
    found: Fits = [("", "", {"": fits(group).logit, "firth_": fits(group).firth})]
    if not group.setting and group.measured:
        # Repeated trials of a pair are alike, which the pooled fit ignores.
        paired = by_pairs(who_first_logit, group.trials, "merged_first")
        found.append(("clustered/", BY_PAIR, {"": paired}))
    return found


def _gap_fits(group: Group) -> Fits:
    """By least squares and with HC3 errors, the humans also with errors by pair."""
    # HC3 errors (MacKinnon and White 1985) hold for unequal variances.
    found: Fits = [("", "", {"": fits(group).ols, "hc3_": fits(group).hc3})]
    if not group.setting:
        mean100 = "gap_mean100_m"  # the definition of the gap that the published mixed model uses
        paired = by_pairs(gap_ols, group.trials, "gap_m")
        of_mean = by_pairs(lambda trials: gap_ols(trials, mean100), group.trials, mean100)
        found.append(("clustered/", BY_PAIR, {"": paired}))
        found.append(("clustered-mean100/", f"{BY_PAIR}, mean at 100 m", {"": of_mean}))
    return found


def _rows(
    study: Study, terms: Sequence[str], fits_of: Callable[[Group], Fits], counts: str
) -> list[Row]:
    """The rows of each term by group and fit."""
    of_gap = counts == WITH_GAP
    known = {group: fits_of(group) for group in study.groups if group.measured or not of_gap}
    return [
        row
        for term in terms
        for group in study.groups
        for row in (
            [_row(group, term, *fit, counts) for fit in known[group]]
            if group in known
            else [_published_gap(group, term)]
        )
    ]


def _row(
    group: Group, term: str, item: str, label: str, found: dict[str, Regression], counts: str
) -> Row:
    values: dict[str, Value] = {
        "term": TERM_NAMES[term],
        "driver": group.label + label,
        "n": found[""].n,
    }
    for prefix, fit in found.items():
        if term in fit.terms:
            b, se, statistic, p = astuple(fit.terms[term])
            # A table shows one of z and t.
            named = {"b": b, "se": se, "z": statistic, "t": statistic, "p": p}
            values |= {prefix + name: value for name, value in named.items()}
    # I4 claims that these effects are absent. A large p is no evidence of that, so equivalence is
    # tested (Schuirmann 1987).
    if "hc3_" in found and term == "abs_relative_velocity":
        values["equivalence_p"] = found["hc3_"].equivalence_p
        values["velocity_p"] = found["hc3_"].velocity_p
    remarks = dict.fromkeys(text for fit in found.values() for text in (fit.problem, fit.remark))
    pooled = "" if label or counts == WITH_GAP else outcomes_note(group)
    return row_of(group, values, *remarks, pooled, item=item + term, counts=counts)


def _mixed_note(study: Study, table: str, model: str) -> Iterator[str]:
    """A note with the published mixed model, for comparison with the human rows."""
    if study.human in study.groups:
        values = "; ".join(
            f"{TERM_NAMES[row.term]} {row.estimate:g} (SE {row.std_error:g})"
            for row in published("human_mixed_models").query("table == @table").itertuples()
        )
        yield f"published human mixed model ({model}): {values}"


def _published_gap(group: Group, term: str) -> Row:
    """The humans' row of Table IV as the paper prints it."""
    printed = published("paper_gap").query("driver == 'human' and term == @term").iloc[0]
    values = {name: printed_value(printed[name]) for name in ("b", "se", "t", "p")}
    note = f"published values, no human traces are imported ({citation('paper_gap')})"
    return row_of(
        group, {"term": TERM_NAMES[term], "n": int(printed["n"]), **values}, note, item=term
    )


def first_action(study: Study) -> Table:
    """Make the table: a row per driver and prompt, two for a mixed pair."""
    groups = (*study.groups, *study.asked)
    return Table(
        "first-action",
        (*GROUP_COLUMNS, *FIRST_ACTIONS),
        [row for group in groups for row in _first_rows(study, group)],
        (
            "the first action is the net acceleration of the first step under control, drag "
            "included; own relative velocity is own minus other. A first decision without a valid "
            "plan holds, and counts",
            "slope: least squares with errors clustered by trial. Exchange rate: minus the ratio "
            "of the slopes on own relative velocity and own projected headway in a logit of M as "
            "the first word, of humans in one of who merged first; empty where a driver has no "
            "word, or the logit no finite estimate",
            *_first_notes(study),
        ),
    )


def _first_rows(study: Study, group: Group) -> Iterator[Row]:
    if group is study.human and not study.complete:
        yield _published_row(group)
        return
    for seat in seats(group):
        rows = first_actions(study, seat)
        rate = human_exchange_rate() if group is study.human else exchange_rate(rows)
        values: dict[str, Value] = {"driver": seat.name, "n": len(rows)}
        if len(rows):
            action, sign = rows["first_mps2"], np.sign(rows["velocity_mps"].round(6))
            means, fitted = action.groupby(sign).mean(), slope(rows)
            values |= {f"mean_{VELOCITIES[at]}": float(mean) for at, mean in means.items()}
            values |= {
                "brake_percent": float(100 * (action < -HOLD_MPS2).mean()),
                "hold_percent": float(100 * (action.abs() <= HOLD_MPS2).mean()),
                "go_percent": float(100 * (action > HOLD_MPS2).mean()),
                "slope_se": fitted.se if fitted else None,
                **_estimate("slope", fitted),
                **_estimate("exchange_rate", rate),
            }
        remarks = (
            "" if len(rows) else NO_ACTION,
            REPEATS.format(name=seat.name) if repeats_itself(study, seat) else "",
            UNBOUNDED if len(rows) and rate and rate.low is None else "",
            ONLY_ASKED.format(trials=len(group.ended)) if group in study.asked else "",
        )
        yield row_of(group, values, *remarks, item=seat.side, counts=ENDED)


def _published_row(group: Group) -> Row:
    rows, known = published(FIRST_FILE), _published_slope()
    weights = rows["n"] / rows["n"].sum()
    names = np.sign(rows["relative_velocity_mps"]).map(VELOCITIES)
    shares = {"brake": "slow", "hold": "hold", "go": "go"}
    values: dict[str, Value] = {
        "n": int(rows["n"].sum()),
        **{f"mean_{name}": mean for name, mean in zip(names, rows["mean_mps2"], strict=True)},
        **{
            f"{name}_percent": float((weights * rows[f"{of}_percent"]).sum())
            for name, of in shares.items()
        },
        "slope": float(known["value"]),
        "slope_ci": (float(known["low"]), float(known["high"])),
        **_estimate("exchange_rate", human_exchange_rate()),
    }
    return row_of(group, values, f"published ({citation(FIRST_FILE)})", counts="")


def _estimate(name: str, estimate: Estimate | None) -> dict[str, Value]:
    return {name: estimate.value, f"{name}_ci": estimate.bounds()} if estimate else {}


def _published_slope() -> pd.Series:
    return published("human_first_action_trials").set_index("measure").loc["slope_mps2_per_mps"]


def _first_notes(study: Study) -> Iterator[str]:
    if study.human not in study.groups:
        return
    yield f"human: slope as published: {_published_slope()['caution']}"
    yield f"human: exchange rate: {citation('human_outcomes')}"
