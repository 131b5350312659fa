"""Tables as text, CSV, JSON, Markdown and LaTeX; Rich and pandas would take 1.5 s to start."""

from __future__ import annotations

import io
import json
import textwrap
from collections.abc import Callable, Sequence
from functools import partial
from itertools import takewhile

from merge_runner.prompts.blocks import title_of
from merge_runner.text_safety import csv_writer, in_spreadsheet
from merge_runner_analysis.metrics import COST
from merge_runner_analysis.table_format import TableFormat
from merge_runner_analysis.tables.model import Column, Row, Table, Value
from merge_runner_analysis.wording import MINUS, MISSING, money, p_value, verdict_word

BETWEEN = "   "
# A narrow terminal shows these columns last, and those that say what is found first.
ASIDE = {
    *(("kind", "text"), ("k", "count"), ("undecided", "count"), ("level", "number")),
    *(("detectable", "number"), ("freedom", "number"), ("human_ci", "interval")),
    ("primary", "text"),
}
WEIGHTS = {"state": 6, "p_corrected": 6, "p_holm": 6, "difference": 5, "measure": 5, "reference": 2}
WEIGHTS |= dict.fromkeys(("estimate", "value", "b"), 4)
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
    """Return all tables as one text without a final line break; ``width`` is a terminal's."""
    if form is TableFormat.JSON:
        return json.dumps({"tables": [as_json(t) for t in tables]}, indent=2, ensure_ascii=False)
    writers: dict[TableFormat, Callable[[Table], str]] = {
        TableFormat.TEXT: partial(as_text, width=width),
        TableFormat.CSV: as_csv,
        TableFormat.MD: as_markdown,
        TableFormat.LATEX: as_latex,
    }
    # Several CSV tables in one stream could not be distinguished without their names.
    named = form is TableFormat.CSV and len(tables) > 1
    return "\n\n".join(f"# {table.name}\n" * named + writers[form](table) for table in tables)


def _grid(table: Table) -> tuple[list[Column], list[list[str]]]:
    columns = shown_columns(table)
    rows = [[shown_value(c, row) for c in columns] for row in shown_rows(table)]
    return columns, [[column.heading for column in columns], *rows]


def as_text(table: Table, width: int | None = None) -> str:
    """Return a table for a terminal; without its ``width`` lines are as long as they need to be."""
    # Characters differ in width on a terminal, so len() would misalign the columns.
    from rich.cells import cell_len

    (columns, grid), notes = _grid(table), notes_of(table)
    widths = [max(map(cell_len, cells)) for cells in zip(*grid, strict=True)]
    fitting = [*range(len(columns))] if width is None else _fitting(columns, widths, width)
    if hidden := [column.name for place, column in enumerate(columns) if place not in fitting]:
        number = f"{len(hidden)} column{'s' * (len(hidden) > 1)}"
        notes.insert(0, f"{number} hidden: --wide shows {', '.join(hidden)}")

    def padded(cell: str, place: int) -> str:
        blank = " " * (widths[place] - cell_len(cell))
        return cell + blank if columns[place].kind == "text" else blank + cell

    lines = [BETWEEN.join(padded(cells[place], place) for place in fitting) for cells in grid]
    if columns:
        lines.insert(1, "─" * max(map(cell_len, lines)))
    else:
        lines = []
    texts = [table.heading, *(f"  {note}" for note in notes)]
    if width is not None:
        wrap = partial(textwrap.fill, subsequent_indent="    ", break_on_hyphens=False)
        texts = [wrap(text, width) for text in texts]
    return "\n".join([texts[0], *(line.rstrip() for line in lines), *texts[1:]])


def _fitting(columns: Sequence[Column], widths: Sequence[int], width: int) -> list[int]:
    """Return the places of the columns that fit; of equal weight, the right ones go first."""
    fitting = [*range(len(columns))]
    for place in sorted(fitting, key=lambda place: (_weight(columns[place]), -place))[:-1]:
        if sum(widths[shown] + len(BETWEEN) for shown in fitting) - len(BETWEEN) <= width:
            break
        fitting.remove(place)
    return fitting


def _weight(column: Column) -> int:
    """Return a column's weight for a reader: results weigh most, then names of rows."""
    if (column.name, column.kind) in ASIDE:
        return 0
    if column.name in WEIGHTS:
        return WEIGHTS[column.name]
    if column.kind == "text" and not column.optional:
        return 5
    return {"verdict": 4, "p": 3, "interval": 2}.get(column.kind, 1)


def as_csv(table: Table) -> str:
    """Return a table's values at full precision; an interval takes two columns."""
    out = io.StringIO()
    writer = csv_writer(out)
    writer.writerow(names_of(table))
    for row in value_rows(table):
        # repr is the shortest text that reads back as the same float; float() strips NumPy's type.
        writer.writerow(
            repr(float(cell)) if isinstance(cell, float) else in_spreadsheet(cell)
            for cell in row.values()
        )
    return out.getvalue().rstrip("\n")


def as_json(table: Table) -> dict[str, object]:
    """Return a table as JSON values."""
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


def names_of(table: Table) -> list[str]:
    """Return the names of what ``value_rows`` gives of each row."""
    return ["row", *(name for column in table.columns for name in value_names(column)), "note"]


