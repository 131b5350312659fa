"""The commands that play a study, or say what that would take."""

from __future__ import annotations

import json
import shlex
import signal
import sys
from dataclasses import asdict, fields, replace
from datetime import UTC, datetime
from functools import wraps
from inspect import signature
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from merge_runner.cli import options as cli
from merge_runner.cli.options import agree, print_out
from merge_runner.errors import UsageError
from merge_runner.paths import DEFAULT_CACHE, DEFAULT_DB, home_of
from merge_runner.text_safety import say

if TYPE_CHECKING:
    from merge_runner.run.estimate import Estimate
    from merge_runner.run.plan import Options, Plan

# Trials that failed, or are not recorded, are no reason to leave the next sweep out.
GOES_ON = (0, 1, 4)
REHEARSALS = Path("results/rehearsal")
GRID = (
    "With --first, in the place of the study's conditions: h=FROM:TO:STEP,dv=FROM:TO:STEP, "
    "projected headways in m and relative velocities in m/s; usual: -6:6:2 and -1.6:1.6:0.4."
)
MAX_COST = "Never spend more on this, over all its runs."
STRICT = "Stop when another model answers."
KEEP_GOING = "Go on with a model that gives no valid decision."
DASK = "Play on a Dask cluster: local:N, a scheduler's address, or its file."
BATCH = "Ask in the provider's batches, a decision of all trials a round, at a lower price."
REHEARSE = "The emulator answers in the model's place, ten times as fast: no key, no cost."
RECORDING = "Also replay from this file, without importing it; may be repeated."


def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A new folder, or an empty one.")],
) -> None:
    """Write a folder with a study that runs, to change into your own."""
    from merge_runner.study.file import write_folder

    for path in write_folder(folder):
        say(f"wrote {path}")
    print_out(f"go on: cd {shlex.quote(str(folder))} && merge-runner sweep study.toml")


def sweep(
    studies: Annotated[
        list[str],
        typer.Argument(
            metavar="NAME...",
            help="experiments/NAME.toml, or a path. Several are played one after the other.",
        ),
    ],
    first: Annotated[bool, cli.flag("--first", "Only the first decision of both sides.")] = False,
    grid: Annotated[str | None, cli.option("GRID", GRID)] = None,
    models: cli.ModelOption = None,
    only: cli.OnlyOption = None,
    mirror: Annotated[bool, cli.flag("--mirror", "Also play two drivers both ways.")] = False,
    repetitions: cli.RepsOption = None,
    conditions: cli.ConditionsOption = None,
    variants: cli.VariantsOption = None,
    sample_set: Annotated[int, cli.option("N", "Another number draws a fresh set of samples.")] = 0,
    order_seed: Annotated[int, cli.option("N", "Another number draws another order.")] = 0,
    db: cli.DbOption = DEFAULT_DB,
    cache: cli.CacheOption = DEFAULT_CACHE,
    in_flight: Annotated[int, cli.option("N", "Trials at once, over all workers.", min=1)] = 200,
    rpm: Annotated[int | None, cli.option("N", "Requests a minute.", min=1)] = None,
    tpm: Annotated[int | None, cli.option("N", "Tokens a minute.", min=1)] = None,
    max_cost_usd: Annotated[float | None, cli.option("USD", MAX_COST, "--max-cost", min=0)] = None,
    dask: Annotated[str | None, cli.option("CLUSTER", DASK)] = None,
    batch: Annotated[bool, cli.flag("--batch", BATCH)] = False,
    strict_model: Annotated[bool, cli.flag("--strict-model", STRICT)] = False,
    keep_going: Annotated[bool, cli.flag("--keep-going", KEEP_GOING)] = False,
    dry_run: Annotated[bool, cli.flag("--dry-run", "Only estimate.")] = False,
    rehearse: Annotated[bool, cli.flag("--rehearse", REHEARSE)] = False,
    yes: cli.YesOption = False,
    trust: cli.TrustOption = False,
    replay: Annotated[bool, cli.flag("--replay", "From recorded replies alone.")] = False,
    recordings: Annotated[list[Path] | None, cli.option("FILE", RECORDING, "--recording")] = None,
    quiet: Annotated[bool, cli.flag("--quiet", "Show no progress.")] = False,
    as_json: cli.JsonOption = False,
) -> None:
    """Play all trials of one or more sweeps that are not stored yet."""
    given = {name: value for name, value in locals().items() if value is not None}
    from merge_runner.run.plan import Options, make_plan

    if not isfinite(max_cost_usd or 0):
        raise UsageError("--max-cost is a number of USD")
    if recordings and not replay:
        raise UsageError("--recording goes with a replay; to keep its replies: recording import")
    known = {each.name for each in fields(Options)} & given.keys() - {"dry_run"}
    options = Options(**{name: given[name] for name in known})
    wanted = {name: given[name] for name in signature(make_plan).parameters if name in given}
    wanted |= {"conditions": cli.listed(conditions), "variants": cli.listed(variants)}
    wanted["only"] = cli.levels(only or (), "--only")

    def planned(name: str) -> Plan:
        plan = make_plan(name, **wanted)
        if dask is not None and (replay or plan.replays_humans):
            raise UsageError("a replay needs no cluster: leave --dask out")
        return plan

    if len(studies) > 1:  # all are looked at before the first one is played
        ledgers = [planned(name).ledger for name in studies]
        options = replace(options, ledgers=() if max_cost_usd is None else ledgers)
    whole = any(part is not None for part in (repetitions, grid, conditions, variants))
    codes = []
    for name in studies:
        if len(studies) > 1:
            say(f"{name}:")
        plan, own = planned(name), options
        if rehearse:
            plan, own = _rehearsed(plan, options, home_of(name))
        codes.append(_play(plan, own, whole=whole, dry_run=dry_run, yes=yes, as_json=as_json))
        if codes[-1] not in GOES_ON:
            break
    sys.exit(next(filter(None, codes), 0))


