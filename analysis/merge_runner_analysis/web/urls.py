"""Addresses: every state of a page is one, and what is in one may be anything."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partialmethod
from typing import Any
from urllib.parse import quote, urlencode

# Parts of a cell's address: the cell, and the run and condition of its table.
CELL = ("cell", "of_run", "of_condition")
# The page to begin at.
HOME = "index"


class Links:
    """Addresses of the pages, as they are ``served``.

    Where no server is, ``leads`` turns an address into a file's; empty where there is no file.
    """

    def __init__(self, leads: Callable[[str], str] | None = None) -> None:
        self.served = leads is None
        self._leads = leads or str

    def to(self, name: str, /, **state: object) -> str:
        """Return the address of a page: ``trials``, ``sql``."""
        return self._leads(f"/{'' if name == HOME else name}" + query_of(state))

    def _named(self, kind: str, name: str, /, **state: object) -> str:
        return self._leads(f"/{kind}/{quote(name)}" + query_of(state))

    # What has a name. A table and a figure with a suffix is the file.
    table = partialmethod(_named, "tables")
    figure = partialmethod(_named, "figures")
    sweep = partialmethod(_named, "sweeps")
    driver = partialmethod(_named, "drivers")
    condition = partialmethod(_named, "conditions")
    static = partialmethod(_named, "static")

    def _of_trial(self, kind: str, row: Mapping[str, Any], /, **state: object) -> str:
        return self._named(kind, row["trial_id"], spec=row["spec_hash"], **state)

    # A trial's page, and where it asks for others to lay beside it; ``row`` has its name and spec.
    trial = partialmethod(_of_trial, "trials")
    others = partialmethod(_of_trial, "others")

    def cell(self, table: str, row: str, column: str, /, **part: str) -> str:
        """Return the address of a cell's trials, of all trials or of a ``part``: see ``CELL``.

        Names of tables have no slash and names of columns no colon; names of rows may have both.
        """
        return self.to("trials", cell=f"{table}/{row}:{column}", **part)


def query_of(state: Mapping[str, Any]) -> str:
    """Return the part of an address after the path; empty values are left out."""
    given = {name: value for name, value in state.items() if value is not None and value != ""}
    return f"?{urlencode(given, doseq=True)}" if given else ""


def whole(text: str) -> int | None:
    """Return a number of up to 7 digits; None for anything else."""
    return int(text) if text.isascii() and text.isdigit() and len(text) < 8 else None
