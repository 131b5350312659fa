"""What a report says of I4 and I5, of programs known to hold, to move and to do nothing."""

from __future__ import annotations

import pytest

from merge_runner_analysis.data.study import Study
from merge_runner_analysis.stats.indicators import Verdict, gains, score

pytestmark = pytest.mark.slow
PROGRAMS = ("constant", "idm", "projected-order")
# A trial that starts when the first of the two is under control, and a drag to drive against.
DRAG = """
models = ["constant+projected-order"]
repetitions = 1
conditions = ["L_4_-8", "R_-4_8"]
[scenario]
resistance = "human"
control_start = "own_exit"
"""


@pytest.fixture(scope="module")
def study(prepare, tmp_path_factory):
    folder = tmp_path_factory.mktemp("programs")
    for program in PROGRAMS:
        run = prepare(folder, "sweep", "baseline", "--model", program, "--reps", 1, "--db", "t.db")
        assert run.code == 0, run.err
    return Study(folder / "t.db")


def group_of(study, program):
    return next(group for group in study.models if group.models[0] == program)


def test_idm_whose_gap_depends_on_who_is_faster_fails_i4(study):
    found = score(study, group_of(study, "idm"))
    assert (found.paper["I4"], found.robust["I4"]) == (Verdict(True), Verdict(False))


def test_idm_moves_and_projected_order_holds(study):
    for program, passed in (("idm", False), ("projected-order", True)):
        assert score(study, group_of(study, program)).robust["I5"] == Verdict(passed)


def test_neither_drag_nor_the_cruise_before_control_passes_for_an_action(prepare, tmp_path):
    (tmp_path / "drag.toml").write_text(DRAG)
    run = prepare(tmp_path, "sweep", "drag.toml", "--db", "t.db")
    assert run.code == 0, run.err
    study = Study(tmp_path / "t.db")
    (group,) = study.models
    profiles = study.profiles_of(group)
    constant = profiles[profiles["side"] == "left"]
    assert constant["steady"].all()
    assert constant["gain"].isna().all()
    assert not gains(study, group)["steady"].any()
