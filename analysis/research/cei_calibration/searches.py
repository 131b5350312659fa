"""The search for each set of thresholds: start, seed and targets."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from analysis.research.cei_calibration.design import experiment
from analysis.research.cei_calibration.search import Generation, search, targets
from merge_runner.config import Resistance
from merge_runner.drivers.cei.parameters import ThresholdSet


@dataclass(frozen=True, slots=True)
class SetSearch:
    """The search for a set; its numbers are where it stood after the last generation.

    Without ``first_action`` it looks for the published outcomes alone.
    """

    start: ThresholdSet
    seed: int
    resistance: Resistance = "human"
    first_action: bool = True
    generations: int = 10
    size: int = 20
    trials_of_a_pair: int = 5

    def run(self) -> Iterator[Generation]:
        """Search anew; the same each time."""
        return search(
            self.start,
            experiment(self.resistance),
            [target for target in targets() if self.first_action or target.origin == "model"],
            generations=self.generations,
            size=self.size,
            seed=self.seed,
            trials_of_a_pair=self.trials_of_a_pair,
        )


# Each began where a shorter search had ended.
SEARCHES = {
    "K0": SetSearch(
        ThresholdSet(
            *(0.4188, 0.3511, 0.1371, 0.0227),
            *(0.0158, -0.0721, -0.0130, 0.0434, 0.0616, 0.0109),
        ),
        seed=3,
    ),
    "F1": SetSearch(
        ThresholdSet(
            *(0.0839, 0.8586, 0.0589, 0.0768),
            *(-0.0186, -0.0319, 0.0156, 0.0725, 0.1169, -0.0414),
        ),
        seed=1,
        first_action=False,
    ),
    "drag-free": SetSearch(
        ThresholdSet(
            *(0.4038, 0.3510, 0.1184, 0.0129),
            *(0.0127, -0.0696, -0.0089, 0.0407, 0.0521, 0.0085),
        ),
        seed=2,
        resistance="none",
    ),
}
