"""The commands that play a study."""

from __future__ import annotations

import shlex
import sys
from dataclasses import replace
from functools import wraps
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from merge_runner.cli.options import (
    CacheOption,
    ConditionsOption,
    DbOption,
    JsonOption,
    ModelOption,
    OnlyOption,
    RepsOption,
    TrustOption,
    VariantsOption,
    levels,
    listed,
)
from merge_runner.cli.output import print_out, say
from merge_runner.cli.playing import play
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
    from merge_runner.study.file import write_folder

    for path in write_folder(folder):
        say(f"wrote {path}")
    print_out(f"go on: cd {shlex.quote(str(folder))} && merge-runner sweep study.toml")


def _studies() -> list[str]:
    from merge_runner.study.file import study_files

    return sorted(study_files())


def sweep(
    studies: Annotated[
        list[str],
        typer.Argument(
            metavar="NAME...",
            autocompletion=_studies,
            help="experiments/NAME.toml, or a path. Several are played one after the other.",
        ),
    ],
    first: Annotated[
        bool,
        typer.Option("--first", help="Only the first decision of both sides, without the trial."),
    ] = False,
    grid: Annotated[
        str | None,
        typer.Option(
            metavar="GRID",
            help="With --first, in the place of the study's conditions: "
            "h=FROM:TO:STEP,dv=FROM:TO:STEP, projected headways in m and relative velocities in "
            "m/s; usual: -6:6:2 and -1.6:1.6:0.4.",
        ),
    ] = None,
    model: ModelOption = None,
    only: OnlyOption = None,
    mirror: Annotated[
        bool,
        typer.Option(
            "--mirror",
            help="Also play two different drivers with their sides changed, as LEFT+RIGHT.",
        ),
    ] = False,
    reps: RepsOption = None,
    conditions: ConditionsOption = None,
    variants: VariantsOption = None,
    sample_set: Annotated[
        int, typer.Option(metavar="N", help="Another number draws a fresh set of samples.")
    ] = 0,
    order_seed: Annotated[
        int, typer.Option(metavar="N", help="Another number draws another order.")
    ] = 0,
    db: DbOption = DEFAULT_DB,
    cache: CacheOption = DEFAULT_CACHE,
    in_flight: Annotated[
        int, typer.Option(metavar="N", help="Trials at once, over all workers.", min=1)
    ] = 200,
    rpm: Annotated[int | None, typer.Option(metavar="N", help="Requests a minute.", min=1)] = None,
    tpm: Annotated[int | None, typer.Option(metavar="N", help="Tokens a minute.", min=1)] = None,
    max_cost: Annotated[
        float | None,
        typer.Option(metavar="USD", help="Never spend more on this, over all its runs.", min=0),
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option(
            metavar="CLUSTER",
            help="Play on a Dask cluster: local:N, a scheduler's address, or its file.",
        ),
    ] = None,
    batch: Annotated[
        bool,
        typer.Option(
            "--batch",
            help="Ask in the provider's batches, one decision of all trials a round, at a lower "
            "price.",
        ),
    ] = False,
    strict_model: Annotated[
        bool, typer.Option("--strict-model", help="Stop when another model answers.")
    ] = False,
    keep_going: Annotated[
        bool, typer.Option("--keep-going", help="Go on with a model that gives no valid decision.")
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only estimate.")] = False,
    rehearse: Annotated[
        bool,
        typer.Option(
            "--rehearse",
            help="The emulator answers in the model's place, ten times as fast: no key, no cost.",
        ),
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before spending.")] = False,
    trust: TrustOption = False,
    replay: Annotated[bool, typer.Option("--replay", help="From recorded replies alone.")] = False,
    recording: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="Also replay from this file, without importing it; may be repeated.",
        ),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Show no progress.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Play all trials of one or more sweeps that are not stored yet."""
    from merge_runner.run.plan import Options, make_plan
    from merge_runner.run.seat import first_situations, grid_conditions

    for refused, advice in (
        (not isfinite(max_cost or 0), "--max-cost is a number of USD"),
        (
            recording and not replay,
            "--recording goes with a replay; to keep its replies: recording import",
        ),
        (dask is not None and replay, "a replay needs no cluster: leave --dask out"),
        (grid is not None and not first, "--grid goes with --first"),
        (
            None not in (grid, conditions),
            "--grid takes the place of --conditions: give one of them",
        ),
    ):
        if refused:
            raise UsageError(advice)
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