@wraps(sweep, assigned=["__annotations__"])
def replay(**options: Any) -> None:  # noqa: ANN401 # those of sweep
    """Play a sweep from recorded replies alone: no key, no network."""
    sweep(**{**options, "replay": True})


def _rehearsed(plan: Plan, options: Options, home: Path) -> tuple[Plan, Options]:
    """The sweep as it is, with the emulator in the place of its provider.

    ``home`` is the folder in which the results of the sweep lie. Raises UsageError.
    """
    from merge_runner.config import PROVIDERS, REHEARSAL, ModelEntry, endpoint_identity
    from merge_runner.llm.models import load_models

    def possible(entry: ModelEntry) -> bool:
        provider = PROVIDERS.require(entry.provider)
        is_own = endpoint_identity(entry) == entry.provider and entry.path is None
        return is_own and provider.key_needed and provider.base_url_env is not None

    is_usual = (options.db, options.cache) == (home / DEFAULT_DB, home / DEFAULT_CACHE)
    if not is_usual or options.replay or options.dask or options.batch:
        raise UsageError(
            f"a rehearsal keeps what it makes in {REHEARSALS}, plays in this process and asks "
            "singly: leave --db, --cache, --dask, --replay and --batch out"
        )
    models = {plan.registered[name] for name in plan.entries}
    if len(models) != 1 or not all(map(possible, plan.entries.values())):
        registry = load_models(plan.study.path.parent)
        valid = ", ".join(name for name, entry in registry.items() if possible(entry))
        raise UsageError(
            f"--rehearse takes one model at its provider's own address: --model with one of {valid}"
        )
    db, cache = home / REHEARSALS / "merge.duckdb", home / REHEARSALS / "responses"
    plan = plan.model_copy(update={"endpoints": dict.fromkeys(plan.entries, REHEARSAL)})
    return plan, replace(options, db=db, cache=cache)


def _play(
    plan: Plan, options: Options, *, whole: bool, dry_run: bool, yes: bool, as_json: bool
) -> int:
    """Play a plan, or print what that would take; return the exit code."""
    import asyncio

    from merge_runner.llm.models import shutdown_notes
    from merge_runner.run import sweep as running
    from merge_runner.run.summary import as_lines, estimate_lines

    if plan.is_rehearsal:
        say(f"REHEARSAL: the emulator answers as {plan.driver}; nobody else is asked, or charges")
    if not options.replay:
        asked = {plan.registered[name]: entry for name, entry in plan.entries.items()}
        for note in shutdown_notes(asked, datetime.now(UTC).date()):
            say(note)
    if dry_run:
        expected = asyncio.run(running.unsent(plan, options, say=say))
        lines = "\n".join(estimate_lines(expected))
        print_out(json.dumps(asdict(expected)) if as_json else f"{lines}\nNothing was sent.")
        return 0

    def leave(expected: Estimate) -> None:
        lines = "\n".join(estimate_lines(expected))
        by_asyncio = signal.signal(signal.SIGINT, signal.default_int_handler)
        try:  # Ctrl-C is an answer, too
            agree(lines, "Go ahead?", otherwise="nothing was sent", yes=yes)
        finally:
            signal.signal(signal.SIGINT, by_asyncio)

    try:
        facts = asyncio.run(running.play(plan, options, whole=whole, say=say, agree=leave))
    except KeyboardInterrupt:  # before the trials began or after they ended
        say("interrupted: run the same command again to go on")
        return running.INTERRUPTED
    as_text = json.dumps(facts, ensure_ascii=False) if as_json else "\n".join(as_lines(facts))
    print_out(as_text)
    for message in facts["messages"]:
        say(f"error: {message}")
    return int(facts["exit_code"])
