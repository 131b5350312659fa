"""The tables of the analysis, as in the report; every number leads to the trials behind it."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Collection, Mapping
from dataclasses import replace
from importlib import metadata

from merge_runner_analysis.explorer.pages.computed import awaited, computed, computed_table
from merge_runner_analysis.explorer.scope import every
from merge_runner_analysis.explorer.site import NotThere, Site
from merge_runner_analysis.figures import FIGURES
from merge_runner_analysis.table_format import TableFormat
from merge_runner_analysis.tables import TABLES
from merge_runner_analysis.tables.formats import render, shown_columns, table_view
from merge_runner_analysis.tables.model import Table, from_text

# How a table can be downloaded, by the suffix of the file: its format, and the file's type.
FILES = {
    TableFormat.CSV.suffix: (TableFormat.CSV, "text/csv; charset=utf-8"),
    TableFormat.LATEX.suffix: (TableFormat.LATEX, "application/x-tex; charset=utf-8"),
}
# How a figure can be downloaded, with the file's type.
FORMS = {"svg": "image/svg+xml", "png": "image/png"}
PAPER = (
    "S. H. A. Mohammad, W. Mooi, A. Zgonnikov: General-purpose LLMs as Models of Human Driver "
    "Behavior: The Case of Simplified Merging. arXiv:2604.09609, 2026."
)
HUMANS = "O. Siebinga et al.: human merging experiment, data set. doi:10.4121/19550377."


def tables_page(site: Site) -> str:
    """The list of all tables and figures."""
    return site.render(
        "tables.html",
        here="tables",
        about={name: one.about for name, one in TABLES.items()},
        figures=FIGURES,
    )


def table_file(site: Site, name: str, suffix: str) -> tuple[str, str]:
    """A table as a file's text with the type of the file; raises NotThere and StoreError."""
    if suffix not in FILES:
        raise NotThere(f"a table comes as {' or '.join(FILES)}")
    form, kind = FILES[suffix]
    content = awaited(site, ("table", _named(name, TABLES, "table"), "", ""), {})
    return render([from_text(content["table"])], form) + "\n", kind


def figure_file(site: Site, name: str, form: str) -> bytes:
    """A figure as a file; raises NotThere and StoreError."""
    if form not in FORMS:
        raise NotThere(f"a figure comes as {' or '.join(FORMS)}")
    file: bytes = awaited(site, ("figure", _named(name, FIGURES, "figure"), form), {})["file"]
    return file


def figure_page(site: Site, name: str, asked: Mapping[str, str]) -> str:
    """A figure with its caption, its files, and how it is cited; raises NotThere."""
    about = FIGURES[_named(name, FIGURES, "figure")]
    found = computed(site, ("figure", name, "svg"), asked)
    numbers = site.at.table(f"{about.table}.csv") if about.table else site.at.to("trials.csv")
    return site.render(
        "figure.html",
        here="tables",
        name=name,
        about=about,
        computed=found,
        image=b64encode(found.content["file"]).decode() if found.content else "",
        files={"SVG": site.at.figure(f"{name}.svg"), "PNG": site.at.figure(f"{name}.png")}
        | {"CSV": numbers},
        sources=(PAPER, HUMANS),
        version=metadata.version("merge-runner"),
    )


def _named(name: str, known: Collection[str], what: str) -> str:
    if name not in known:
        raise NotThere(f"there is no {what} {name}; there are {', '.join(known)}")
    return name


def table_page(site: Site, name: str, asked: Mapping[str, str]) -> str:
    """One table; raises NotThere."""
    found, table = computed_table(site, _named(name, TABLES, "table"), asked)
    by, without = asked.get("sort", ""), every(asked, "without")
    columns = shown_columns(table) if table else []
    shown = table and table_view(
        _sorted(table, by),
        lambda table, row, column: site.at.cell(table.name, row.id, column.name),
    )
    places = [place for place, column in enumerate(columns) if column.name not in without]
    return site.render(
        "table.html",
        here="tables",
        name=name,
        about=TABLES[name].about,
        files=[(suffix, site.at.table(f"{name}.{suffix}")) for suffix in FILES],
        computed=found,
        table=shown,
        columns=columns,
        places=places,
        sort=by,
        without=without,
    )


def _sorted(table: Table, by: str) -> Table:
    """The table by the values of a column, with ``-`` before its name the largest first.

    What has no value comes last.
    """
    name = by.removeprefix("-")
    told = [row for row in table.rows if row.values.get(name) is not None]
    rest = [row for row in table.rows if row.values.get(name) is None]
    told.sort(key=lambda row: row.values[name], reverse=by.startswith("-"))  # type: ignore[arg-type, return-value]  # a column's values are of one kind
    return replace(table, rows=[*told, *rest])
