"""The command that lists who can drive."""

from __future__ import annotations

import sys
from datetime import UTC, datetime

from merge_runner.cli.options import JsonOption


def models(as_json: JsonOption = False) -> None:
    """List the models and programs that can drive."""
    from merge_runner.cli.output import say
    from merge_runner.config import Price, key_status
    from merge_runner.drivers.registry import PROGRAMS
    from merge_runner.llm.models import load_models, shutdown_notes
    from merge_runner.llm.prices import cost_usd
    from merge_runner.records import Usage
    from merge_runner.results.query_output import write_json, write_table

    million = 1_000_000
    entries = load_models()
    rows: list[tuple[object, ...]] = []
    for name, entry in entries.items():
        costs = [
            cost_usd(entry, Usage(input_tokens=i, output_tokens=o))
            for i, o in ((1000, 0), (0, 1000))
        ]
        usd = ["unknown" if c is None else round(c * million / 1000, 6) for c in costs]
        source = entry.price.source if isinstance(entry.price, Price) else entry.price
        rows.append(
            (
                name,
                entry.provider,
                entry.id,
                key_status(name, entry),
                *usd,
                source,
                str(entry.shutdown or ""),
                entry.note,
            )
        )
    for name, program in PROGRAMS.items():
        rows.append((name, "program", "", "not needed", 0, 0, "", "", program.described))
    headings = ["name", "provider", "id", "key", "USD/M in", "USD/M out", "prices", "shutdown"]
    headings.append("note")
    if as_json:
        names = [name.lower().replace("/", "_per_").replace(" ", "_") for name in headings]
        write_json(names, rows, sys.stdout)
    else:
        plain = [tuple(f"{v:g}" if isinstance(v, float) else v for v in row) for row in rows]
        write_table(headings, plain, sys.stdout)
    for note in shutdown_notes(entries, datetime.now(UTC).date()):
        say(note)
