"""First actions beside the humans': slope on the own relative velocity, faults, distributions.

The two vehicles of a trial are not independent, nor are the trials of a pair of humans: errors are
of a jackknife over trials, or over pairs where these are known (CV3 of MacKinnon, Nielsen and Webb
2023). With both sides of a trial the slope b follows from one equation a trial,
a_left - a_right = side + b (2 dv), whose intercept is the bias towards a side.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from math import inf, sqrt

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from analysis.data.first_actions import (
    HOLD_MPS2,
    Acts,
    Array,
    HumanClass,
    acts_of,
    published_classes,
)
from analysis.data.reference_data import published
from analysis.data.study import Group, Study, of_group
from analysis.stats import intervals
from analysis.stats.contrasts import SEED, corrected
from analysis.stats.indicators import ALPHA
from analysis.stats.intervals import Difference, difference
from analysis.stats.mixed import MIN_PAIRS
from merge_runner.drivers.registry import has_chance
from merge_runner.records import SIDES

# Accelerations in m/s² at which distributions are compared; none is beyond with the human vehicle.
STEP_MPS2 = 0.01
GRID = np.arange(-600, 401) * STEP_MPS2
DRAWS = 200
# Of so many trials imported first actions stand in the place of the published aggregates.
LEAST_TRIALS = 100
# Equal but for the last digits, as of a vehicle that drove on the other side, and of a mean.
SAME_MPS2 = 1e-9
# A skill is told where the ceiling is at least this part of the floor away from it.
LEAST_REACH = 0.1
CUE, SIDE, LEVEL, LATE = "relative velocity", "side", "level", "late"
MEASURES: dict[str, Callable[[Array], Array]] = {
    "mean": lambda actions: actions,
    "hold": lambda actions: (np.abs(actions) <= HOLD_MPS2).astype(float),
}
PUBLISHED = "the published aggregates"
DECODED = "imported first actions"
TRACES = "the imported recordings"


@dataclass(frozen=True, slots=True)
class Coefficient:
    """An estimate with its standard error (None: too few units) and that one's freedom."""

    value: float
    se: float | None
    freedom: float = inf

    def bounds(self) -> tuple[float, float] | None:
        """The 95 % interval."""
        return None if self.se is None else intervals.interval(self.value, self.se, self.freedom)


@dataclass(frozen=True)
class Seat:
    """A driver of a group: one on both sides, or one of a mixed pair, the ego on the left."""

    group: Group
    sides: tuple[int, ...]

    @property
    def side(self) -> str:
        """``left`` or ``right`` of a mixed pair, else empty."""
        return SIDES[self.sides[0]] if len(self.sides) == 1 else ""

    @property
    def name(self) -> str:
        """The group's label, or that of one of a mixed pair."""
        model = self.group.models[self.sides[0]]
        return self.group.label_of(model) if self.side else self.group.label


@dataclass(frozen=True, eq=False)
class Humans:
    """What humans do first: their own ``acts``, or the published ``classes`` where there are none.

    ``cdf`` has the distribution at GRID by own relative velocity, ``n`` the number of actions.
    """

    source: str
    n: Mapping[float, int]
    cdf: Mapping[float, Array]
    slope: Coefficient
    acts: Acts | None
    classes: Mapping[float, HumanClass]

    @property
    def velocities(self) -> tuple[float, ...]:
        """The own relative velocities that humans had."""
        return tuple(self.n)

    @property
    def marginal(self) -> Array:
        """The distribution of who does not look at the relative velocity."""
        total = sum(self.n.values())
        parts = [self.cdf[velocity] * (n / total) for velocity, n in self.n.items()]
        return np.asarray(np.sum(parts, axis=0))


@dataclass(frozen=True, slots=True)
class Fault:
    """A way in which a driver's first actions may differ from the humans', and its test.

    ``found`` is the driver less the humans, whose bias towards a side is 0 by symmetry. ``p`` is
    corrected by Holm for the driver's faults; ``shown`` says whether it is, ``said`` what it is.
    """

    name: str
    driver: float
    human: float
    found: Difference
    p: float
    said: str
    shown: bool = False


