"""Tables as text, CSV, JSON, Markdown and LaTeX: at full precision in CSV and JSON, else rounded.

Rich and pandas would take eight times as long, and 1.5 s to import their templates.
"""

from __future__ import annotations

import io
import json
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import accumulate, takewhile

from merge_runner.errors import unknown_name
from merge_runner.prompts.blocks import title_of
from merge_runner.text_safety import csv_writer, in_spreadsheet
from merge_runner_analysis.table_format import TableFormat
from merge_runner_analysis.tables.model import Column, Row, Table, Value

MISSING = "–"
BETWEEN = "   "
LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "–": "--",
        "≠": r"$\neq$",
        "≥": r"$\geq$",
        "≤": r"$\leq$",
        "±": r"$\pm$",
        "Δ": r"$\Delta$",
        "²": r"$^2$",
        "✓": r"\checkmark{}",
        "✗": r"\textbf{X}",
        "<": "$<$",
        ">": "$>$",
        "|": "$|$",
        "^": r"\textasciicircum{}",
        "~": r"\textasciitilde{}",
        **{character: f"\\{character}" for character in "&%$#_{}"},
    }
)


def render(tables: Sequence[Table], form: TableFormat, width: int | None = None) -> str:
    """All tables as one text that ends without a line break; ``width`` is that of a terminal."""
    if form is TableFormat.JSON:
        return json.dumps({"tables": [as_json(t) for t in tables]}, indent=2, ensure_ascii=False)
    if form is TableFormat.TEXT:
        return "\n\n".join(as_text(table, width) for table in tables)
    write = {
        TableFormat.CSV: as_csv,
        TableFormat.MD: as_markdown,
        TableFormat.LATEX: as_latex,
    }[form]
    # Several CSV tables in one stream could not be told apart without their names.
    named = form is TableFormat.CSV and len(tables) > 1
    return "\n\n".join(f"# {table.name}\n" * named + write(table) for table in tables)


def with_columns(tables: Sequence[Table], names: Sequence[str]) -> list[Table]:
    """The tables with these columns, after those that name a row; raises UsageError."""
    known = dict.fromkeys(column.name for table in tables for column in table.columns)
    for name in names:
        if name not in known:
            raise unknown_name("column", name, known)
    return [
        replace(table, columns=[*first, *(c for c in rest if c.name in names)])
        for table in tables
        for first, rest in [_parted(table.columns)]
    ]


def _parted(columns: Sequence[Column]) -> tuple[Sequence[Column], Sequence[Column]]:
    """The columns at the left, which name a row, and the others."""
    names = sum(1 for _ in takewhile(lambda column: column.kind == "text", columns))
    return columns[:names], columns[names:]


def as_text(table: Table, width: int | None = None) -> str:
    """A table for a terminal; without its ``width`` lines are as long as they need to be.

    Columns that do not fit are left out from the right, and named.
    """
    # Characters differ in width on a terminal, so len() would misalign the columns.
    from rich.cells import cell_len

    columns, grid, notes = shown_columns(table), _grid(table), notes_of(table)
    widths = [max(map(cell_len, cells)) for cells in zip(*grid, strict=True)]
    if width is not None:
        ends = accumulate(one + len(BETWEEN) for one in widths)
        fitting = max(sum(end - len(BETWEEN) <= width for end in ends), 1)
        if left_out := [column.name for column in columns[fitting:]]:
            notes.insert(
                0,
                f"wider than the terminal, so without {', '.join(left_out)}: --columns NAME,NAME "
                "chooses, --format csv has all",
            )
        columns, widths = columns[:fitting], widths[:fitting]
    lines = []
    for cells in grid if columns else ():
        blanks = (" " * (one - cell_len(cell)) for one, cell in zip(widths, cells, strict=False))
        texts = (
            cell + blank if column.kind == "text" else blank + cell
            for column, cell, blank in zip(columns, cells, blanks, strict=False)
        )
        lines.append(BETWEEN.join(texts))
    lines[1:1] = ["─" * max(map(cell_len, lines))] if lines else []
    wrapped = (_wrapped(f"  {note}", width) for note in notes)
    return "\n".join([_wrapped(table.heading, width), *(line.rstrip() for line in lines), *wrapped])


def _grid(table: Table) -> list[list[str]]:
    """The headings, then each row, of the columns that are shown, as a reader sees them."""
    shown = shown_columns(table)
    rows = [[shown_value(c, row.values.get(c.name)) for c in shown] for row in table.rows]
    return [[column.heading for column in shown], *rows]


def _wrapped(text: str, width: int | None) -> str:
    if width is None:
        return text
    return textwrap.fill(text, width, subsequent_indent="    ", break_on_hyphens=False)


def as_csv(table: Table) -> str:
    """A table's values at full precision; an interval takes two columns."""
    out = io.StringIO()
    writer = csv_writer(out)
    names = [name for column in table.columns for name in value_names(column)]
    writer.writerow(["row", *names, "note"])
    for row in value_rows(table):
        # repr is the shortest text that reads back as the same float; float() strips NumPy's type.
        writer.writerow(
            repr(float(cell)) if isinstance(cell, float) else in_spreadsheet(cell)
            for cell in row.values()
        )
    return out.getvalue().rstrip("\n")


def as_json(table: Table) -> dict[str, object]:
    """A table as JSON values."""
    return {
        "name": table.name,
        "number": table.number,
        "title": table.title,
        "columns": [
            {"name": c.name, "heading": c.heading, "kind": c.kind, "meaning": c.meaning}
            for c in table.columns
        ],
        "rows": value_rows(table),
        "notes": list(table.notes),
    }


