"""The commands about the models that can drive, and the emulator."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import Annotated, Any

from merge_runner.cli import options as cli
from merge_runner.cli.options import print_out
from merge_runner.text_safety import say


def models(as_json: cli.JsonOption = False) -> None:
    """List the models and programs that can drive.

    Example: merge-runner models --json
    """
    from merge_runner.drivers.registry import PROGRAMS
    from merge_runner.llm.models import load_models, shutdown_notes
    from merge_runner.llm.prices import cost_usd
    from merge_runner.providers import Price, key_status
    from merge_runner.records import Usage
    from merge_runner.run.summary import as_table

    entries = load_models()
    rows: list[dict[str, Any]] = []
    for name, entry in entries.items():
        # A thousand tokens each: more may have a price of their own.
        costs = (cost_usd(entry, Usage(n, output_tokens=1000 - n)) for n in (1000, 0))
        usd = ["unknown" if cost is None else round(cost * 1000, 6) for cost in costs]
        rows.append(
            {
                "name": name,
                "provider": entry.provider,
                "key": key_status(entry),
                "usd_per_m_in": usd[0],
                "usd_per_m_out": usd[1],
                "shutdown": str(entry.shutdown or ""),
                "id": entry.id,
                "prices": entry.price.source if isinstance(entry.price, Price) else entry.price,
                "note": entry.note,
            }
        )
    for name, program in PROGRAMS.items():
        needs = {"provider": "program", "key": "not needed", "usd_per_m_in": 0, "usd_per_m_out": 0}
        rows.append(
            {**dict.fromkeys(rows[0], ""), **needs, "name": name, "note": program.described}
        )
    if as_json:
        print_out(json.dumps(rows, indent=2, ensure_ascii=False))
    else:
        notes = [f"{row['name']}: {note}" for row in rows if (note := row.pop("note"))]
        print_out("\n".join([as_table(rows), *notes]))
    for note in shutdown_notes(entries, datetime.now(UTC).date()):
        say(note)


def emulate(
    port: Annotated[int, cli.option("N", "0: any free port.", min=0, max=65535)] = 8765,
) -> None:
    """Serve the emulator on 127.0.0.1, and print its base URL.

    It plays the emulator for any model id, and `random` for the id random-driver. A base URL of a
    `local` model ends in /v1. Such a model gets the same reply in every repetition.

    Example: merge-runner emulate --port 8765
    """
    import asyncio

    from merge_runner.emulator.server import run

    def announce(url: str) -> None:
        print_out(url)
        say(f"for a local model: LOCAL_BASE_URL={url}/v1")

    asyncio.run(run(port, announce=announce))
