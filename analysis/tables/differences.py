"""Whether drivers differ from humans, by interactions with the source in a joint model.

For the model and its errors see ``merge_runner_analysis.stats.joint``.
"""

from __future__ import annotations

from math import isinf

from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.names import BASELINE
from merge_runner_analysis.stats.intervals import Difference
from merge_runner_analysis.stats.joint import (
    GAP,
    NARROW,
    WHO_FIRST,
    Interaction,
    interactions,
)
from merge_runner_analysis.tables.model import Column, Row, Table, Value
from merge_runner_analysis.tables.notes import replayed_notes, sample_notes
from merge_runner_analysis.tables.regressions import TERM_NAMES, WITH_GAP, WITH_MERGER

OUTCOMES = {WHO_FIRST: "left first (logit)", GAP: "gap (m)"}
COUNTS = {WHO_FIRST: WITH_MERGER, GAP: WITH_GAP}


def differences(study: Study) -> Table:
    """Every driver's baseline against the humans: a row per outcome and term."""
    human = study.human
    compared = study.compared if human in study.groups else []
    rows = [_row(group, one) for group in compared for one in interactions(human, group)]
    return Table(
        "differences",
        "Differences of the baseline from humans, tested in one model of both",
        (
            Column("driver", "driver"),
            Column("outcome", "outcome"),
            Column("term", "term"),
            Column("n", "n", "count", 0, "trials of the driver in the model"),
            Column("n_human", "n humans", "count", 0, "trials of the humans in the model"),
            Column("b_driver", "driver b", "number", 2, "coefficient of the driver"),
            Column("b_human", "human b", "number", 2, "coefficient of the humans"),
            Column("difference", "difference", "number", 2, "interaction: driver minus humans"),
            Column("ci", "95 % CI", "interval", 2, "of the interaction"),
            Column("p", "p", "p", 3, "test of the interaction"),
            Column("freedom", "df", "number", 0, "of its t test; none: normal", optional=True),
            Column(
                "detectable",
                "detectable",
                "number",
                2,
                "smallest difference found with power .8: (t.975 + t.8) SE",
            ),
            Column("method", "method", meaning="how the model is fitted", optional=True),
        ),
        rows,
        (
            "left first ~ (headway + relative velocity) x source and gap ~ (abs. headway + abs. "
            "relative velocity + headway : relative velocity) x source, source being 1 for the "
            "driver and 0 for humans; Source is the difference where the other terms are 0",
            "errors of the driver: Fisher's information (left first), HC3 (gap); of the humans: "
            "jackknife over their pairs where these are known; t with Satterthwaite's df. Where "
            "maximum likelihood has no finite estimate, no difference can be estimated",
            "detectable: what a two-sided test at 5 % finds in four of five such studies, from "
            f"the standard error of this one; where {NARROW}, it is too small as well",
            "p is not corrected for the number of terms and drivers",
            *replayed_notes(study),
            *sample_notes(study, [study.human, *compared] if rows else [], pooled=False),
            *(
                []
                if rows
                else [
                    "nothing is compared: that takes the humans, and a driver that is judged with "
                    f"the prompt `{BASELINE}`"
                ]
            ),
        ),
    )


def _row(group: Group, found: Interaction) -> Row:
    said = found.problem or found.remark
    return Row(
        f"{group.id}/{found.outcome}/{found.term}",
        (group.id,),
        {
            "driver": group.label,
            "outcome": OUTCOMES[found.outcome],
            # The intercept's interaction with the source is the main effect of the source.
            "term": "Source" if found.term == "intercept" else TERM_NAMES[found.term],
            "n": found.n,
            "n_human": found.n_human,
            "b_driver": found.driver,
            "b_human": found.human,
            **_tested(found.found),
        },
        f"{found.outcome}: {said}" if said else "",
        counts=COUNTS[found.outcome],
    )


def _tested(found: Difference | None) -> dict[str, Value]:
    if found is None:
        return {}
    return {
        "difference": found.value,
        "ci": found.bounds(),
        "p": found.p,
        # Infinite degrees of freedom mean a normal test; JSON has no infinity.
        "freedom": None if isinf(found.freedom) else found.freedom,
        "detectable": found.detectable,
        "method": found.by,
    }
