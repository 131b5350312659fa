"""What the driver ``cei`` comes to: the numbers of ``analysis/data/cei_outcomes.csv``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import pandas as pd

from analysis.stats.regressions import gap_data, gap_ols, who_first_logit
from merge_runner_cei.batch import simulate
from merge_runner_cei.calibration.design import TRIALS_OF_A_PAIR, design, experiment, model_of
from merge_runner_cei.calibration.outcomes import measured
from merge_runner_cei.driver import USUAL_SETS
from merge_runner_cei.parameters import SETS

SAMPLE_SETS = (0, 1)
GAP = "gap_mean100_m"


def trials(sample_sets: Iterable[int], each: int = TRIALS_OF_A_PAIR) -> pd.DataFrame:
    """Trials of these sample sets, ``each`` of a pair in a condition, under human resistance."""
    scenario, thresholds = experiment("human"), SETS[USUAL_SETS["human"]]
    model = model_of(thresholds, scenario)
    drawn = [one for number in sample_sets for one in design(thresholds, scenario, number, each)]
    return measured(model.task, drawn, simulate(model, drawn))


def rows(played: pd.DataFrame) -> Iterator[tuple[str, str, float]]:
    """Yield the rows of the file: measure, term, value."""
    yield "collided", "share", float((played["status"] == "collided").mean())
    for measure, fit in (("who_first", who_first_logit(played)), ("gap", gap_ols(played, GAP))):
        yield from ((measure, name, term.b) for name, term in fit.terms.items())
    x, gap_m, _ = gap_data(played, GAP)
    left_over = gap_m - x @ np.linalg.lstsq(x, gap_m, rcond=None)[0]
    freedom = len(gap_m) - x.shape[1]
    yield "gap", "residual_sd", float(np.sqrt((left_over**2).sum() / freedom))