def value_names(column: Column) -> tuple[str, ...]:
    """Return the names of a column's values; an interval has two."""
    if column.kind == "interval":
        return f"{column.name}_low", f"{column.name}_high"
    return (column.name,)


def value_rows(table: Table) -> list[dict[str, Value]]:
    """Return each row's id, values and note; an interval becomes two values."""
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
    """Return a table for a README or an issue."""
    columns, grid = _grid(table)
    rules = "|".join(":--" if column.kind == "text" else "--:" for column in columns)
    escaped = ([cell.replace("|", r"\|") for cell in cells] for cells in grid)
    head, *rows = (f"| {' | '.join(cells)} |" for cells in escaped)
    notes = (f"- {note}" for note in notes_of(table))
    return "\n".join([f"**{table.heading}**", "", head, f"|{rules}|", *rows, "", *notes])


def as_latex(table: Table) -> str:
    r"""Return a table for the paper: needs the packages booktabs, amssymb and graphicx."""
    columns, (head, *body) = _grid(table)
    form = "".join("l" if column.kind == "text" else "r" for column in columns)
    numeric = [column.kind in {"p", "number", "percent", "interval"} for column in columns]
    rows = "\n".join(
        " & ".join(
            f"${cell}$" if number and cell != MISSING else cell.translate(LATEX)
            for number, cell in zip(numeric, cells, strict=True)
        )
        + r" \\"
        for cells in body
    )
    headings = " & ".join(cell.translate(LATEX) for cell in head)
    notes = r"\\ ".join(note.translate(LATEX) for note in notes_of(table))
    return rf"""\begin{{table*}}
\centering
\caption{{{table.title.translate(LATEX)}}}
\label{{tab:{table.name}}}
\resizebox{{\ifdim\width>\linewidth\linewidth\else\width\fi}}{{!}}{{%
\begin{{tabular}}{{{form}}}
\toprule
{headings} \\
\midrule
{rows}
\bottomrule
\end{{tabular}}}}
\\[2pt]\parbox{{\linewidth}}{{\footnotesize {notes}}}
\end{{table*}}"""


def printed(table: Table, row: Row) -> dict[str, str]:
    """Return a row's values as a reader sees them, by column."""
    return {c.name: shown_value(c, row) for c in table.columns}


def shown_columns(table: Table) -> list[Column]:
    """Return the columns with at least one value that the notes do not say."""
    return [
        column
        for column in table.columns
        if not column.noted
        and any(row.values.get(column.name) is not None for row in shown_rows(table))
    ]


def notes_of(table: Table) -> list[str]:
    """Return the notes of rows, equal ones once with all names, then the table's."""
    owners: dict[str, dict[str, None]] = {}
    for row in table.rows:
        if row.note:
            names = row.groups if len(row.groups) < 2 else (row.id.rpartition("/")[0] or row.id,)
            owners.setdefault(row.note, {}).update(dict.fromkeys(names))
    return [*(f"{', '.join(names)}: {note}" for note, names in owners.items()), *table.notes]


def shown_rows(table: Table) -> list[Row]:
    """Return the rows of a table without untested ones, which the notes explain."""
    return [row for row in table.rows if not row.untested]


def shown_value(column: Column, row: Row) -> str:
    """Return a value of a row as a reader sees it."""
    value = row.values.get(column.name)
    if value is None:
        return "" if column.kind == "text" else MISSING
    if isinstance(value, tuple):
        return f"[{', '.join(_rounded(end, column, row) for end in value)}]"
    if isinstance(value, bool):
        return "✓" if value else "✗"
    if column.name == "setting":
        return title_of(str(value))
    if column.name == "state":
        return verdict_word(row.values)
    if column.kind == "p" and isinstance(value, float):
        return p_value(value)
    return _rounded(value, column, row) if isinstance(value, float) else str(value)


def _rounded(value: float, column: Column, row: Row) -> str:
    if row.id.rpartition("/")[2] == COST.name:
        return money(value).replace(MINUS, "-")
    return f"{value:z.{column.digits}f}"


def table_view(table: Table, link: Callable[[Table, Row, Column], object]) -> dict[str, object]:
    """Return a table as templates need it: headings, cells with what ``link`` returns, notes.

    The text cells before a row's first other cell are its headers, for screen readers.
    """
    columns = shown_columns(table)
    headers = [*takewhile(lambda column: column.kind == "text", columns)]
    rows = []
    for row in shown_rows(table):
        cells = []
        for column in columns:
            value, left = row.values.get(column.name), column.kind == "text"
            linked = row.rests_on and not left and (value if column.counts else value is not None)
            cells.append(
                {
                    "text": shown_value(column, row),
                    "left": left,
                    "header": column in headers,
                    "link": link(table, row, column) if linked else None,
                    "label": f"{column.heading} of {row.id}",
                }
            )
        rows.append({"id": row.id, "cells": cells})
    return {
        "name": table.name,
        "heading": table.heading,
        "columns": [
            {
                "heading": c.heading,
                "meaning": c.meaning,
                "text": c.kind == "text",
                "aside": _weight(c) == 0,
            }
            for c in columns
        ],
        "rows": rows,
        "notes": notes_of(table),
    }
