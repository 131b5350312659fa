"""What a page of a trial holds that needs no server, and what is marked in a prompt."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from merge_runner_analysis.explorer.pages.trial import decision_fragment, whole_panels
from merge_runner_analysis.explorer.prompts import parts_of
from merge_runner_analysis.explorer.site import Site
from merge_runner_analysis.explorer.views import read_trial

WORDS = st.lists(st.sampled_from(["give", "way", ",", "3.5", "\n", "m/s"])).map(" ".join)


@pytest.fixture
def site(study):
    site = Site(study)
    site.catalogue.refresh()
    yield site
    site.close()


def test_the_panels_of_a_whole_trial_are_those_that_a_server_shows(site):
    panels = 0
    for row in site.catalogue.every({}):
        key = row["trial_id"], row["spec_hash"]
        trial = read_trial(site.db, *key)
        for name, panel in whole_panels(site, row, trial).items():
            side, number = name.split("/")
            asked = {"spec": row["spec_hash"], "side": side, "decision": number}
            assert panel == decision_fragment(site, row["trial_id"], asked)
            panels += 1
    assert panels > 50


@given(WORDS, WORDS)
def test_a_compared_prompt_holds_the_prompt_in_order(before, now):
    pieces = [piece for part in parts_of(now, before) for piece in part.pieces]
    kept = "".join(text for change, text in pieces if change != "gone")
    assert kept.split() == now.split()


def test_only_what_changed_is_marked_in_a_line_of_many_equal_words():
    (part,) = parts_of(
        "I see a car. " * 500 + "It is 7 m ahead.", "I see a car. " * 500 + "It is 9 m ahead."
    )
    assert [(c, t.strip()) for c, t in part.pieces if c != "same"] == [("gone", "9"), ("new", "7")]
