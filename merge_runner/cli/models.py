"""The command that lists who can drive."""

from __future__ import annotations

import sys


def models() -> None:
    """List who can drive: the models with provider, id, key and price, and the programs."""
    from merge_runner.config import Price, key_status
    from merge_runner.drivers.registry import PROGRAMS
    from merge_runner.llm.models import load_models
    from merge_runner.llm.prices import cost_usd
    from merge_runner.records import Usage
    from merge_runner.results.query_output import write_table

    million = 1_000_000
    rows = []
    for name, entry in load_models().items():
        costs = [
            cost_usd(entry, Usage(input_tokens=i, output_tokens=o))
            for i, o in ((1000, 0), (0, 1000))
        ]
        shown = ["unknown" if c is None else f"{c * million / 1000:g}" for c in costs]
        source = entry.price.source if isinstance(entry.price, Price) else entry.price
        rows.append(
            (
                name,
                entry.provider,
                entry.id,
                key_status(name, entry),
                *shown,
                source,
                str(entry.shutdown or ""),
                entry.note,
            )
        )
    for name, program in PROGRAMS.items():
        rows.append((name, "program", "", "not needed", "0", "0", "", "", program.described))
    headings = ["name", "provider", "id", "key", "USD/M in", "USD/M out", "prices", "shutdown"]
    write_table([*headings, "note"], rows, sys.stdout)
