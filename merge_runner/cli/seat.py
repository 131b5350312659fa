"""The commands that put a driver into a situation without driving on from it."""

from __future__ import annotations

import sys
from typing import Annotated

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
    RpmOption,
    SampleSetOption,
    StrictModelOption,
    TpmOption,
    TrustOption,
    VariantsOption,
    YesOption,
    levels,
    listed,
)
from merge_runner.cli.playing import check_money_and_replay, play
from merge_runner.errors import UsageError
from merge_runner.paths import DEFAULT_CACHE, DEFAULT_DB

seat_app = typer.Typer(
    help="First decisions, without the trial that follows.", no_args_is_help=True
)


@seat_app.callback()
def seat() -> None:
    """Keeps ``first`` a command of its own while it is the only one."""


@seat_app.command()
def first(
    name: Annotated[
        str,
        typer.Argument(
            metavar="[NAME]", help="experiments/NAME.toml, or a path: prompts, factors."
        ),
    ] = "baseline",
    model: ModelOption = None,
    only: OnlyOption = None,
    mirror: MirrorOption = False,
    samples: Annotated[
        int | None,
        typer.Option(
            "--samples", metavar="N", help="How often each is asked; else the study's repetitions."
        ),
    ] = None,
    grid: Annotated[
        str | None,
        typer.Option(
            "--grid",
            metavar="GRID",
            help="In the place of the study's conditions: h=FROM:TO:STEP,dv=FROM:TO:STEP, "
            "projected headways in m and relative velocities in m/s; usual: -6:6:2 and "
            "-1.6:1.6:0.4.",
        ),
    ] = None,
    conditions: ConditionsOption = None,
    variants: VariantsOption = None,
    sample_set: SampleSetOption = 0,
    db: DbOption = DEFAULT_DB,
    cache: CacheOption = DEFAULT_CACHE,
    in_flight: InFlightOption = 200,
    rpm: RpmOption = None,
    tpm: TpmOption = None,
    max_cost: MaxCostOption = None,
    batch: BatchOption = False,
    strict_model: StrictModelOption = False,
    keep_going: KeepGoingOption = False,
    dry_run: DryRunOption = False,
    yes: YesOption = False,
    trust: TrustOption = False,
    replay: ReplayOption = False,
    recording: RecordingOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Ask both sides of each condition what they do first."""
    from merge_runner.run.plan import Options, make_plan
    from merge_runner.run.seat import first_situations, grid_conditions

    check_money_and_replay(max_cost, recording, replay=replay)
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
        strict_model=strict_model,
        keep_going=keep_going,
        quiet=quiet,
        batch=batch,
    )
    plan = make_plan(
        name,
        model or (),
        samples,
        listed(conditions) if grid is None else grid_conditions(grid),
        listed(variants),
        sample_set=sample_set,
        only=levels(only or (), "--only"),
        db=db,
        mirror=mirror,
        trust=trust,
    )
    whole = any(part is not None for part in (samples, grid, conditions, variants))
    plan = first_situations(plan)
    sys.exit(play(plan, options, whole=whole, dry_run=dry_run, yes=yes, as_json=as_json))
