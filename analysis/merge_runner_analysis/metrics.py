"""The list of metrics: the value of each trial, its summary, and where that is shown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from merge_runner.errors import UsageError
from merge_runner.registry import Registry
from merge_runner.scenarios.merge.measures import NO_CONFLICT_MPS

Estimator = Literal["proportion", "mean", "median"]
# The estimators of the metrics that a place shows. tables: Tables V and VII, the contrasts and the
# pages made of these; criticality: the table of this name.
SHOWN = {"tables": ("proportion", "mean"), "criticality": ("median",)}
# The trials that a metric may be of, in SQL.
STATUS = {"finished": "status = 'finished'", "ended": "status <> 'failed'"}
# Decimals of every printed measure, its interval and its differences.
DECIMALS = 2
INTERVALS = "Wilson for rates, Student's t for means, order statistics for medians"
# Values that the analysis adds to each trial, as no column of the database has them: whether it
# collided by the rule of its scenario, and by the human rule.
JUDGED = ("collided", "collided_boxes")


@dataclass(frozen=True, slots=True, kw_only=True)
class Metric:
    """A number of each trial, and how it is summarised. Raises UsageError where these disagree.

    ``name`` ends with the unit. ``value`` is SQL over the columns of ``trials`` and
    ``trial_metrics``, or one of JUDGED; a subquery over another table knows the trial as
    ``trials.trial_id`` and ``trials.spec_hash``. A proportion is of a BOOLEAN. ``trials`` are those
    that count, unless their value is NULL; ``weight`` is SQL of how much a trial counts in a mean.
    ``meaning`` describes one trial's number, or the share of a proportion; intervals and
    axes begin at ``least`` or above. ``paper_of_drivers`` and ``paper_of_humans`` are columns of
    ``paper_ablation_quantitative.csv``.
    """

    name: str
    label: str
    unit: str
    meaning: str
    value: str
    weight: str = ""
    estimator: Estimator = "mean"
    trials: Literal["finished", "ended"] = "finished"
    paper_of_drivers: str = ""
    paper_of_humans: str = ""
    shown: bool = True
    least: float | None = None

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise UsageError(f"the metric {self.name!r} needs a name of letters, digits and _")
        if self.value in JUDGED and self.trials != "ended":
            raise UsageError(f"the metric {self.name!r} is {self.value}: it needs trials='ended'")

    @property
    def heading(self) -> str:
        """``gap (m)``."""
        return f"{self.label} ({self.unit})"

    @property
    def rate(self) -> bool:
        """True if it is a share, in percent."""
        return self.estimator == "proportion"

    @property
    def column(self) -> str:
        """The column of the trials that holds its value, missing where a trial does not count."""
        return self.value if self.value in JUDGED else f"counted_{self.name}"

    @property
    def weight_column(self) -> str:
        """The column of the trials that holds its weight."""
        return f"weight_{self.name}"

    @property
    def selected(self) -> str:
        """Its columns as expressions of SQL over ``trials JOIN trial_metrics``."""
        typed = f"({self.value})::{'BOOLEAN' if self.rate else 'DOUBLE'}"
        is_known = f"{self.value} IS NOT NULL"
        if not self.value.isidentifier():  # what is no finite number is no value
            is_known = f"({self.value}) IS NOT NULL" if self.rate else f"isfinite({typed})"
        weight = f", ({self.weight})::DOUBLE AS {self.weight_column}" if self.weight else ""
        counts = f"{STATUS[self.trials]} AND {is_known}"
        return f"CASE WHEN {counts} THEN {typed} END AS {self.column}{weight}"


METRICS = Registry[Metric]("metric")


def register(metric: Metric) -> Metric:
    """Add a metric to the list; raises UsageError where its name is taken."""
    return METRICS.register(metric.name, metric)


def shown_in(place: str) -> list[Metric]:
    """Return the metrics that a place of SHOWN has, in the order of the list."""
    return [
        metric for metric in METRICS.values() if metric.shown and metric.estimator in SHOWN[place]
    ]


COLLISIONS = Metric(
    name="collided_percent",
    label="coll.",
    unit="%",
    meaning="share of ended trials with a collision by the rule of their scenario, checked "
    "at its steps (the paper's: centres closer than a vehicle length, every 0.2 s)",
    value="collided",
    estimator="proportion",
    trials="ended",
    paper_of_drivers="collided_percent",
)
BOXES = Metric(
    name="collided_boxes_percent",
    label="coll. outlines",
    unit="%",
    meaning="share of ended trials with a collision by the rule of the human experiment: "
    "outlines that overlap, checked at 20 Hz",
    value="collided_boxes",
    estimator="proportion",
    trials="ended",
    paper_of_humans="collided_percent",
)
LEFT_FIRST = Metric(
    name="left_first_percent",
    label="goes first",
    unit="%",
    meaning="share of finished trials in which the driver under study merged first (the ego; of "
    "two equal drivers the one that alone gets words, else the left one, or half for each)",
    value="merged_first = 'left'",
    estimator="proportion",
    shown=False,
)
GAP = Metric(
    name="gap_m",
    label="gap",
    unit="m",
    meaning="net gap when the first vehicle reaches the merge point",
    value="gap_m",
    paper_of_drivers="gap_m",
    paper_of_humans="gap_m",
)
RMSE = Metric(
    name="rmse_mps",
    label="RMSE",
    unit="m/s",
    meaning="RMSE of the speed from the initial speed, mean of both vehicles, to the first merge",
    value="rmse_mps",
    least=0.0,
    paper_of_drivers="rmse_mps",
    paper_of_humans="rmse_mps",
)
JOINT = Metric(
    name="joint_percent",
    label="joint",
    unit="%",
    meaning="share of finished trials with an RMSE of at least 0.5 m/s on both sides",
    value="joint",
    estimator="proportion",
    paper_of_drivers="joint_percent",
    paper_of_humans="joint_percent",
)
VALID = Metric(
    name="valid_percent",
    label="valid replies",
    unit="%",
    meaning="share of replies with a valid plan; of two different drivers, the replies to the one "
    "that is named first",
    value="100 * valid_replies / nullif(replies, 0)",
    weight="replies",
    trials="ended",
    shown=False,
    least=0.0,
)
COST = Metric(
    name="cost_usd",
    label="cost",
    unit="USD",
    meaning="price of the calls of a trial; none where a price is not known",
    value="cost_usd",
    trials="ended",
    shown=False,
    least=0.0,
)
# Surrogate measures of safety: columns of ``trial_metrics``, summed up by their medians.
SURROGATES = {
    "conflict_resolution_s": (
        "conflict resolution",
        "until the vehicles are first off a collision course",
    ),
    "time_to_merge_s": ("time to merge", "until the first vehicle reaches the merge point"),
    "post_encroachment_s": (
        "PET",
        "from when the first vehicle has left the merge point to when the second reaches it",
    ),
    "min_ttc_s": (
        "min. TTC",
        "smallest time to collision after the first merge, where the vehicles close in faster than "
        f"{NO_CONFLICT_MPS} m/s",
    ),
    "max_acceleration_mps2": ("max |a|", "largest absolute acceleration of either vehicle"),
}
for _metric in (COLLISIONS, BOXES, LEFT_FIRST, GAP, RMSE, JOINT, VALID, COST):
    register(_metric)
for _name, (_label, _meaning) in SURROGATES.items():
    _unit = "m/s²" if _name.endswith("_mps2") else "s"
    register(
        Metric(
            name=_name,
            label=_label,
            unit=_unit,
            meaning=_meaning,
            value=_name,
            estimator="median",
            least=0.0,
        )
    )
RULES_NOTE = (
    f"{COLLISIONS.heading}: by the rule of the trials' scenario, in the paper centres closer than "
    f"a vehicle length at a step of 0.2 s; {BOXES.heading}: by the rule of the human experiment, "
    "outlines that overlap, checked at 20 Hz, the one by which drivers are compared with humans. A "
    "rate with undecided trials has no value and is not compared; its interval holds whether all "
    "of them collide or none (Manski 1989)"
)
