"""What is said of odd databases is true of them."""

from __future__ import annotations

import html
import re

import pytest

from merge_runner_analysis.data.study import Study
from merge_runner_analysis.report.page import report_html
from merge_runner_analysis.tables import make_tables
from tests.analysis import odd_databases
from tests.analysis.odd_databases import KINDS, made

# What the report of a kind says, and what it must not say.
SAID = {
    "two_trials": (
        [
            "o3 collided, by boxes that overlap, in 0.0 % of 2 trials (95 % CI 0.0 to 65.8)",
            "too few or in too few conditions",
        ],
        ["evidence against the driver"],
    ),
    "stand_in_behind_o3": (
        [
            "A scripted stand-in answered",
            ": scripted stand-in, not o3",
            "Nothing: with the baseline prompt only scripted stand-ins drove.",
        ],
        ["o3 collided", "o3 leaves", "o3 shows", ">o3</td>"],
    ),
    "another_endpoint": (
        ["o3 at localhost:8080 collided, by boxes that overlap, in"],
        [">o3</td>"],
    ),
    "partial_import": (
        [
            "humans (129 of 990 imported)",
            "of 5 pairs",
            "humans in 2.8 % of 990 in the same 11 conditions",
            "Fisher's exact test, all trials taken as independent",
        ],
        ["The human recordings are not imported"],
    ),
    "complete_import": (
        [
            "humans 12.93 m in 962 imported trials of the same 11 conditions",
            "; errors clustered by 9 pairs), p = ",
        ],
        [
            "The human recordings are not imported",
            "which pair drove is not published",
            "Fisher's exact test",
        ],
    ),
    "other_vehicle_length": (["o3: its task is not the default one: vehicle_length_m = 8.0."], []),
    "temperature": (["temperature = 0.2"], ["no temperature", "default sampling temperature"]),
    "programs": (
        [
            "11 of 22 trials of projected-order/baseline repeat an earlier one",
            "projected-order collided, by boxes that overlap, in 0.0 % of 11 trials",
            "projected-order is a program",
            "* emulator+constant: scripted stand-in, no language model",
        ],
        ["temperature", "A scripted stand-in answered"],
    ),
    "only_failed": (["o3: no trial ended (11 failed).", "Trials failed"], ["o3 collided"]),
    "killed": (
        ["o3 collided, by boxes that overlap, in 0.0 % of 2 trials"],
        ["evidence against the driver"],
    ),
    "word_for_word": (
        [
            "o3/baseline: 22 of 33 trials are as an earlier one to the last state; each counts",
            "0.0 % of 33 trials",
        ],
        ["% of 11 trials", "repeat an earlier one", "no chance"],
    ),
    "two_studies": (
        [
            "Nothing: with the baseline prompt only scripted stand-ins drove.",
            "trials of several studies: ",
            "No p is given for a difference across studies",
        ],
        [],
    ),
    "mirrored_chance": (
        [
            "who merged first is the same in all 104 trials: nothing to explain",
            "95 of 220 trials are undecided, since another collision rule ended them",
        ],
        ["repeat an earlier one"],
    ),
    "no_valid_reply": (
        [
            "Too few valid decisions",
            "smollm2-free/baseline: not judged: 92 of the 92 decisions of smollm2-free are invalid "
            "(100.0 %, more than 20 %)",
            "Nothing: of the drivers with the baseline prompt too many decisions are invalid.",
        ],
        ["smollm2-free collided", "Many fallbacks", "p < 0.001"],
    ),
    "separated": (
        [
            "I1, I2 cannot be judged by the paper's test: separation",
            "o3: a difference from the humans in who merges first cannot be estimated: separation",
        ],
        ["effect of headway on who merges first"],
    ),
    # Half of its trials do nothing: what does nothing is not late.
    "all_tied": (["on average of 22 trials"], ["acts late"]),
}


def test_every_kind_is_looked_at():
    assert list(SAID) == list(KINDS)


@pytest.fixture
def forked(prepare, emulator_url, monkeypatch):
    """Sweeps are forked and ask the emulator of all tests: most of their time is imports."""

    def run(db, *arguments, **changes):
        done = prepare(db.parent, *arguments, "--db", db.name, **changes)
        assert done.code == 0, done.err

    monkeypatch.setattr(odd_databases, "_run", run)
    monkeypatch.setattr(odd_databases, "_emulator", lambda: emulator_url.removesuffix("/v1"))


@pytest.mark.slow
@pytest.mark.usefixtures("forked")
@pytest.mark.parametrize("kind", KINDS)
def test_the_report_of_an_odd_database_says_what_is_true_of_it(kind, tmp_path):
    study = Study(made(tmp_path, kind))
    page = html.unescape(report_html(study, make_tables(study, ["ablation-quantitative"]), {}))
    said, unsaid = SAID[kind]
    text = re.sub(r"\s+", " ", page)
    assert [words for words in said if words not in text] == []
    assert [words for words in unsaid if words in text] == []