@dataclass(frozen=True, slots=True)
class Skill:
    """How near a driver's distributions are to the humans', by two distances.

    0 is as far as draws from the humans' marginal distribution, 1 as near as draws from their own,
    both as many as the driver has. ``humans`` has the middle 95 % of the latter.
    """

    crps: float
    wasserstein: float
    humans: tuple[float, float]


def seats(group: Group) -> list[Seat]:
    """The drivers of a group."""
    return [Seat(group, (0, 1))] if len(group.models) == 1 else [Seat(group, (s,)) for s in (0, 1)]


@cache
def acts(study: Study, seat: Seat) -> Acts:
    """The first actions of a driver in the trials that ended; those of humans by pair."""
    rows = _rows(study, seat)
    if repeats_itself(study, seat):
        # What follows within a second may answer to the other driver, which has chance.
        means = rows.groupby(["condition", "side"])["first_second_mps2"].transform("mean")
        once = rows.drop_duplicates("condition")["trial"]
        rows = rows.assign(first_second_mps2=means)[rows["trial"].isin(once)]
    by_pair = seat.group.ended["pair"].nunique() >= MIN_PAIRS
    return acts_of(rows, "pair" if by_pair else "trial", seat.sides)


def repeats_itself(study: Study, seat: Seat) -> bool:
    """Whether one of a mixed pair declares no chance, and repeats its first action.

    The trials of two drivers without chance are equal, and are left out of their group.
    """
    rows = _rows(study, seat)
    own = rows[rows["side"] == seat.side]
    trials = seat.group.ended
    sat = np.where(trials["ego"] == seat.side, *SIDES)
    known = set(zip(trials["spec_hash"], sat, strict=True))
    if any(has_chance(study.specs.get(name, {}), [side]) for name, side in known):
        return False
    ways = own.groupby("condition")["first_mps2"].agg(["size", np.ptp])
    return len(ways) < len(own) and bool((ways["ptp"] < SAME_MPS2).all())


@cache
def _rows(study: Study, seat: Seat) -> pd.DataFrame:
    """The first actions in the trials of a driver that ended, one row a vehicle."""
    columns = ["trial_id", "spec_hash", "condition", "relative_velocity_mps", "pair"]
    trials = seat.group.ended[columns].reset_index(drop=True)
    return of_group(study.first_actions, seat.group, trials).merge(
        trials.assign(trial=trials.index), on=["trial_id", "spec_hash"]
    )


@cache
def humans(study: Study) -> Humans:
    """The best that is known: complete recordings, else imported first actions, else aggregates."""
    if study.complete:
        return humans_from(acts(study, Seat(study.human, (0, 1))), TRACES)
    decoded = study.human_first_actions
    if decoded["trial"].nunique() >= LEAST_TRIALS:
        return humans_from(acts_of(decoded.assign(first_second_mps2=np.nan), "trial"), DECODED)
    return published_humans()


def humans_from(found: Acts, source: str) -> Humans:
    """The humans by their own first actions."""
    cdf = {v: ecdf(found.first[:, found.sides][found.at(v)]) for v in found.velocities}
    n = {velocity: int(found.at(velocity).sum()) for velocity in found.velocities}
    slope = cue(found)[0]
    return Humans(source, n, cdf, slope or Coefficient(0.0, None), found, {})


@cache
def published_humans() -> Humans:
    """The humans by the aggregates that ship."""
    classes = published_classes()
    slope = published("human_first_action_trials").set_index("measure").loc["slope_mps2_per_mps"]
    low, high = float(slope["low"]), float(slope["high"])
    return Humans(
        PUBLISHED,
        {velocity: one.n for velocity, one in classes.items()},
        {v: np.interp(GRID, *one.knots[::-1]) for v, one in classes.items()},
        Coefficient(float(slope["value"]), (high - low) / 2 / intervals.Z),
        None,
        classes,
    )


