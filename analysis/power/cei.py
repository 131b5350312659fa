"""What the driver ``cei`` comes to; ``python -m analysis.power.cei`` prints the shipped file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import pandas as pd

from analysis.calibration.design import TRIALS_OF_A_PAIR, design, experiment, model_of
from analysis.calibration.outcomes import measured
from analysis.stats.regressions import gap_data, gap_ols, who_first_logit
from merge_runner.cli.output import print_out
from merge_runner.drivers.cei.batch import simulate
from merge_runner.drivers.cei.driver import USUAL_SETS
from merge_runner.drivers.cei.parameters import SETS

SAMPLE_SETS = (0, 1)
GAP = "gap_mean100_m"


def trials(sample_sets: Iterable[int], each: int = TRIALS_OF_A_PAIR) -> pd.DataFrame:
    """Trials of these sample sets, ``each`` of a pair in a condition, under human resistance."""
    scenario, thresholds = experiment("human"), SETS[USUAL_SETS["human"]]
    model = model_of(thresholds, scenario)
    drawn = [one for number in sample_sets for one in design(thresholds, scenario, number, each)]
    return measured(model.task, drawn, simulate(model, drawn))


def outcomes(played: pd.DataFrame) -> Iterator[tuple[str, str, float]]:
    """The rows of the file: measure, term, value."""
    yield "collided", "share", float((played["status"] == "collided").mean())
    for measure, fit in (("who_first", who_first_logit(played)), ("gap", gap_ols(played, GAP))):
        yield from ((measure, name, term.b) for name, term in fit.terms.items())
    x, gap_m, _ = gap_data(played, GAP)
    left_over = gap_m - x @ np.linalg.lstsq(x, gap_m, rcond=None)[0]
    freedom = len(gap_m) - x.shape[1]
    yield "gap", "residual_sd", float(np.sqrt((left_over**2).sum() / freedom))


if __name__ == "__main__":
    print_out("measure,term,value")
    for measure, term, value in outcomes(trials(SAMPLE_SETS)):
        print_out(f"{measure},{term},{value:.4f}")
