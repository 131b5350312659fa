"""What is not true of odd databases is not said of them."""

from __future__ import annotations

import pytest

from merge_runner_analysis.data.study import Study
from merge_runner_analysis.tables import make_tables
from tests.support.odd_databases import made


@pytest.mark.parametrize(
    ("kind", "unsaid"),
    [
        ("separated", "effect of headway on who merges first"),
        # Half of its trials do nothing: what does nothing is not late.
        ("all_tied", "acts late"),
    ],
)
def test_no_sentence_says_what_the_trials_do_not_show(kind, unsaid, tmp_path):
    (table,) = make_tables(Study(made(tmp_path, kind)), ["verdicts"])
    said = [note for note in table.notes if note.startswith("o3/baseline: ")]
    assert said
    assert unsaid not in " ".join(said)