def cue(found: Acts, of: Array | None = None) -> tuple[Coefficient | None, Coefficient | None]:
    """Slope on the own relative velocity, and the bias left minus right; None: not to be told.

    ``of`` stands in the place of the first actions, (n, 2); what is NaN is left out.
    """
    actions = found.first if of is None else of
    known = np.isfinite(actions).all(axis=1)
    actions, velocity, unit = actions[known], found.relative_velocity[known], found.unit[known]
    if len(found.sides) == 1:
        side = found.sides[0]
        design = np.column_stack([np.ones(len(velocity)), velocity * (1 - 2 * side)])
        fitted = _jackknife(design, actions[:, side], unit)
        return (fitted[1] if fitted else None), None
    design = np.column_stack([np.ones(len(velocity)), 2 * velocity])
    fitted = _jackknife(design, actions[:, 0] - actions[:, 1], unit)
    if fitted is not None:
        return fitted[1], fitted[0]
    # All trials have one relative velocity: the two sides cannot be told from it, unless it is 0.
    if len(velocity) and not velocity.any():
        alone = _jackknife(np.ones((len(velocity), 1)), actions[:, 0] - actions[:, 1], unit)
        return None, alone[0] if alone else None
    return None, None


def clustered_mean(
    values: Array, counted: NDArray[np.bool_], unit: NDArray[np.int_]
) -> Coefficient:
    """The mean of the counted values, (n, sides); those of one unit (n,) hang together."""
    total = int(counted.sum())
    mean = float(values[counted].mean())
    apart = np.where(counted, values - mean, 0.0).sum(axis=1)
    there = unit[counted.any(axis=1)]
    sums = np.bincount(unit, apart)[np.unique(there)]
    units = len(sums)
    if units < 2:
        return Coefficient(mean, None)
    se = sqrt(float((sums**2).sum()) * units / (units - 1)) / total
    return Coefficient(mean, se, units - 1)


def faults(found: Acts, known: Humans) -> list[Fault]:
    """The faults that these first actions may have, each tested beside the humans.

    Of a driver that acts late the others are not shown: its first action answers to nothing.
    """
    own = found.within(known.velocities)
    if not len(own.first):
        return []
    found_faults = (_late(own, known), _cue(own, known), _side(own), _level(own, known))
    tested = [one for one in found_faults if one is not None]
    if not tested:
        return []
    holm, _ = corrected([one.p for one in tested])
    p = dict(zip((one.name for one in tested), map(float, holm), strict=True))
    late = p.get(LATE, 1.0) < ALPHA
    return [
        replace(
            one,
            p=p[one.name],
            shown=p[one.name] < ALPHA and (one.name == LATE or not late),
        )
        for one in tested
    ]


def skill(found: Acts, known: Humans) -> Skill | None:
    """How near the distributions come to the humans', over the own relative velocities of both."""
    own = found.within(known.velocities)
    sizes = {v: int(own.at(v).sum()) for v in known.velocities if own.at(v).any()}
    if not sizes:
        return None
    total = sum(sizes.values())
    first = own.first[:, own.sides]
    reached = np.array([0.0, 0.0])
    for velocity, n in sizes.items():
        reached += n / total * distances(ecdf(first[own.at(velocity)]), known.cdf[velocity])
    floor, ceiling = _drawn(known, tuple(sizes.items()))
    reach = ceiling.mean(axis=0) - floor.mean(axis=0)
    if (reach > -LEAST_REACH * floor.mean(axis=0)).any():
        return None  # as of humans of one relative velocity: floor and ceiling meet
    crps, wasserstein = (reached - floor.mean(axis=0)) / reach
    spread = (ceiling[:, 1] - floor[:, 1].mean()) / reach[1]
    low, high = np.quantile(spread, [0.025, 0.975])
    return Skill(float(crps), float(wasserstein), (float(low), float(high)))


