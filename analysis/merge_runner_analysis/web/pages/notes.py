"""List of all notes, and new ones."""

from __future__ import annotations

from collections.abc import Mapping

from merge_runner_analysis.web.reading import Row
from merge_runner_analysis.web.site import Site
from merge_runner_analysis.web.urls import whole


def notes_page(site: Site, _: Mapping[str, str]) -> str:
    """Return all notes, the latest first, each with the address of its trial or decision.

    It has none where the trial is not in this database.
    """
    stored, shown = site.notes.read(), []
    for note in reversed(stored.notes):
        row = site.catalogue.find(note.trial_id, note.spec_hash)
        at = {"side": note.side, "decision": note.decision}
        shown.append((note, row and site.at.trial(row, **at)))
    return site.render("notes.html", view="notes", stored=stored, shown=shown)


def add_note(site: Site, given: Mapping[str, str]) -> Row:
    """Note what a form gives; returns the trial. Raises NotThere and UsageError."""
    row = site.trial(given.get("trial", ""), given.get("spec", ""))
    side, number = given.get("side", ""), whole(given.get("decision", ""))
    text = given.get("text", "").replace("\r\n", "\n").strip()
    site.notes.add(row["trial_id"], row["spec_hash"], side, number, text)
    return row
