"""What a dry run says that a run would take."""

from __future__ import annotations

from merge_runner.run.estimate import Estimate
from merge_runner.run.progress import estimate_lines


def expected(trials):
    return Estimate("o3", trials, 18 * trials, 0, 0, 0.0, None, 0.1 * trials, 0, True, False)


def test_a_study_whose_trials_are_all_stored_takes_nothing():
    assert [*estimate_lines(expected(0))] == ["driver  o3", "trials  none: all of them are stored"]


def test_a_study_says_how_many_trials_are_left():
    assert "trials  3 that have not ended yet" in [*estimate_lines(expected(3))]
