"""The commands that play a study."""

# Annotations are no texts here: Typer would evaluate each of them four times.
import gc
import inspect
import json
import shlex
import sys
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import asdict, replace
from datetime import UTC, datetime
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from merge_runner.cli import options as cli
from merge_runner.cli.options import agree, print_out
from merge_runner.cli.signals import on_signal
from merge_runner.errors import UsageError
from merge_runner.paths import DEFAULT_CACHE, DEFAULT_DB
from merge_runner.text_safety import say

if TYPE_CHECKING:
    from merge_runner.run.estimate import Estimate
    from merge_runner.run.options import Options
    from merge_runner.run.plan import Plan

STUDIES = (
    "A study: a path, or one of experiments (baseline, the default; ablations; reference). In a "
    "replay, also a recording, FILE.parquet. Several are played one after the other."
)
MIRROR = "Play pairs of different drivers in both positions."
GRID = (
    "With --first: ask in each combination of projected headways h, in m, and relative velocities "
    "dv, in m/s, each as FROM:TO:STEP or one number, such as h=-6:6:2,dv=0. `--grid usual` is "
    "h=-6:6:2,dv=-1.6:1.6:0.4; a part that you leave out is taken from it. Default: no grid, but "
    "the study's conditions."
)
RUN_NAME = "Your name for this run, in lists of runs and in its summary."
SAMPLES = "Another number asks for a new, independent set of replies."
ORDER = "Another number plays the trials in another order."
FIRST = "Ask both drivers for their first decision only."
DRY_RUN = "Only estimate: trials, calls, tokens, cost, time. Nothing is sent."
SHOW_PROMPTS = "With --dry-run: print each prompt as its drivers read it."
IN_FLIGHT = "Trials played at once; with --dask, over all workers."
KEEP_GOING = "Go on although a model gives no valid decision."
REPLAY = "Play from recorded replies alone: no key, no network."
RPM, TPM = (
    f"Limit of {what} a minute. Default: that of the model's entry."
    for what in ("requests", "tokens")
)
MAX_COST = "Send no request that could bring the cost of all runs of the sweep above this."
STRICT = "Stop when another model answers than was requested."
DASK = "Play on a Dask cluster: local:N, a scheduler's address, or its file."
BATCH = "Send requests in the provider's batches: cheaper, but it takes hours."
# Parameters of sweep that replay does not list: it refuses batch and dask, and ignores the others.
UNLISTED = {"max_cost_usd", "batch", "in_flight", "rpm", "tpm", "dask", "strict_model"}
UNLISTED |= {"keep_going", "replay", "yes"}
RECORDING = (
    "In a replay, also use the replies of this file, without importing them; may be repeated."
)


def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A new folder, or an empty one.")],
) -> None:
    """Write a folder with an example study, to adapt.

    Example: merge-runner init my-study
    """
    from merge_runner.study.file import write_folder

    for path in write_folder(folder):
        say(f"wrote {path}")
    print_out(f"go on: cd {shlex.quote(str(folder))} && merge-runner sweep study.toml")


