"""What readers noted, all of it."""

from __future__ import annotations

from collections.abc import Mapping

from merge_runner.errors import UsageError
from merge_runner.records import SIDES
from merge_runner_analysis.explorer.notes import Note
from merge_runner_analysis.explorer.pages.trial import find
from merge_runner_analysis.explorer.reading import Row
from merge_runner_analysis.explorer.site import Site
from merge_runner_analysis.explorer.urls import whole


def notes_page(site: Site) -> str:
    """Return all notes, the latest first."""
    kept = site.notes.kept()
    shown = [(note, _address(site, note)) for note in reversed(kept.notes)]
    return site.render("notes.html", here="notes", kept=kept, shown=shown)


def add_note(site: Site, given: Mapping[str, str]) -> Row:
    """Note what a form gives; returns the trial. Raises NotThere and UsageError."""
    row = find(site, given.get("trial", ""), given)
    side, number = given.get("side", ""), whole(given.get("decision", ""))
    if side not in {"", *SIDES} or (number is None) != (side == ""):
        raise UsageError("a note is of a trial, or of a decision: side left or right, and a number")
    at = None if number is None else (SIDES[SIDES.index(side)], number)
    # Tags are separated by commas, and have no capitals.
    tags = [" ".join(tag.split()).lower() for tag in given.get("tags", "").split(",")]
    text = given.get("text", "").replace("\r\n", "\n").strip()
    trial = row["trial_id"], row["spec_hash"]
    site.notes.add(trial, at, list(dict.fromkeys(filter(None, tags))), text)
    return row


def _address(site: Site, note: Note) -> str:
    """Where a note belongs; nothing where the trial is not in this database."""
    row = site.catalogue.find(note.trial_id, note.spec_hash)
    if row is None:
        return ""
    at = {} if note.decision is None else {"side": note.side, "decision": note.decision}
    address: str = site.at.trial(row, **at)
    return address
