"""The emulator: the command that runs it, and what goes wrong at it on purpose."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from merge_runner.cli.output import print_out
from merge_runner.errors import UsageError

if TYPE_CHECKING:
    from merge_runner.emulator.faults import FaultPlan

FaultRateOption = Annotated[
    float,
    typer.Option(metavar="P", help="Emulator only: share of attempts with a transient fault."),
]
FaultsOption = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Emulator only: a TOML file of faults.")
]
SeedOption = Annotated[int, typer.Option(metavar="N", help="Emulator only: seed of the faults.")]


def emulate(
    port: Annotated[
        int, typer.Option(metavar="N", help="0: any free port.", min=0, max=65535)
    ] = 8765,
    fault_rate: FaultRateOption = 0.0,
    faults: FaultsOption = None,
    seed: SeedOption = 0,
    batch_delay: Annotated[
        float | None,
        typer.Option(metavar="S", help="Seconds until a batch has its results.", min=0),
    ] = None,
) -> None:
    """Serve the emulator on 127.0.0.1, and print its base URL."""
    import asyncio

    from merge_runner.emulator.server import run

    plan = faults_of(fault_rate, faults, seed)
    if batch_delay is not None:
        batch = plan.batch.model_copy(update={"delay_s": batch_delay})
        plan = plan.model_copy(update={"batch": batch})
    asyncio.run(run(port, plan, announce=print_out))


def faults_of(fault_rate: float, faults: Path | None, seed: int) -> FaultPlan:
    """What goes wrong on purpose at the emulator; raises UsageError."""
    from merge_runner.emulator.faults import load_faults, transient_faults

    if faults is None:
        return transient_faults(fault_rate, seed)
    if fault_rate or seed:
        raise UsageError("--faults names a file that holds the rates and the seed: give it alone")
    return load_faults(faults)
