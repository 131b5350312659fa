"""The command that serves the emulator."""

from __future__ import annotations

from typing import Annotated

import typer

from merge_runner.cli.output import print_out


def emulate(
    port: Annotated[
        int, typer.Option(metavar="N", help="0: any free port.", min=0, max=65535)
    ] = 8765,
) -> None:
    """Serve the emulator on 127.0.0.1, and print its base URL."""
    import asyncio

    from merge_runner.emulator.server import run

    asyncio.run(run(port, announce=print_out))
