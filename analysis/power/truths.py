"""How trials may really go: what data sets are simulated from."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from analysis.data.reference_data import HUMAN_GAP_SD_M, human_outcomes, published
from analysis.stats.many_fits import Array
from analysis.stats.regressions import GAP_TERMS, WHO_FIRST_TERMS
from merge_runner.planted_effect import PlantedEffect

SPEED = WHO_FIRST_TERMS.index("relative_velocity")
# The emulator's script aims at gaps from 1.8 to 6.5 m, all as likely; in one condition of every
# third repetition two vehicles collide.
SCRIPTED_GAP_M, SCRIPTED_GAP_SD_M = 4.15, 1.36
NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(41)


@dataclass(frozen=True, slots=True)
class Truth:
    """Coefficients of who merges first (Table III) and of the gap in m (Table IV).

    Gaps scatter normally by ``gap_sd_m``; ``collided`` is the share of trials that collide.
    ``noise`` is the standard deviation of what is added to the logit of each trial.
    """

    name: str
    who_first: tuple[float, ...]
    gap: tuple[float, ...]
    gap_sd_m: float
    collided: float
    noise: float = 0.0

    def chances_left(self, design: Array) -> Array:
        """The chance that the left vehicle merges first, for each row of a design."""
        logit = design @ np.array(self.who_first)
        shifted = expit(logit[:, None] + self.noise * NODES)
        return np.asarray(shifted @ (WEIGHTS / WEIGHTS.sum()))

    def with_who_first(self, term: int, value: float) -> Truth:
        """The same with another coefficient of who merges first."""
        return replace(self, who_first=_changed(self.who_first, term, value))

    def with_gap(self, term: int, value: float) -> Truth:
        """The same with another coefficient of the gap."""
        return replace(self, gap=_changed(self.gap, term, value))


def human() -> Truth:
    """The humans as they are published."""
    return Truth(
        "human",
        who_first=_coefficients("paper_who_first"),
        gap=_coefficients("paper_gap"),
        gap_sd_m=HUMAN_GAP_SD_M,
        collided=float((human_outcomes()["status"] == "collided").mean()),
    )


def without_relative_speed() -> Truth:
    """Humans whose order does not depend on the relative velocity."""
    return replace(human().with_who_first(SPEED, 0.0), name="no relative velocity")


def cei() -> Truth:
    """The driver ``cei``, a model of humans, as its simulated trials come to."""
    found = published("cei_outcomes").set_index(["measure", "term"])["value"].astype(float)
    return Truth(
        "cei",
        who_first=tuple(found["who_first"][list(WHO_FIRST_TERMS)]),
        gap=tuple(found["gap"][list(GAP_TERMS)]),
        gap_sd_m=found["gap", "residual_sd"],
        collided=found["collided", "share"],
    )


def supposed() -> tuple[Truth, ...]:
    """What is supposed of a driver of which nothing is known."""
    return human(), cei(), without_relative_speed()


def planted(effect: PlantedEffect) -> Truth:
    """The emulator with an effect."""
    return Truth(
        "as planted",
        who_first=effect.coefficients,
        gap=(SCRIPTED_GAP_M + effect.x_gap_m, 0.0, 0.0, 0.0),
        gap_sd_m=SCRIPTED_GAP_SD_M,
        collided=1 / 33,
        noise=effect.x_noise,
    )


def _coefficients(name: str) -> tuple[float, ...]:
    return tuple(map(float, published(name).query("driver == 'human'")["b"]))


def _changed(values: Iterable[float], at: int, value: float) -> tuple[float, ...]:
    return tuple(value if i == at else each for i, each in enumerate(values))
