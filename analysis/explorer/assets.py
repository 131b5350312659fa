"""The styles and scripts of the pages."""

from __future__ import annotations

from pathlib import Path

STATIC = Path(__file__).with_name("static")
STYLES = (
    "vendor/uplot-1.6.32.min.css",
    *(f"styles/{name}.css" for name in ("base", "answers", "trial", "pages")),
)
# What draws and moves a trial, in the order in which it is loaded.
_PARTS = "moment track marks charts ribbons panel clock comparison start"
REPLAY = ("vendor/uplot-1.6.32.min.js", *(f"replay/{part}.js" for part in _PARTS.split()))
