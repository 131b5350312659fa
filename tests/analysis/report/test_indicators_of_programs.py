"""What a report says of I4 and I5, of programs known to hold, to move and to do nothing."""

from __future__ import annotations

import re

import pytest

from merge_runner_analysis.data.provenance import provenance
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.report.conclusions import not_shown, shown
from merge_runner_analysis.stats.group_scores import score
from merge_runner_analysis.stats.indicators import Verdict
from merge_runner_analysis.stats.likeness import gains
from merge_runner_analysis.tables import make_tables

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
    (sentence,) = [s for s in shown(study) if s.startswith("idm: at 4 m of projected headway")]
    assert "by +2.25 m from a relative velocity of -0.8 to one of 0.8 m/s" in sentence
    assert "all terms with it jointly: p < 0.001" in sentence
    assert "a difference of 1 m is shown" in sentence
    assert "idm shows, by both rules: the gap does not depend" not in " ".join(shown(study))


def test_idm_moves_and_projected_order_holds(study):
    for program, passed in (("idm", False), ("projected-order", True)):
        assert score(study, group_of(study, program)).robust["I5"] == Verdict(passed)


def test_no_sentence_on_i5_is_the_same_for_one_that_holds_and_one_that_moves(study):
    """Nor is any note of a table: with the names of drivers taken out."""
    texts = [*shown(study), *not_shown(study, provenance(study.db))]
    for table in make_tables(study, ["indicators", "velocity-profiles", "ablation-qualitative"]):
        texts += [f"{row.groups[0]}: {part}" for row in table.rows for part in row.note.split("; ")]
    said = {
        program: {
            text.replace(program, "")
            for text in texts
            if text.startswith(program) and re.search("I5|piecewise", text)
        }
        for program in PROGRAMS
    }
    assert all(said.values())
    for one in PROGRAMS:
        for other in set(PROGRAMS) - {one}:
            assert not said[one] & said[other]


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
