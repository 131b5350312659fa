"""The numbers of cei that ship, and those that the docs give, are what its trials come to."""

import re
import subprocess
import sys

import pytest
from scipy import stats

from analysis.power.truths import cei
from analysis.stats.regressions import gap_ols, who_first_logit
from merge_runner_cei.calibration.shipped import GAP, SAMPLE_SETS, trials
from tests.harness import PROJECT, environment


@pytest.mark.slow
def test_the_shipped_outcomes_of_cei_are_those_of_its_trials():
    """If the thresholds of cei have changed: python -m merge_runner_cei.calibration outcomes."""
    played = trials(SAMPLE_SETS[:1], each=3)
    logit, gap = who_first_logit(played), gap_ols(played, GAP)
    shipped = cei()
    for values, fit in ((shipped.who_first, logit), (shipped.gap, gap)):
        for value, term in zip(values, fit.terms.values(), strict=True):
            assert abs(value - term.b) < 3 * term.se
    low, high = stats.binom.interval(0.99, len(played), shipped.collided)
    assert low <= (played["status"] == "collided").sum() <= high


@pytest.mark.long
@pytest.mark.parametrize(
    ("column", "command"),
    [(3, ["K0"]), (4, ["F1"]), (5, ["drag-free"]), (6, ["K0", "--tunnel"])],
)
def test_what_the_driver_cei_comes_to(column, command):
    program = [sys.executable, "-m", "merge_runner_cei.calibration", "check", *command]
    done = subprocess.run(
        program, cwd=PROJECT, env=environment(), capture_output=True, text=True, check=True
    )
    # Each line ends with the mean, its spread, the tolerance and by how many of these it is off.
    found = [tuple(map(float, line.split()[-4:-2])) for line in done.stdout.splitlines()[1:]]
    text = (
        (PROJECT / "docs/reference/cei.md")
        .read_text(encoding="utf-8")
        .replace("\N{MINUS SIGN}", "-")
    )
    rows = re.findall(r"^\| (?:collisions|time-outs|who|gap|largest|conflict|first).*", text, re.M)
    cells = [re.split(r"(?<!\\)\|", row)[column].replace("*", "") for row in rows]
    shown = [tuple(map(float, re.findall(r"-?\d+(?:\.\d+)?", cell))) for cell in cells]
    # Counts are shown with one decimal of two.
    assert shown[:2] == [pytest.approx(pair, abs=0.051) for pair in found[:2]]
    assert shown[2:] == found[2:]
