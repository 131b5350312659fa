"""The command that lists who can drive."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import accumulate

from merge_runner.cli.options import JsonOption

HEADINGS = ("name", "provider", "key", "USD/M in", "USD/M out", "shutdown", "id", "prices")
Row = tuple[object, ...]


def models(as_json: JsonOption = False) -> None:
    """List the models and programs that can drive."""
    from merge_runner.cli.output import say, terminal_width
    from merge_runner.config import Price, key_status
    from merge_runner.drivers.registry import PROGRAMS
    from merge_runner.llm.models import load_models, shutdown_notes
    from merge_runner.llm.prices import cost_usd
    from merge_runner.records import Usage
    from merge_runner.results.query_output import write_json

    entries = load_models()
    rows: list[Row] = []
    for name, entry in entries.items():
        thousand = (
            Usage(input_tokens=1000, output_tokens=0),
            Usage(input_tokens=0, output_tokens=1000),
        )
        costs = [cost_usd(entry, tokens) for tokens in thousand]
        usd = ["unknown" if cost is None else round(cost * 1000, 6) for cost in costs]
        closes = str(entry.shutdown or "")
        source = entry.price.source if isinstance(entry.price, Price) else entry.price
        key = key_status(entry)
        rows.append((name, entry.provider, key, *usd, closes, entry.id, source, entry.note))
    for name, program in PROGRAMS.items():
        rows.append((name, "program", "not needed", 0, 0, "", "", "", program.described))
    if as_json:
        names = [name.lower().replace("/", "_per_").replace(" ", "_") for name in HEADINGS]
        write_json([*names, "note"], rows, sys.stdout)
    else:
        _print_table(rows, terminal_width())
    for note in shutdown_notes(entries, datetime.now(UTC).date()):
        say(note)


def _print_table(rows: Sequence[Row], width: int | None) -> None:
    """Print rows that end with a note, and the notes below; ``width`` is that of a terminal."""
    from merge_runner.cli.output import print_out
    from merge_runner.results.query_output import write_table

    columns = [
        [heading, *(f"{v:g}" if isinstance(v, float) else str(v) for v in values)]
        for heading, *values in zip(HEADINGS, *(row[:-1] for row in rows), strict=True)
    ]
    notes = [f"{name}: {note}" for name, *_, note in rows if note]
    if width is not None:
        ends = accumulate(max(map(len, cells)) + 2 for cells in columns)
        fitting = max(1, sum(end - 2 <= width for end in ends))
        if left_out := HEADINGS[fitting:]:
            notes.append(
                f"wider than the terminal, so without {', '.join(left_out)}: --json has all"
            )
        columns = columns[:fitting]
        notes = [textwrap.fill(note, width, subsequent_indent="  ") for note in notes]
    headings, *shown = zip(*columns, strict=True)
    write_table(list(headings), shown, sys.stdout)
    print_out("\n".join(["", *notes]))
