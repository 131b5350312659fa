"""Addresses: every state of a page is one, and what is in one may be anything."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any
from urllib.parse import quote, urlencode

# The page to begin at.
HOME = "index"


class Links:
    """Addresses of the pages."""

    def to(self, name: str, /, **state: object) -> str:
        """A page of its own: ``trials``, ``sql``."""
        return f"/{'' if name == HOME else name}" + query_of(state)

    def trial(self, row: Mapping[str, Any], **state: object) -> str:
        """A trial's page; ``row`` has its name and its spec."""
        return f"/trials/{quote(row['trial_id'])}" + query_of({"spec": row["spec_hash"], **state})

    def decision(self, row: Mapping[str, Any], side: str, number: int) -> str:
        """What a decision's panel shows."""
        state = {"spec": row["spec_hash"], "side": side, "decision": number}
        return f"/decisions/{quote(row['trial_id'])}" + query_of(state)

    def others(self, row: Mapping[str, Any]) -> str:
        """Where a trial's page asks for others to lay beside it."""
        return f"/others/{quote(row['trial_id'])}" + query_of({"spec": row["spec_hash"]})

    def raw(self, row: Mapping[str, Any], side: str, number: int) -> str:
        """A reply as a plain text."""
        state = {"spec": row["spec_hash"], "side": side, "decision": number}
        return f"/raw/{quote(row['trial_id'])}" + query_of(state)

    def table(self, name: str, **state: object) -> str:
        """A table of the analysis."""
        return f"/tables/{quote(name)}" + query_of(state)

    def table_file(self, name: str, suffix: str) -> str:
        """A table as a file to download."""
        return f"/tables/{quote(name)}.{suffix}"

    def figure(self, name: str, suffix: str = "") -> str:
        """A figure's page, or the figure as a file."""
        return f"/figures/{quote(name)}{suffix}"

    def cell(self, table: str, row: str, column: str) -> str:
        """The trials behind a cell.

        No table's name has a slash and no column's a colon, whatever is in the row's.
        """
        return self.to("trials", cell=f"{table}/{row}:{column}")

    def sweep(self, sweep_id: str) -> str:
        """A sweep's page."""
        return f"/sweeps/{quote(sweep_id)}"

    def condition(self, name: str) -> str:
        """The trials of a condition."""
        return self.to("trials", condition=name)

    def driver(self, name: str, **state: object) -> str:
        """A driver's page."""
        return f"/drivers/{quote(name)}" + query_of(state)

    def static(self, name: str) -> str:
        """A script or a style."""
        return f"/static/{name}"


def query_of(state: Mapping[str, Any]) -> str:
    """The part of an address after the path; what is empty is left out."""
    given = {name: value for name, value in state.items() if value is not None and value != ""}
    return f"?{urlencode(given, doseq=True)}" if given else ""


def whole(text: str) -> int | None:
    """A number of up to 7 digits; None for anything else."""
    return int(text) if text.isascii() and text.isdigit() and len(text) < 8 else None
