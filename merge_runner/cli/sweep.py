"""The commands that play a study."""

from __future__ import annotations

import shlex
import sys
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from merge_runner.cli.options import (
    BatchOption,
    CacheOption,
    ConditionsOption,
    DbOption,
    DryRunOption,
    InFlightOption,
    JsonOption,
    KeepGoingOption,
    MaxCostOption,
    MirrorOption,
    ModelOption,
    OnlyOption,
    QuietOption,
    RecordingOption,
    ReplayOption,
    RepsOption,
    RpmOption,
    SampleSetOption,
    StrictModelOption,
    StudiesArgument,
    TpmOption,
    TrustOption,
    VariantsOption,
    YesOption,
    levels,
    listed,
)
from merge_runner.cli.output import print_out, say
from merge_runner.cli.playing import check_money_and_replay, play
from merge_runner.cli.stand_in import faults_of
from merge_runner.errors import UsageError
from merge_runner.paths import DEFAULT_CACHE, DEFAULT_DB, home_of

if TYPE_CHECKING:
    from merge_runner.run.plan import Plan

# Trials that failed, or are not recorded, are no reason to leave the next sweep out.
GOES_ON = (0, 1, 4)


def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A new folder, or an empty one.")],
) -> None:
    """Write a folder with a study that runs, to change into your own."""
    from merge_runner.study.folder import write_folder

    for path in write_folder(folder):
        say(f"wrote {path}")
    print_out(f"go on: cd {shlex.quote(str(folder))} && merge-runner sweep study.toml")


def sweep(
    studies: StudiesArgument,
    first: Annotated[
        bool,
        typer.Option("--first", help="Only the first decision of both sides, without the trial."),
    ] = False,
    grid: Annotated[
        str | None,
        typer.Option(
            "--grid",
            metavar="GRID",
            help="With --first, in the place of the study's conditions: "
            "h=FROM:TO:STEP,dv=FROM:TO:STEP, projected headways in m and relative velocities in "
            "m/s; usual: -6:6:2 and -1.6:1.6:0.4.",
        ),
    ] = None,
    model: ModelOption = None,
    only: OnlyOption = None,
    mirror: MirrorOption = False,
    reps: RepsOption = None,
    conditions: ConditionsOption = None,
    variants: VariantsOption = None,
    sample_set: SampleSetOption = 0,
    order_seed: Annotated[
        int, typer.Option("--order-seed", metavar="N", help="Another number draws another order.")
    ] = 0,
    db: DbOption = DEFAULT_DB,
    cache: CacheOption = DEFAULT_CACHE,
    in_flight: InFlightOption = 200,
    rpm: RpmOption = None,
    tpm: TpmOption = None,
    max_cost: MaxCostOption = None,
    dask: Annotated[
        str | None,
        typer.Option(
            "--dask",
            metavar="CLUSTER",
            help="Play on a Dask cluster: local:N, a scheduler's address, or its file.",
        ),
    ] = None,
    batch: BatchOption = False,
    strict_model: StrictModelOption = False,
    keep_going: KeepGoingOption = False,
    dry_run: DryRunOption = False,
    rehearse: Annotated[
        bool,
        typer.Option(
            "--rehearse",
            help="The emulator answers in the model's place, ten times as fast: no key, no cost.",
        ),
    ] = False,
    yes: YesOption = False,
    trust: TrustOption = False,
    replay: ReplayOption = False,
    recording: RecordingOption = None,
    fault_rate: Annotated[
        float,
        typer.Option(metavar="P", help="Emulator only: share of attempts with a transient fault."),
    ] = 0.0,
    faults: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Emulator only: a file of faults.")
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", help="Emulator only: seed of the faults.")] = 0,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Play all trials of one or more sweeps that are not stored yet."""
    from merge_runner.run.plan import Options, make_plan
    from merge_runner.run.seat import first_situations, grid_conditions

    check_money_and_replay(max_cost, recording, replay=replay)
    if dask is not None and replay:
        raise UsageError("a replay needs no cluster: leave --dask out")
    if grid is not None and not first:
        raise UsageError("--grid goes with --first")
    if grid is not None and conditions is not None:
        raise UsageError("--grid takes the place of --conditions: give one of them")
    options = Options(
        db=db,
        cache=cache,
        in_flight=in_flight,
        rpm=rpm,
        tpm=tpm,
        max_cost_usd=max_cost,
        replay=replay,
        recordings=recording or (),
        faults=faults_of(fault_rate, faults, seed),
        strict_model=strict_model,
        keep_going=keep_going,
        quiet=quiet,
        dask=dask,
        batch=batch,
    )

    def planned(name: str) -> Plan:
        plan = make_plan(
            name,
            model or (),
            reps,
            listed(conditions) if grid is None else grid_conditions(grid),
            listed(variants),
            sample_set=sample_set,
            order_seed=order_seed,
            only=levels(only or (), "--only"),
            mirror=mirror,
            db=db,
            trust=trust,
        )
        if dask is not None and plan.replays_humans:
            raise UsageError("human trials are replayed in this process: leave --dask out")
        return first_situations(plan) if first else plan

    if len(studies) > 1:  # all are looked at before the first one is played
        ledgers = [planned(name).ledger for name in studies]
        options = replace(options, ledgers=() if max_cost is None else ledgers)
    whole = any(part is not None for part in (reps, grid, conditions, variants))
    codes = []
    for name in studies:
        if len(studies) > 1:
            say(f"{name}:")
        plan, own = planned(name), options
        if rehearse:
            from merge_runner.run.rehearsal import rehearsed

            plan, own = rehearsed(plan, options, home_of(name))
        codes.append(play(plan, own, whole=whole, dry_run=dry_run, yes=yes, as_json=as_json))
        if codes[-1] not in GOES_ON:
            break
    sys.exit(next(filter(None, codes), 0))


@wraps(sweep, assigned=["__annotations__"])
def replay(**options: Any) -> None:  # noqa: ANN401 # those of sweep
    """Play a sweep from recorded replies alone: no key, no network."""
    sweep(**{**options, "replay": True})
