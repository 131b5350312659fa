"""What an export packs is what the pages of a server show, each text that comes again only once."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from analysis.explorer.catalogue import Filter
from analysis.explorer.details import read_decision, read_trial, read_whole
from analysis.explorer.export import export_folder
from analysis.explorer.packing import SHARED, SharedTexts, pack_trials
from analysis.explorer.packing_processes import packing
from analysis.explorer.pages.trial import panel_values
from analysis.explorer.prompts import parts_of
from analysis.explorer.site import Site
from analysis.explorer.urls import StaticLinks
from merge_runner.errors import UsageError
from tests.explorer.packed import unpacked

TEXTS = st.lists(st.sampled_from(["a", "b" * SHARED, "c" * SHARED, "d" * 2 * SHARED, ""]))
WORDS = st.lists(st.sampled_from(["give", "way", ",", "3.5", "\n", "m/s"])).map(" ".join)


@pytest.fixture
def exporting(study):
    """A site of files, and the trials of the study."""
    site = Site(study, StaticLinks())
    site.catalogue.refresh()
    yield site, site.catalogue.every(Filter())
    site.close()


def whole(pieces, shared):
    """Pieces with the shared texts in their places."""
    return "".join(shared[one] if isinstance(one, int) else one for one in pieces)


@given(st.lists(TEXTS, max_size=4))
def test_shared_texts_in_their_places_make_the_pages_again(pages):
    shared = SharedTexts()
    packed = [shared.pieces(texts) for texts in pages]
    assert [whole(pieces, shared.texts) for pieces in packed] == ["".join(page) for page in pages]
    assert len(shared.texts) == len(set(shared.texts))


def test_a_long_text_that_comes_again_is_only_named():
    shared, long = SharedTexts(), "You drive a car towards a merge point. "
    assert shared.pieces([long, "1"]) == [f"{long}1"]
    assert shared.pieces([long, "2"]) == [0, "2"]
    assert shared.texts == [long]


def test_many_trials_are_read_as_each_alone(exporting):
    site, rows = exporting
    keys = [(row["trial_id"], row["spec_hash"]) for row in rows]
    assert len(keys) > 5
    for key, (trial, decisions) in zip(keys, read_whole(site.db, keys), strict=True):
        alone = read_trial(site.db, *key)
        assert (trial.states, trial.paces) == (alone.states, alone.paces)
        assert [(d["side"], d["decision"]) for d in alone.decisions] == list(decisions)
        for row, listed in zip(alone.decisions, trial.decisions, strict=True):
            assert row == {name: listed[name] for name in row}
        for (side, number), decision in decisions.items():
            assert decision == read_decision(site.db, *key, side, number)


def test_packed_panels_are_those_that_a_server_shows(exporting):
    site, rows = exporting
    found = pack_trials(site, rows, site.catalogue.others)
    shared, panels = unpacked(found["shared"]), 0
    for row, text in zip(rows, found["trials"], strict=True):
        trial = read_trial(site.db, row["trial_id"], row["spec_hash"])
        for name, pieces in unpacked(text)["panels"].items():
            side, number = name.split("/")
            one = read_decision(site.db, row["trial_id"], row["spec_hash"], side, int(number))
            values = panel_values(site, row, trial, one, site.catalogue.others)
            assert whole(pieces, shared) == site.render("_decision.html", **values)
            panels += 1
    assert panels > 50
    assert shared


@pytest.mark.slow
def test_other_processes_pack_the_same(exporting):
    site, rows = exporting
    blocks = [rows[:3], rows[3:5], rows[5:]]
    alone = [pack_trials(site, block, site.catalogue.others) for block in blocks]
    with packing(site, blocks) as found:
        assert list(found) == alone


@pytest.mark.slow
def test_a_secret_that_another_process_finds_leaves_the_earlier_export_as_it_was(
    study, tmp_path, monkeypatch
):
    folder = tmp_path / "pages"
    list(export_folder(study, folder, ["emulator/*"]))
    earlier = {path.name: path.read_bytes() for path in folder.iterdir()}
    monkeypatch.setattr("analysis.explorer.export.AT_ONCE", 2)
    monkeypatch.setenv("MY_TOKEN", "You drive a car")
    with pytest.raises(UsageError, match="holds the value of MY_TOKEN"):
        list(export_folder(study, folder, ["emulator/*"]))
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == earlier
    assert [path.name for path in tmp_path.iterdir()] == ["pages"]


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
