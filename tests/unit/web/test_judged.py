"""The sentences on a driver beside people, with what is open."""

import pytest

from merge_runner_analysis.headlines import sentence


def verdicts(crashes="inconclusive", **states):
    """Verdicts by measure: of 50 of a driver's trials, of which 2 crashed; others as in humans."""
    names = ("headway", "velocity", "collisions", "gap", "gap-headway", "gap-velocity")
    of = {name: states.get(name.replace("-", "_"), "shown") for name in names}
    of["collisions"] = crashes
    rows = {name: {"measure": name, "state": state, "n": 50} for name, state in of.items()}
    rows["collisions"] |= {"k": 2, "undecided": None, "counted": "2 of 50"}
    return rows


@pytest.mark.parametrize(
    ("of", "ends"),
    [
        (verdicts(gap_headway="inconclusive"), "Cannot tell: crashes; gap, by who is ahead."),
        (verdicts("shown", gap_velocity="inconclusive"), " Cannot tell: gap, by who is faster."),
        (verdicts(), "Cannot tell: crashes."),
    ],
)
def test_all_that_cannot_be_told_is_in_one_list(of, ends):
    text = sentence(of)
    assert text.endswith(ends)
    assert text.count("Cannot tell") == 1


def test_a_driver_that_is_not_judged_says_why_alone():
    assert sentence({"": {"note": "not judged: why"}}) == "Not judged: why."
