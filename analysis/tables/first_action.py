"""What drivers do first, beside the humans: by own relative velocity, and fault by fault."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from analysis.data.first_actions import HOLD_MPS2, Acts
from analysis.data.reference_data import citation, published
from analysis.data.study import Group, Study
from analysis.stats.first_look import (
    LEAST_TRIALS,
    PUBLISHED,
    TRACES,
    Fault,
    Humans,
    Seat,
    acts,
    clustered_mean,
    crps,
    cue,
    distances,
    ecdf,
    faults,
    humans,
    repeats_itself,
    seats,
    skill,
)
from analysis.tables.model import GROUP_COLUMNS, Column, Row, Table, Value, row_of
from analysis.tables.notes import repeated_note, sample_notes

ENDED = "status <> 'failed'"
FILE = "human_first_actions"
ALL = "all"
SKILL = "0: as near as draws from all humans together, 1: as draws from those of the same velocity"
VALUES = (
    Column("n", "n", "count", 0, "first actions: two a trial, one of a mixed pair"),
    Column("mean", "mean", "number", 3, "mean first action"),
    Column("se", "SE", "number", 3, "of the mean; the actions of a trial hang together"),
    Column("sd", "SD", "number", 2, "of the first actions"),
    Column("slow_percent", "slow (%)", "percent", 1, f"below -{HOLD_MPS2} m/s²"),
    Column("hold_percent", "hold (%)", "percent", 1, f"within {HOLD_MPS2} m/s² of 0"),
    Column("go_percent", "go (%)", "percent", 1, f"above {HOLD_MPS2} m/s²"),
    Column("first_second", "1st second", "number", 3, "mean acceleration over the first second"),
    Column("crps", "CRPS", "number", 3, "mean score for the humans' first actions"),
    Column("wasserstein", "distance", "number", 3, "Wasserstein distance to the humans"),
    Column("both_go_percent", "both go (%)", "percent", 1, "of the trials"),
    Column("both_slow_percent", "both slow (%)", "percent", 1, "of the trials"),
    Column("slope", "slope", "number", 3, "of the first action on own relative velocity, per m/s"),
    Column("slope_ci", "95 % CI", "interval", 3, "of the slope"),
    Column("second_slope", "slope, 1st second", "number", 3, "of the mean over the first second"),
    Column("skill_crps", "skill (CRPS)", "number", 2, SKILL),
    Column("skill_wasserstein", "skill (distance)", "number", 2, SKILL),
    Column("skill_humans", "humans", "interval", 2, "of draws from the humans: 95 % of them"),
)
COMPARED = (
    Column("driver_value", "driver", "number", 3, "of the driver"),
    Column("human_value", "humans", "number", 3, "of the humans", of="both"),
    Column("difference", "difference", "number", 3, "the driver less the humans", of="both"),
    Column("ci", "95 % CI", "interval", 3, "of the difference", of="both"),
    Column("p", "p", "p", 3, "by Holm, for the faults of the driver", of="both"),
    Column("shown", "shown", "verdict", 0, "whether the fault is shown", of="both"),
    Column("says", "what it does", of="both"),
)


def first_action(study: Study) -> Table:
    """A row per driver and own relative velocity, and one over all of these with the slope."""
    return Table(
        "first-action",
        "Net acceleration (m/s²) at the first decision, by own relative velocity",
        (
            *GROUP_COLUMNS,
            Column("velocity", "own velocity"),
            *(replace(column, counts=ENDED, optional=True) for column in VALUES),
        ),
        [row for group in (*study.groups, *study.asked) for row in _rows(study, group)],
        (
            "the first action is the net acceleration of the first step under control, drag "
            "included; own velocity is relative to the other vehicle's",
            *_human_notes(study),
            *sample_notes(study, study.models, pooled=False, whole=False),
            *_asked_notes(study),
            *_left_out_notes(study),
        ),
    )


def first_action_faults(study: Study) -> Table:
    """A row per driver and fault that its first actions may have, tested beside the humans."""
    known = humans(study)
    drivers = [seat for group in (*study.models, *study.asked) for seat in seats(group)]
    return Table(
        "first-action-faults",
        "Faults of the first action, beside the humans",
        (
            *GROUP_COLUMNS,
            Column("fault", "fault"),
            *(replace(column, counts=ENDED, optional=column.name == "says") for column in COMPARED),
        ),
        [
            _fault_row(study, seat, one, known)
            for seat in drivers
            for one in faults(acts(study, seat), known)
        ],
        (
            "relative velocity: the slope; side: the left vehicle's action less the right one's "
            "at equal velocities, of humans 0 by symmetry, and not tested of the drivers of a "
            "mixed pair; level: the mean, of humans at the "
            f"driver's relative velocities; late: the share within {HOLD_MPS2} m/s² of 0, shown "
            "only if more acceleration, either way, also follows within the first second. Of a "
            "driver that is late the others are not called shown",
            *_human_notes(study),
            *sample_notes(study, study.models, pooled=False, whole=False),
            *_asked_notes(study),
            *_left_out_notes(study),
        ),
    )


def velocity_name(velocity_mps: float) -> str:
    """An own relative velocity in words."""
    if not velocity_mps:
        return "equal"
    return f"{abs(velocity_mps):g} m/s {'faster' if velocity_mps > 0 else 'slower'}"


def _human_notes(study: Study) -> list[str]:
    known = humans(study)
    trials = published("human_first_action_trials").set_index("measure")
    go, slow = (trials.loc[f"both_{what}_percent"] for what in ("go", "slow"))
    if known.source != PUBLISHED:
        return [f"human first actions: {known.source}"]
    few = study.human_first_actions["trial"].nunique()
    return [
        *(
            [f"the imported first actions of {few} trials do not count: {LEAST_TRIALS} are needed"]
            if few
            else []
        ),
        f"human first actions: {citation(FILE)}. Between the published quantiles and shares the "
        "distribution is taken as linear, up to full throttle, and down to where its mean is the "
        "published one; `merge-runner human import-first-actions FILE` imports the actions",
        f"slope of the humans: {trials.loc['slope_mps2_per_mps', 'caution']}. By relative velocity "
        f"both humans of a trial go in {go['low']:g} to {go['high']:g} %, and slow in "
        f"{slow['low']:g} to {slow['high']:g} %",
    ]


def _asked_notes(study: Study) -> Iterator[str]:
    """Which of the drivers were only asked."""
    for group in study.asked:
        yield (
            f"{group.id}: asked without the loop (`merge-runner seat first`), in "
            f"{len(group.ended)} trials that end before a second decision"
        )
        if group.repeated:
            yield f"{group.id}: {repeated_note(group)}"


def _left_out_notes(study: Study) -> Iterator[str]:
    """Which of the trials have no first action, and which repeat one."""
    for group in (*study.models, *study.asked):
        scenario = study.specs.get(group.spec_hash or "", {}).get("scenario", {})
        if scenario.get("control_start") == "own_exit":
            yield (
                f'{group.id}: left out: with control_start = "own_exit" one driver acts while the '
                "other is in its tunnel yet"
            )
        for seat in seats(group):
            if repeats_itself(study, seat):
                yield (
                    f"{seat.name}: it declares no chance, and does the same first in all "
                    "repetitions of a situation: each situation counts once"
                )


def _rows(study: Study, group: Group) -> Iterator[Row]:
    known = humans(study)
    if group is not study.human or known.source == TRACES:
        for seat in seats(group):
            yield from _of_acts(seat, acts(study, seat), known)
        return
    rows: Iterable[Row] = (
        _of_classes(group, known)
        if known.acts is None
        else _of_acts(Seat(group, (0, 1)), known.acts, known)
    )
    # Of humans whose recordings are imported in part, too, these are other trials than theirs.
    columns = tuple(column.name for column in VALUES)
    yield from (replace(row, published=columns, cited=FILE, note=known.source) for row in rows)


def _of_acts(seat: Seat, found: Acts, known: Humans) -> Iterator[Row]:
    if not len(found.first):
        yield _row(seat, ALL, {"n": 0}, ENDED)
        return
    for velocity in found.velocities:
        values = _values(found, velocity) | _distances(found, velocity, known)
        yield _row(seat, velocity_name(velocity), values, _where(seat, velocity), f"{velocity:g}")
    yield _row(seat, ALL, _values(found, None) | _of_trials(found) | _skill(found, known), ENDED)


def _row(seat: Seat, velocity: str, values: dict[str, Value], counts: str, item: str = ALL) -> Row:
    note = "" if values["n"] else "no trial that ended has a first action"
    cells: dict[str, Value] = {"driver": seat.name, "velocity": velocity, **values}
    item = f"{seat.side}/{item}" if seat.side else item
    return row_of(seat.group, cells, note, item=item, counts=counts)


def _where(seat: Seat, velocity: float) -> str:
    """Which trials have a vehicle of this own relative velocity, in SQL."""
    signed = {"left": f"relative_velocity_mps - {velocity:g}", "right":
              f"relative_velocity_mps + {velocity:g}"}  # fmt: skip
    apart = signed.get(seat.side, f"abs(relative_velocity_mps) - {abs(velocity):g}")
    return f"{ENDED} AND abs({apart}) < 1e-6"


def _values(found: Acts, velocity: float | None) -> dict[str, Value]:
    """Of the actions with this own relative velocity, or of all."""
    first, second = (each[:, found.sides] for each in (found.first, found.second))
    there = np.ones_like(found.own, dtype=bool) if velocity is None else found.at(velocity)
    mean = clustered_mean(first, there, found.unit)
    known = there & np.isfinite(second)
    own = first[there]
    return {
        "n": len(own),
        "mean": mean.value,
        "se": mean.se,
        "sd": float(own.std(ddof=1)) if len(own) > 1 else None,
        "slow_percent": float(100 * (own < -HOLD_MPS2).mean()),
        "hold_percent": float(100 * (np.abs(own) <= HOLD_MPS2).mean()),
        "go_percent": float(100 * (own > HOLD_MPS2).mean()),
        "first_second": float(second[known].mean()) if known.any() else None,
    }


def _distances(found: Acts, velocity: float, known: Humans) -> dict[str, Value]:
    if velocity not in known.cdf:
        return {}
    own = ecdf(found.first[:, found.sides][found.at(velocity)])
    human = known.cdf[velocity]
    return {"crps": crps(own, human), "wasserstein": float(distances(own, human)[1])}


def _of_trials(found: Acts) -> dict[str, Value]:
    slope, second = cue(found)[0], cue(found, found.second)[0]
    cells: dict[str, Value] = {}
    if len(found.sides) > 1:
        cells["both_go_percent"] = float(100 * (found.first > HOLD_MPS2).all(axis=1).mean())
        cells["both_slow_percent"] = float(100 * (found.first < -HOLD_MPS2).all(axis=1).mean())
    if slope is not None:
        cells |= {"slope": slope.value, "slope_ci": slope.bounds()}
    return cells | {"second_slope": second.value if second is not None else None}


def _skill(found: Acts, known: Humans) -> dict[str, Value]:
    reached = skill(found, known)
    if reached is None:
        return {}
    return {
        "skill_crps": reached.crps,
        "skill_wasserstein": reached.wasserstein,
        "skill_humans": reached.humans,
    }


def _of_classes(group: Group, known: Humans) -> list[Row]:
    """The published aggregates."""
    seat = Seat(group, (0, 1))
    rows = [
        _row(
            seat,
            velocity_name(velocity),
            {
                "n": one.n,
                "mean": one.mean,
                "se": one.se,
                "sd": one.sd,
                "slow_percent": 100 * one.slow,
                "hold_percent": 100 * one.hold,
                "go_percent": 100 * one.go,
                "crps": crps(known.cdf[velocity], known.cdf[velocity]),
            },
            _where(seat, velocity),
            f"{velocity:g}",
        )
        for velocity, one in known.classes.items()
    ]
    n = sum(one.n for one in known.classes.values())
    cells: dict[str, Value] = {"n": n, "slope": known.slope.value, "slope_ci": known.slope.bounds()}
    for name in ("mean", "slow", "hold", "go"):
        pooled = sum(one.n * getattr(one, name) for one in known.classes.values()) / n
        cells |= {name: pooled} if name == "mean" else {f"{name}_percent": 100 * pooled}
    return [*rows, _row(seat, ALL, cells, ENDED)]


def _fault_row(study: Study, seat: Seat, one: Fault, known: Humans) -> Row:
    item = f"{seat.side}/{one.name}" if seat.side else one.name
    row = row_of(
        seat.group,
        {
            "driver": seat.name,
            "fault": one.name,
            "driver_value": one.driver,
            "human_value": one.human,
            "difference": one.found.value,
            "ci": one.found.bounds(),
            "p": one.p,
            "shown": one.shown,
            "says": one.said if one.shown else None,
        },
        item=item,
    )
    columns = () if known.source == TRACES else tuple(column.name for column in COMPARED[1:])
    return replace(row, references=(study.human.id,), published=columns, cited=FILE)
