"""The tables of the analysis, as in the report; every number leads to the trials behind it."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Collection, Mapping
from importlib import metadata
from typing import Any

from starlette.responses import Response

from merge_runner_analysis.figures import FIGURES
from merge_runner_analysis.table_format import TableFormat
from merge_runner_analysis.tables import TABLES
from merge_runner_analysis.tables.formats import render, shown_columns, table_view
from merge_runner_analysis.tables.model import from_text
from merge_runner_analysis.web.scope import descriptions_of, every
from merge_runner_analysis.web.site import NotThere, Site, download

TABLE_FILES = {"csv": TableFormat.CSV, "tex": TableFormat.LATEX}
FIGURE_FILES = {"svg": "image/svg+xml", "png": "image/png"}
# The list of tables, by what they answer.
GROUPS = {
    "Do they drive like people?": ("verdicts", "first-action", "criticality"),
    "What makes a difference?": ("effects", "contrasts", "factors"),
    "The tables of the paper":
        ("who-first", "gap", "indicators", "ablation-qualitative", "ablation-quantitative"),
    "More": ("attempts",),
}  # fmt: skip
# Matplotlib writes styles into its SVG, and traces as pictures.
DRAWN = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox"


def tables_page(site: Site, _: Mapping[str, str]) -> str:
    """Return the list of all tables and figures."""
    grouped = {name for names in GROUPS.values() for name in names}
    others = [name for name in TABLES if name not in grouped]
    groups = {of: [name for name in names if name in TABLES] for of, names in GROUPS.items()}
    groups["More"] += others
    return site.render("tables.html", view="tables", tables=TABLES, figures=FIGURES, groups=groups)


def table_file(site: Site, name: str, suffix: str, _: Mapping[str, str]) -> Response:
    """Return a table as a file; raises NotThere and StoreError."""
    form = TABLE_FILES[_known(suffix, TABLE_FILES, "file")]
    content = site.awaited(("table", _known(name, TABLES, "table"), "", ""))
    return download(render([from_text(content["table"])], form) + "\n", f"{name}.{suffix}")


def figure_file(site: Site, name: str, suffix: str, _: Mapping[str, str]) -> Response:
    """Return a figure as a file; raises NotThere and StoreError."""
    kind = FIGURE_FILES[_known(suffix, FIGURE_FILES, "file")]
    content = site.awaited(("figure", _known(name, FIGURES, "figure"), suffix))
    return Response(content["file"], headers={"content-security-policy": DRAWN}, media_type=kind)


def figure_page(site: Site, name: str, _: Mapping[str, str]) -> str:
    """Return a figure with its caption, its files and its citation; raises NotThere."""
    about = FIGURES[_known(name, FIGURES, "figure")]
    job = site.computed(("figure", name, "svg"))
    return site.render(
        "figure.html",
        view="tables",
        name=name,
        about=about,
        computed=job,
        image=b64encode(job.content["file"]).decode() if job.content else "",
        **_cited(site),
    )


def cite_page(site: Site, _: Mapping[str, str]) -> str:
    """Return the page that says how to cite the results of a study."""
    job = site.computed(("digest",))
    return site.render("cite.html", view="cite", computed=job, cited_as="Results", **_cited(site))


def _cited(site: Site) -> dict[str, Any]:
    version = metadata.version("merge-runner")
    return {"descriptions": descriptions_of(site), "version": version}


def table_page(site: Site, name: str, params: Mapping[str, str]) -> str:
    """Return the page of a table; raises NotThere."""
    job, table = site.table(_known(name, TABLES, "table"))
    without = every(params, "without")
    columns = shown_columns(table) if table else []
    return site.render(
        "table.html",
        view="tables",
        name=name,
        about=TABLES[name].about,
        computed=job,
        table=table
        and table_view(table, lambda _, row, column: site.at.cell(name, row.id, column.name)),
        columns=columns,
        places=[place for place, column in enumerate(columns) if column.name not in without],
        without=without,
    )


def _known(name: str, known: Collection[str], what: str) -> str:
    if name not in known:
        raise NotThere(f"there is no {what} {name}; there are {', '.join(known)}")
    return name