def sweep(
    studies: Annotated[list[str] | None, typer.Argument(metavar="NAME", help=STUDIES)] = None,
    models: cli.ModelOption = None,
    only: cli.OnlyOption = None,
    mirror: Annotated[bool, cli.flag("--mirror", MIRROR, **cli.PLAYED)] = False,
    repetitions: cli.RepsOption = None,
    conditions: cli.ConditionsOption = None,
    variants: cli.VariantsOption = None,
    run_name: Annotated[str, cli.option("TEXT", RUN_NAME, "--name", **cli.PLAYED)] = "",
    sample_set: Annotated[int, cli.option("N", SAMPLES, **cli.PLAYED)] = 0,
    order_seed: Annotated[int, cli.option("N", ORDER, **cli.PLAYED)] = 0,
    first: Annotated[bool, cli.flag("--first", FIRST, **cli.PLAYED)] = False,
    grid: Annotated[str | None, cli.option("GRID", GRID, **cli.PLAYED)] = None,
    dry_run: Annotated[bool, cli.flag("--dry-run", DRY_RUN, **cli.PACE)] = False,
    show_prompts: Annotated[bool, cli.flag("--show-prompts", SHOW_PROMPTS, **cli.PACE)] = False,
    max_cost_usd: Annotated[
        float | None, cli.option("USD", MAX_COST, "--max-cost", **cli.PACE)
    ] = None,
    batch: Annotated[bool, cli.flag("--batch", BATCH, **cli.PACE)] = False,
    in_flight: Annotated[int, cli.option("N", IN_FLIGHT, **cli.PACE)] = 200,
    rpm: Annotated[int | None, cli.option("N", RPM, **cli.PACE)] = None,
    tpm: Annotated[int | None, cli.option("N", TPM, **cli.PACE)] = None,
    dask: Annotated[str | None, cli.option("CLUSTER", DASK, **cli.PACE)] = None,
    strict_model: Annotated[bool, cli.flag("--strict-model", STRICT, **cli.FAULTS)] = False,
    keep_going: Annotated[bool, cli.flag("--keep-going", KEEP_GOING, **cli.FAULTS)] = False,
    replay: Annotated[bool, cli.flag("--replay", REPLAY, **cli.REPLAY)] = False,
    recordings: Annotated[
        list[Path] | None, cli.option("FILE", RECORDING, "--recording", **cli.REPLAY)
    ] = None,
    db: cli.DbOption = DEFAULT_DB,
    cache: cli.CacheOption = DEFAULT_CACHE,
    yes: cli.YesOption = False,
    trust: cli.TrustOption = False,
    quiet: Annotated[bool, cli.flag("--quiet", "Show no progress.", **cli.ASKED)] = False,
    as_json: cli.JsonOption = False,
) -> None:
    """Run a study. Stored trials are not run again.

    Example: merge-runner sweep baseline --model o3 --dry-run
    """
    from merge_runner.run.options import Options

    if show_prompts and not dry_run:
        raise UsageError("--show-prompts goes with --dry-run")
    if replay and dask is not None:
        raise UsageError("a replay needs no cluster: leave --dask out")
    if recordings and not replay:
        raise UsageError("--recording goes with a replay; to keep its replies: recording import")
    options = Options(
        db,
        cache,
        in_flight,
        rpm,
        tpm,
        max_cost_usd,
        replay=replay,
        recordings=recordings or (),
        strict_model=strict_model,
        keep_going=keep_going,
        quiet=quiet,
        dask=dask,
        batch=batch,
        typed=sys.argv[1:],
        name=run_name,
    )
    sizes = {
        "repetitions": repetitions,
        "grid": grid,
        "conditions": cli.listed(conditions),
        "variants": cli.listed(variants),
    }
    selection = sizes | {
        "models": models or (),
        "only": cli.levels(only or (), "--only"),
        "mirror": mirror,
        "first": first,
        "sample_set": sample_set,
        "order_seed": order_seed,
    }
    if dry_run:
        play = partial(_estimate, show_prompts=show_prompts, as_json=as_json)
    else:
        whole = any(size is not None for size in sizes.values())
        play = partial(_play_plan, whole=whole, yes=yes, as_json=as_json)
    plans = partial(_plans, selection=selection, options=options, trust=trust)
    # Trials leave no reference cycles, and to search those in memory would hold up the others.
    gc.set_threshold(1_000_000)
    sys.exit(_play_all(studies or ["baseline"], plans, play, options))


def _play_all(
    studies: Sequence[str],
    plans: Callable[[str], "list[Plan]"],
    play: Callable[["Plan", "Options"], int],
    options: "Options",
) -> int:
    """Play studies one after the other; return the first exit code that is not 0."""
    from merge_runner.llm.models import shutdown_notes

    planned = [(name, plans(name)) for name in studies]
    if options.max_cost_usd is not None:  # one cap covers them all
        ledgers = [plan.ledger for _, made in planned for plan in made]
        options = replace(options, ledgers=ledgers)
    codes = []
    for name, made in planned:
        if len(studies) > 1:
            say(f"{name}:")
        files = [Path(name)] if name.endswith(".parquet") else []
        played = replace(options, recordings=(*files, *options.recordings))
        for plan in made:
            if not options.replay:
                entries = {plan.registered[name]: entry for name, entry in plan.entries.items()}
                for note in shutdown_notes(entries, datetime.now(UTC).date()):
                    say(note)
            codes.append(play(plan, played))
        # Trials that failed, or are not recorded, are no reason to leave the next sweep out.
        if codes[-1] not in (0, 1, 4):
            break
    return next(filter(None, codes), 0)


