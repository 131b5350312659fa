"""The commands that put a driver into a situation without driving on from it."""

from __future__ import annotations

from typing import Annotated

import typer

from merge_runner import cli
from merge_runner.errors import UsageError
from merge_runner.paths import DEFAULT_CACHE, DEFAULT_DB

seat_app = typer.Typer(
    help="Situations asked by themselves, without the trial that follows.", no_args_is_help=True
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
    model: cli.ModelOption = None,
    only: cli.OnlyOption = None,
    samples: Annotated[
        int | None,
        typer.Option("--samples", help="How often each is asked; else the study's repetitions."),
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
    conditions: cli.ConditionsOption = None,
    variants: cli.VariantsOption = None,
    sample_set: cli.SampleSetOption = 0,
    db: cli.DbOption = DEFAULT_DB,
    cache: cli.CacheOption = DEFAULT_CACHE,
    in_flight: cli.InFlightOption = 200,
    rpm: cli.RpmOption = None,
    tpm: cli.TpmOption = None,
    max_cost: cli.MaxCostOption = None,
    strict_model: cli.StrictModelOption = False,
    dry_run: cli.DryRunOption = False,
    yes: cli.YesOption = False,
    replay: cli.ReplayOption = False,
    recording: cli.RecordingOption = None,
    as_json: cli.JsonOption = False,
) -> None:
    """Ask what drivers do first: both sides of each condition, without the rest of the trial."""
    from merge_runner.run.plan import Options, make_plan
    from merge_runner.run.seat import first_situations, grid_conditions

    cli.check_money_and_replay(max_cost, recording, replay=replay)
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
    )
    plan = make_plan(
        name,
        model or (),
        samples,
        cli.listed(conditions) if grid is None else grid_conditions(grid),
        cli.listed(variants),
        sample_set=sample_set,
        only=cli.levels(only or (), "--only"),
    )
    whole = any(part is not None for part in (samples, grid, conditions, variants))
    plan = first_situations(plan)
    cli.play(plan, options, whole=whole, dry_run=dry_run, yes=yes, as_json=as_json)
