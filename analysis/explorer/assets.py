"""The styles and scripts of the pages, as files that a server gives and as texts within a page."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from markupsafe import Markup

STATIC = Path(__file__).with_name("static")
STYLES = (
    "vendor/uplot-1.6.32.min.css",
    *(
        f"styles/{name}.css"
        for name in (
            *("colours", "base", "trial", "sql", "tables", "sweeps"),
            *("home", "conditions", "words"),
        )
    ),
)
# What draws and moves a trial, in the order in which it is loaded.
_PARTS = "moment track marks charts ribbons panel clock finding comparison start"
REPLAY = ("vendor/uplot-1.6.32.min.js", *(f"replay/{part}.js" for part in _PARTS.split()))


ON_ALL = ("lists.js", "keys.js", "sorting.js")


@dataclass(frozen=True, slots=True)
class Inlined:
    """Styles and scripts within a page, and their hashes for its policy."""

    styles: list[Markup]
    scripts: list[Markup]
    hashes: str


@cache
def inlined(scripts: Sequence[str]) -> Inlined:
    """Our styles, and these scripts after those of all pages, to stand within a page."""

    def texts(names: Sequence[str]) -> list[str]:
        return [(STATIC / name).read_text(encoding="utf-8") for name in names]

    styles, code = texts(STYLES), texts((*ON_ALL, *scripts))
    hashes = " ".join(
        f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
        for text in (*styles, *code)
    )
    return Inlined([Markup(text) for text in styles], [Markup(text) for text in code], hashes)  # noqa: S704 # files of ours
