"""What is said of odd databases is true of them."""

from __future__ import annotations

import html
import re

import pytest

from merge_runner_analysis.data.study import Study
from merge_runner_analysis.report.page import report_html
from merge_runner_analysis.tables import make_tables
from tests.support.odd_databases import made

# What the report of a kind says, and what it must not say.
SAID = {
    "killed": (
        [
            "o3: 2 finished trials, too few to say whether it drives like humans.",
            "ollisions: inconclusive.",
            "vehicle_length_m = 8.0",
            "temperature = 0.2",
        ],
        ["o3 does not drive", "o3 collides", "no temperature", "default sampling temperature"],
    ),
    "stand_in_behind_o3": (
        [
            "A scripted stand-in answered",
            ": scripted stand-in, not o3",
            "No language model is judged here.",
            ">o3*</td>",
        ],
        ["o3 does not drive"],
    ),
    "only_failed": (
        ["No language model can be compared with humans yet.", "Trials failed"],
        ["o3 does not drive"],
    ),
}


@pytest.mark.parametrize("kind", SAID)
def test_the_report_of_an_odd_database_says_what_is_true_of_it(kind, tmp_path):
    study = Study(made(tmp_path, kind))
    page = report_html(study, make_tables(study, ["ablation-quantitative"]), {})
    text = re.sub(r"\s+", " ", html.unescape(page))
    said, unsaid = SAID[kind]
    assert [words for words in said if words not in text] == []
    assert [words for words in unsaid if words in text] == []