def crps(driver: Array, human: Array) -> float:
    """Mean continuous ranked probability score of a distribution for the humans', both at GRID."""
    return float(distances(driver, human)[0] + (human * (1 - human)).sum() * STEP_MPS2)


def distances(driver: Array, human: Array) -> Array:
    """Between distributions at GRID, along the last axis: CRPS above its least, Wasserstein-1.

    They are the integrals of (F - G)² and of abs(F - G).
    """
    apart = driver - human
    return np.stack([(apart**2).sum(axis=-1), np.abs(apart).sum(axis=-1)], axis=-1) * STEP_MPS2


def ecdf(values: Array) -> Array:
    """The distribution of a sample, at GRID."""
    return np.searchsorted(np.sort(values), GRID + 1e-9, side="right") / len(values)


@cache
def _drawn(known: Humans, sizes: tuple[tuple[float, int], ...]) -> tuple[Array, Array]:
    """Distances of draws from the marginal and from the own distributions, (DRAWS, 2) each."""
    rng = np.random.default_rng(SEED)
    total = sum(n for _, n in sizes)
    floor, ceiling = np.zeros((DRAWS, 2)), np.zeros((DRAWS, 2))
    for velocity, n in sizes:
        human = known.cdf[velocity]
        floor += n / total * distances(_ecdfs(rng, known.marginal, n), human)
        ceiling += n / total * distances(_ecdfs(rng, human, n), human)
    return floor, ceiling


def _ecdfs(rng: np.random.Generator, cdf: Array, n: int) -> Array:
    """The distributions of DRAWS samples of ``n``, at GRID."""
    places = np.searchsorted(cdf, rng.random((DRAWS, n))).clip(max=len(GRID) - 1)
    flat = (places + len(GRID) * np.arange(DRAWS)[:, None]).ravel()
    counts = np.bincount(flat, minlength=DRAWS * len(GRID)).reshape(DRAWS, len(GRID))
    return np.asarray(counts.cumsum(axis=1) / n)


def _jackknife(design: Array, values: Array, unit: NDArray[np.int_]) -> list[Coefficient] | None:
    """Least squares with errors of a jackknife over units; None where it is not determined."""
    if len(values) <= design.shape[1] or np.linalg.matrix_rank(design) < design.shape[1]:
        return None
    units, place = np.unique(unit, return_inverse=True)
    squares = np.zeros((len(units), design.shape[1], design.shape[1]))
    products = np.zeros((len(units), design.shape[1]))
    np.add.at(squares, place, design[:, :, None] * design[:, None, :])
    np.add.at(products, place, design * values[:, None])
    whole = np.linalg.solve(squares.sum(axis=0), products.sum(axis=0))
    left = squares.sum(axis=0) - squares
    if len(units) < 2 or np.linalg.cond(left).max() > 1e9:
        return [Coefficient(float(b), None) for b in whole]
    parts = np.linalg.solve(left, (products.sum(axis=0) - products)[..., None])[..., 0]
    freedom = len(units) - 1
    errors = np.sqrt(((parts - whole) ** 2).sum(axis=0) * freedom / len(units))
    return [Coefficient(float(b), float(se), freedom) for b, se in zip(whole, errors, strict=True)]


def _cue(own: Acts, known: Humans) -> Fault | None:
    slope, _ = cue(own)
    found = _difference(slope, known.slope) if slope else None
    if slope is None or found is None:
        return None
    turned = slope.value * known.slope.value < 0
    less = turned or abs(slope.value) < abs(known.slope.value)
    said = f"it responds {'less' if less else 'more'} to the relative velocity"
    return Fault(CUE, slope.value, known.slope.value, found, found.p, said)


def _side(own: Acts) -> Fault | None:
    _, side = cue(own)
    found = _difference(side, Coefficient(0.0, 0.0)) if side else None
    if side is None or found is None:
        return None
    said = f"the {SIDES[0] if side.value > 0 else SIDES[1]} vehicle accelerates more"
    return Fault(SIDE, side.value, 0.0, found, found.p, said)