def value_names(column: Column) -> tuple[str, ...]:
    """The names of the values of a column: those of an interval are two."""
    if column.kind == "interval":
        return f"{column.name}_low", f"{column.name}_high"
    return (column.name,)


def value_rows(table: Table) -> list[dict[str, Value]]:
    """Each row's id, values and note; an interval becomes two values."""
    rows = []
    for row in table.rows:
        cells: dict[str, Value] = {"row": row.id}
        for column in table.columns:
            names, value = value_names(column), row.values.get(column.name)
            every = value if isinstance(value, tuple) else (value,) * len(names)
            cells |= dict(zip(names, every, strict=True))
        rows.append(cells | {"note": row.note})
    return rows


def as_markdown(table: Table) -> str:
    """A table for a README or an issue."""
    rules = [":--" if column.kind == "text" else "--:" for column in shown_columns(table)]
    escaped = ([cell.replace("|", r"\|") for cell in cells] for cells in _grid(table))
    head, *rows = (f"| {' | '.join(cells)} |" for cells in escaped)
    notes = (f"- {note}" for note in notes_of(table))
    return "\n".join([f"**{table.heading}**", "", head, f"|{'|'.join(rules)}|", *rows, "", *notes])


def as_latex(table: Table) -> str:
    r"""A table for the paper: needs the packages booktabs, amssymb and graphicx."""
    columns = shown_columns(table)
    form = "".join("l" if column.kind == "text" else "r" for column in columns)
    head, *body = _grid(table)
    numeric = [column.kind in {"p", "number", "percent", "interval"} for column in columns]
    rows = [
        " & ".join(
            f"${cell}$" if number and cell != MISSING else cell.translate(LATEX)
            for number, cell in zip(numeric, cells, strict=True)
        )
        + r" \\"
        for cells in body
    ]
    headings = " & ".join(cell.translate(LATEX) for cell in head)
    notes = r"\\ ".join(note.translate(LATEX) for note in notes_of(table))
    lines = "\n".join(rows)
    return rf"""\begin{{table*}}
\centering
\caption{{{table.title.translate(LATEX)}}}
\label{{tab:{table.name}}}
\resizebox{{\ifdim\width>\linewidth\linewidth\else\width\fi}}{{!}}{{%
\begin{{tabular}}{{{form}}}
\toprule
{headings} \\
\midrule
{lines}
\bottomrule
\end{{tabular}}}}
\\[2pt]\parbox{{\linewidth}}{{\footnotesize {notes}}}
\end{{table*}}"""


def printed(table: Table, row: Row) -> dict[str, str]:
    """A row's values as a reader sees them, by column."""
    return {c.name: shown_value(c, row.values.get(c.name)) for c in table.columns}


def shown_columns(table: Table) -> list[Column]:
    """The columns with at least one value."""
    return [c for c in table.columns if any(r.values.get(c.name) is not None for r in table.rows)]


def notes_of(table: Table) -> list[str]:
    """The notes of rows, then of the table; equal notes of rows appear once, with their groups."""
    groups: dict[str, dict[str, None]] = {}
    for row in table.rows:
        if row.note:
            groups.setdefault(row.note, {}).update(dict.fromkeys(row.groups))
    return [*(f"{', '.join(ids)}: {note}" for note, ids in groups.items()), *table.notes]


def shown_value(column: Column, value: Value) -> str:
    """One value as a reader sees it."""
    if value is None:
        return "" if column.kind == "text" else MISSING
    if isinstance(value, tuple):
        return f"[{', '.join(_rounded(end, column.digits) for end in value)}]"
    if isinstance(value, bool):
        return "✓" if value else "✗"
    if column.name == "setting":
        return title_of(str(value))
    if column.kind == "p" and isinstance(value, float) and value < 0.001:
        return "<0.001"
    return _rounded(value, column.digits) if isinstance(value, float) else str(value)


def _rounded(value: float, digits: int) -> str:
    text = f"{value:.{digits}f}"
    # A small negative value that rounds to zero would otherwise be shown as -0.00.
    return text.lstrip("-") if float(text) == 0 else text


def table_view(table: Table, link: Callable[[Table, Row, Column], object]) -> dict[str, object]:
    """A table as templates need it: headings, cells with what ``link`` returns, notes.

    The text cells before a row's first other cell are its headers: a screen reader announces them
    with each of its cells.
    """
    columns = shown_columns(table)
    headers, _ = _parted(columns)
    return {
        "name": table.name,
        "heading": table.heading,
        "columns": [
            {"heading": c.heading, "meaning": c.meaning, "text": c.kind == "text"} for c in columns
        ],
        "rows": [
            {
                "id": row.id,
                "cells": [
                    {
                        "text": shown_value(column, row.values.get(column.name)),
                        "left": column.kind == "text",
                        "header": column in headers,
                        "link": link(table, row, column) if _linked(row, column) else None,
                        "label": f"{column.heading} of {row.id}",
                    }
                    for column in columns
                ],
            }
            for row in table.rows
        ],
        "notes": notes_of(table),
    }


def _linked(row: Row, column: Column) -> bool:
    """Whether a value leads to trials: a published one has none, nor has a count of zero."""
    value = row.values.get(column.name)
    nothing = value is None or (column.counts and not value)
    return bool(row.counts) and column.kind != "text" and not nothing
