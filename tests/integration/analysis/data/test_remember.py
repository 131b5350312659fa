"""What is computed of a study is remembered as long as the study is used."""

from __future__ import annotations

import gc
import weakref

import pytest

from merge_runner_analysis import Study, table
from merge_runner_analysis.explain import explain
from merge_runner_analysis.figures.gallery import rendered
from merge_runner_analysis.stats.indicators import fits
from merge_runner_analysis.tables import TABLES, make_tables


def used(db):
    """References to a study and to its groups, after all of its tables have been made."""
    study = Study(db)
    for name in TABLES:
        table(study, name)
    for made in make_tables(study, ["who-first", "gap", "attempts", "verdicts"]):
        for row in made.rows:
            explain(study, made, row.id)
    rendered(study, "first-action", "svg")
    return [weakref.ref(one) for one in (study, *study.models, *study.asked)]


@pytest.mark.slow
def test_a_study_that_nobody_uses_is_freed(small):
    references = [one for _ in range(2) for one in used(small.db)]
    gc.collect()
    assert [one() for one in references if one() is not None] == []


def test_what_is_computed_of_a_group_is_computed_once(small):
    (group,) = small.models
    assert fits(group) is fits(group)
    assert fits(group) is not fits(small.human)