def _level(own: Acts, known: Humans) -> Fault | None:
    driver, human, found = _beside(own, known, "mean")
    if found is None:
        return None
    said = f"it accelerates {'less' if found.value < 0 else 'more'}"
    return Fault(LEVEL, driver, human, found, found.p, said)


def _late(own: Acts, known: Humans) -> Fault | None:
    """Both must be shown: that it holds more often, and that more acceleration follows."""
    driver, human, found = _beside(own, known, "hold")
    later = _delay(own)
    if found is None or later is None:
        return None
    of_humans = _delay(known.acts) if known.acts is not None else None
    follows = _difference(later, of_humans or Coefficient(0.0, 0.0))
    p = max(_greater(found), _greater(follows) if follows else float(later.value <= 0))
    return Fault(LATE, driver, human, found, p, "it acts late")


def _delay(found: Acts) -> Coefficient | None:
    """How much more it accelerates, either way, over the first second than at first."""
    apart = (np.abs(found.second) - np.abs(found.first))[:, found.sides]
    apart = np.where(np.abs(apart) < SAME_MPS2, 0.0, apart)  # else its error is as small
    counted = np.isfinite(apart)
    return clustered_mean(apart, counted, found.unit) if counted.any() else None


def _beside(own: Acts, known: Humans, measure: str) -> tuple[float, float, Difference | None]:
    """The driver's value, the humans' at the same relative velocities, and their difference."""
    values = MEASURES[measure](own.first[:, own.sides])
    shares = {v: float(own.at(v).mean()) for v in known.velocities}
    expected = np.sum([own.at(v) * _human(known, v, measure) for v in shares], axis=0)
    apart = clustered_mean(values - expected, np.ones_like(values, dtype=bool), own.unit)
    driver = float(values.mean())
    error = _error_at(known, shares, measure)
    return driver, driver - apart.value, _difference(apart, error)


def _human(known: Humans, velocity: float, measure: str) -> float:
    """What the humans' first actions of an own relative velocity come to."""
    if known.acts is not None:
        values = MEASURES[measure](known.acts.first[:, known.acts.sides])
        return float(values[known.acts.at(velocity)].mean())
    one = known.classes[velocity]
    return one.mean if measure == "mean" else one.hold


def _error_at(known: Humans, shares: Mapping[float, float], measure: str) -> Coefficient:
    """The error of the humans' value at these shares of the own relative velocities.

    The aggregates do not tell how those of one trial hang together: their errors are added up.
    """
    if known.acts is None:
        errors = (
            share * (one.se if measure == "mean" else sqrt(one.hold * (1 - one.hold) / one.n))
            for share, one in ((shares[v], one) for v, one in known.classes.items())
        )
        return Coefficient(0.0, sum(errors))
    values = MEASURES[measure](known.acts.first[:, known.acts.sides])
    apart = np.zeros(len(values))
    for velocity, share in shares.items():
        there = known.acts.at(velocity)
        apart += (
            share * np.where(there, values - values[there].mean(), 0.0).sum(axis=1) / there.sum()
        )
    sums = np.bincount(known.acts.unit, apart)
    units = len(np.unique(known.acts.unit))
    if units < 2:
        return Coefficient(0.0, None)
    return Coefficient(0.0, sqrt(float((sums**2).sum()) * units / (units - 1)), units - 1)


def _difference(first: Coefficient, second: Coefficient) -> Difference | None:
    """The first minus the second, or None where an error is not known or both are 0."""
    if first.se is None or second.se is None:
        return None
    errors = (first.se, first.freedom), (second.se, second.freedom)
    return difference(first.value - second.value, *errors)


def _greater(found: Difference) -> float:
    """The one-sided p of a difference above 0."""
    return found.p / 2 if found.value > 0 else 1 - found.p / 2
