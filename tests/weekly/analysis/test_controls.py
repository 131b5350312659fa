"""I5 tells controls that hold from those that move, as well as the docs say."""

import pytest

from analysis.research import controls
from analysis.research.controls import CELLS, HELD, MOVING, separation
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
    text = (PROJECT / "docs/reference/analysis.md").read_text("utf-8")
    for table in (controls.candidates_table, controls.controls_table, controls.clock_table):
        assert table() in text
    at_random = "by chance each second, held, have a mean gain of 0.49 over 10 s"
    assert at_random in " ".join(text.split())
