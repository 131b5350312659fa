"""What is said of odd databases is true of them."""

from __future__ import annotations

import html
import re

import pytest

from merge_runner_analysis.data.study import Study
from merge_runner_analysis.report.page import report_html
from merge_runner_analysis.tables import make_tables
from tests.support import odd_databases
from tests.support.odd_databases import KINDS, made

# What the report of a kind says, and what it must not say.
SAID = {
    "two_trials": (
        [
            "o3: 2 finished trials, too few to say whether it drives like humans.",
            "ollisions: inconclusive.",
        ],
        ["o3 does not drive", "o3 collides"],
    ),
    "stand_in_behind_o3": (
        [
            "A scripted stand-in answered",
            ": scripted stand-in, not o3",
            "No language model is judged here.",
        ],
        ["o3 does not drive", ">o3</td>"],
    ),
    "another_endpoint": (["o3 at localhost:8080"], [">o3</td>"]),
    "partial_import": (["humans (129 of 990 imported)", "5 pairs"], ["are not imported"]),
    "complete_import": (["Collisions and mean gap: inconclusive."], ["are not imported"]),
    "other_vehicle_length": (["vehicle_length_m = 8.0"], []),
    "temperature": (["temperature = 0.2"], ["no temperature", "default sampling temperature"]),
    "programs": (
        [
            "projected-order/baseline: 11 of 22 trials of programs repeat an earlier one",
            "* emulator+constant: scripted stand-in, no language model",
            "No language model is judged here.",
        ],
        ["A scripted stand-in answered"],
    ),
    "only_failed": (
        ["No language model can be compared with humans yet.", "Trials failed"],
        ["o3 does not drive"],
    ),
    "killed": (
        [
            "o3: 2 finished trials, too few to say whether it drives like humans.",
            "ollisions: inconclusive.",
        ],
        ["o3 does not drive", "o3 collides"],
    ),
    "word_for_word": (
        ["o3/baseline: 22 of 33 trials are as an earlier one to the last state; each counts"],
        ["they are left out"],
    ),
    "two_studies": (
        [
            "No language model is judged here.",
            "trials of several studies: ",
            "A difference between trials of different studies has no p",
        ],
        [],
    ),
    "crossed_programs": (
        [
            "human-odds: 44 of 88 trials of programs at different levels of factors are distinct",
            "idm/baseline: 30 of 44, idm/A1: 30 of 44 trials of programs repeat an earlier one",
            "No language model is judged here.",
        ],
        ["A scripted stand-in answered"],
    ),
    "mirrored_chance": (
        ["13 of 119 trials are undecided, since another collision rule ended them"],
        ["declare no chance"],
    ),
    "no_valid_reply": (
        [
            "Too few valid decisions",
            "smollm2-free/baseline: Not judged: 92 of the 92 decisions of smollm2-free are invalid "
            "(100.0 %, more than 20 %)",
            "No language model is judged here.",
        ],
        ["smollm2-free collides", "Many fallbacks", "p < 0.001"],
    ),
    "separated": (["o3/baseline: "], ["effect of headway on who merges first"]),
    # Half of its trials do nothing: what does nothing is not late.
    "all_tied": (["o3/baseline: "], ["acts late"]),
}


def test_every_kind_is_looked_at():
    assert list(SAID) == list(KINDS)


@pytest.fixture
def in_one_process(prepare, emulator_url, monkeypatch):
    """Sweeps ask the emulator of all tests, without a process of their own."""

    def run(db, *arguments, **changes):
        done = prepare(db.parent, *arguments, "--db", db.name, **changes)
        assert done.code == 0, done.err

    monkeypatch.setattr(odd_databases, "_run", run)
    monkeypatch.setattr(odd_databases, "_emulator", lambda: emulator_url.removesuffix("/v1"))


@pytest.mark.slow
@pytest.mark.usefixtures("in_one_process")
@pytest.mark.parametrize("kind", KINDS)
def test_the_report_of_an_odd_database_says_what_is_true_of_it(kind, tmp_path):
    study = Study(made(tmp_path, kind))
    page = html.unescape(report_html(study, make_tables(study, ["ablation-quantitative"]), {}))
    said, unsaid = SAID[kind]
    text = re.sub(r"\s+", " ", page)
    assert [words for words in said if words not in text] == []
    assert [words for words in unsaid if words in text] == []
