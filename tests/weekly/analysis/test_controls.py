"""I5 tells controls that hold from those that move, as well as the docs say."""

import re

import pytest

from analysis.research import controls
from analysis.research.controls import CELLS, HELD, MOVING, NOISES_MPS, separation
from merge_runner_analysis.stats.held import gains
from tests.support.harness import PROJECT


@pytest.mark.parametrize("cell", CELLS, ids=str)
def test_held_accelerations_are_told_from_those_that_move(cell):
    assert separation(gains, HELD, MOVING, cell) >= 0.95
    if cell[1] <= 0.02:
        assert min(separation(gains, HELD, [moving], cell) for moving in MOVING) >= 0.95


@pytest.mark.parametrize("control", HELD + MOVING, ids=lambda control: control.__name__)
def test_0_is_the_border(control):
    for rate_hz in controls.RATES_HZ:
        held = controls.measured(gains, control, rate_hz, 0.0) > 0
        assert held.mean() > 0.9 if control in HELD else held.mean() < 0.25


def test_the_docs_print_what_the_controls_give():
    text = " ".join((PROJECT / "docs/numbers.md").read_text("utf-8").split())
    areas = [
        [float(cell) for cell in re.findall(r"\d\.\d\d(?= \|)", row)]
        for row in controls.candidates_table().splitlines()[2:]
    ]
    *_, gini, gain = [f"{min(of):.2f} to {max(of):.2f}" for of in areas]
    assert f"On simulated profiles with noise of up to {max(NOISES_MPS)} m/s, the gain" in text
    assert f"the area under its ROC curve is {gain}." in text
    assert f"For Gini's coefficient of |Δa| the area is {gini}." in text
    clocked = [float(row.split("|")[3].split(",")[0]) for row in _steady(controls.clock_table())]
    held = [gain for gain in clocked if gain > 0]
    several = f"{len(held)} of {len(clocked)} steadily changing profiles have mean gains of"
    assert f"{several} {min(held):.2f} to {max(held):.2f}." in text


def _steady(table: str) -> list[str]:
    return table.splitlines()[2 + len(HELD) :]