def _plans(
    name: str, *, selection: dict[str, Any], options: "Options", trust: bool
) -> "list[Plan]":
    """Return the plan of a study, or those in a recording, which is played whole."""
    from merge_runner.run.plan import make_plan

    if name.endswith(".parquet"):
        from merge_runner.run.recorded_plans import recorded_plans

        if not options.replay:
            raise UsageError(f"{name} is a recording: merge-runner replay {name}")
        if any(selection.values()):
            raise UsageError(
                f"{name} is replayed as it was played: for a part of it, or other models, name "
                f"its study: merge-runner replay STUDY --recording {name}"
            )
        return [*recorded_plans(Path(name), db=options.db, trust=trust)]
    plan = make_plan(name, **selection, db=options.db, trust=trust)
    if options.dask is not None and plan.parts.replays_humans:
        raise UsageError("human-replay reads the database of this machine: leave --dask out")
    return [plan]


def _as_in_replay(parameter: inspect.Parameter) -> inspect.Parameter:
    kind, info = get_args(parameter.annotation)
    if parameter.name in UNLISTED:
        info = copy(info)
        info.hidden = True
    return parameter.replace(annotation=Annotated[kind, info])


@wraps(sweep, assigned=["__annotations__"])
def replay(**options: Any) -> None:  # noqa: ANN401 # the options of sweep
    """Run a study again from recorded replies alone: no key, no network.

    Example: merge-runner replay theirs.parquet
    """
    sweep(**{**options, "replay": True})


_parameters = inspect.signature(sweep).parameters.values()
replay.__signature__ = inspect.Signature([*map(_as_in_replay, _parameters)])  # type: ignore[attr-defined] # read by typer


def _estimate(plan: "Plan", options: "Options", *, show_prompts: bool, as_json: bool) -> int:
    import asyncio

    from merge_runner.run import estimate_lines as lines
    from merge_runner.run.sweep import unsent

    expected = asyncio.run(unsent(plan, options, say=say))
    if as_json:
        prompts = {"prompts": lines.shown_prompts(plan)} if show_prompts else {}
        print_out(json.dumps(asdict(expected) | prompts, ensure_ascii=False))
        return 0
    blocks = lines.shown_prompt_lines if show_prompts else lines.prompt_lines
    sent = ["Nothing was sent."] if expected.trials else []
    print_out("\n".join([*lines.estimate_lines(expected), *blocks(plan), *sent]))
    return 0


def _play_plan(plan: "Plan", options: "Options", *, whole: bool, yes: bool, as_json: bool) -> int:
    import asyncio

    from merge_runner.run.interrupt import INTERRUPTED
    from merge_runner.run.summary import as_lines
    from merge_runner.run.sweep import play

    def ask(expected: "Estimate") -> None:
        from merge_runner.run.estimate_lines import estimate_lines

        lines = "\n".join(estimate_lines(expected))
        agree(lines, "Go ahead?", otherwise="nothing was sent", yes=yes)

    try:
        playing = play(plan, options, whole=whole, say=say, agree=ask, stopping=on_signal)
        facts = asyncio.run(playing)
    except KeyboardInterrupt:  # before the trials began or after they ended
        say("interrupted: run the same command again to go on")
        return INTERRUPTED
    as_text = json.dumps(facts, ensure_ascii=False) if as_json else "\n".join(as_lines(facts))
    print_out(as_text)
    for message in facts["messages"]:
        say(f"error: {message}")
    return int(facts["exit_code"])
