"""The commands: they play a study, show results, keep recordings, and serve the emulator."""

from __future__ import annotations

import json
import shlex
import shutil
import sys
import tempfile
from contextlib import closing
from dataclasses import asdict, replace
from datetime import UTC, datetime
from functools import wraps
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from merge_runner.cli import options as cli
from merge_runner.cli.help import Program
from merge_runner.cli.options import agree, print_out
from merge_runner.cli.signals import on_signal
from merge_runner.errors import UsageError, unknown_name
from merge_runner.paths import DEFAULT_CACHE, DEFAULT_DB
from merge_runner.text_safety import say

if TYPE_CHECKING:
    from merge_runner.run.estimate import Estimate
    from merge_runner.run.options import Options
    from merge_runner.run.plan import Plan

# Trials that failed, or are not recorded, are no reason to leave the next sweep out.
GRID = (
    "With --first, in the place of the study's conditions: h=FROM:TO:STEP,dv=FROM:TO:STEP, "
    "projected headways in m and relative velocities in m/s; usual: -6:6:2 and -1.6:1.6:0.4."
)
RUN_NAME = "What you call this run, as lists of runs and its summary show it."
SAMPLES = "Another number draws a fresh set of samples."
ORDER = "Another number draws another order of the trials."
FIRST = "Only the first decision of both sides."
DRY_RUN = "Only estimate: trials, calls, tokens, cost, time. Nothing is sent."
SHOW_PROMPTS = "With --dry-run: print each prompt as its drivers read it."
IN_FLIGHT = "Trials at once, over all workers."
KEEP_GOING = "Go on with a model that gives no valid decision."
REPLAY = "From recorded replies alone: no key, no network."
MAX_COST = "Never spend more on this, over all its runs."
STRICT = "Stop when another model answers."
DASK = "Play on a Dask cluster: local:N, a scheduler's address, or its file."
BATCH = "Send requests in the provider's batches: cheaper, but it takes hours."
RECORDING = "Also replay from this file, without importing it; may be repeated."
CACHE = "Replay from this cache folder, not from the stored replies."
NOT_BOTH = "--sweep names a run, --study all runs of a study: leave one of them out"
SWEEP = "A sweep_id, which may be repeated; the newest sweep if none is given."
Form = Literal["text", "csv", "json"]
RecordingFile = Annotated[Path, typer.Argument(metavar="FILE", help="A recording (.parquet).")]

recording_app = Program(help="Portable recordings: one Parquet file that anyone can replay.")


def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A new folder, or an empty one.")],
) -> None:
    """Write a folder with a study that runs, to change into your own.

    Example: merge-runner init my-study
    """
    from merge_runner.study.file import write_folder

    for path in write_folder(folder):
        say(f"wrote {path}")
    print_out(f"go on: cd {shlex.quote(str(folder))} && merge-runner sweep study.toml")


def sweep(
    studies: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="NAME...",
            help="experiments/NAME.toml, or a path; baseline if none is named; to replay also a "
            "recording, FILE.parquet. Several are played one after the other.",
        ),
    ] = None,
    models: cli.ModelOption = None,
    only: cli.OnlyOption = None,
    mirror: Annotated[
        bool, cli.flag("--mirror", "Also play two drivers both ways.", **cli.PLAYED)
    ] = False,
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
        float | None, cli.option("USD", MAX_COST, "--max-cost", min=0, **cli.PACE)
    ] = None,
    batch: Annotated[bool, cli.flag("--batch", BATCH, **cli.PACE)] = False,
    in_flight: Annotated[int, cli.option("N", IN_FLIGHT, min=1, **cli.PACE)] = 200,
    rpm: Annotated[int | None, cli.option("N", "Requests a minute.", min=1, **cli.PACE)] = None,
    tpm: Annotated[int | None, cli.option("N", "Tokens a minute.", min=1, **cli.PACE)] = None,
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
    """Run a study. What is already stored is not run again.

    Example: merge-runner sweep baseline --model o3 --dry-run
    """
    from merge_runner.run.options import Options
    from merge_runner.run.plan import make_plan
    from merge_runner.run.recorded_plans import recorded_plans

    studies = studies or ["baseline"]
    if not isfinite(max_cost_usd or 0):
        raise UsageError("--max-cost is a number of USD")
    if show_prompts and not dry_run:
        raise UsageError("--show-prompts goes with --dry-run")
    if recordings and not replay:
        raise UsageError("--recording goes with a replay; to keep its replies: recording import")
    options = Options(
        db=db,
        cache=cache,
        in_flight=in_flight,
        rpm=rpm,
        tpm=tpm,
        max_cost_usd=max_cost_usd,
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

    def plans(name: str) -> list[Plan]:
        if name.endswith(".parquet"):
            chosen = (models, only, mirror, repetitions, conditions, variants, first, grid)
            _refuse_a_part(name, chosen=any((*chosen, sample_set, order_seed)), replay=replay)
            return [*recorded_plans(Path(name), db=db, trust=trust)]
        plan = make_plan(
            name,
            models or (),
            repetitions,
            cli.listed(conditions),
            cli.listed(variants),
            sample_set=sample_set,
            order_seed=order_seed,
            only=cli.levels(only or (), "--only"),
            db=db,
            mirror=mirror,
            first=first,
            grid=grid,
            trust=trust,
        )
        if dask is not None and (replay or plan.replays_humans):
            raise UsageError("a replay needs no cluster: leave --dask out")
        return [plan]

    if len(studies) > 1:  # all are looked at before the first one is played
        ledgers = [plan.ledger for name in studies for plan in plans(name)]
        options = replace(options, ledgers=() if max_cost_usd is None else ledgers)
    whole = any(part is not None for part in (repetitions, grid, conditions, variants))
    codes = []
    for name in studies:
        if len(studies) > 1:
            say(f"{name}:")
        files = [Path(name)] if name.endswith(".parquet") else []
        played = replace(options, recordings=(*files, *options.recordings))
        codes += [
            _estimate(plan, played, show_prompts=show_prompts, as_json=as_json)
            if dry_run
            else _play(plan, played, whole=whole, yes=yes, as_json=as_json)
            for plan in plans(name)
        ]
        if codes[-1] not in (0, 1, 4):
            break
    sys.exit(next(filter(None, codes), 0))


def _refuse_a_part(recording: str, *, chosen: bool, replay: bool) -> None:
    """Raise UsageError unless a recording is replayed whole."""
    if not replay:
        raise UsageError(f"{recording} is a recording: merge-runner replay {recording}")
    if chosen:
        raise UsageError(
            f"{recording} is replayed as it was played: for a part of it, or other models, name "
            f"its study: merge-runner replay STUDY --recording {recording}"
        )


@wraps(sweep, assigned=["__annotations__"])
def replay(**options: Any) -> None:  # noqa: ANN401 # those of sweep
    """Run a study again from recorded replies alone: no key, no network.

    Example: merge-runner replay theirs.parquet
    """
    sweep(**{**options, "replay": True})


def _say_shutdowns(plan: Plan, options: Options) -> None:
    from merge_runner.llm.models import shutdown_notes

    if not options.replay:
        asked = {plan.registered[name]: entry for name, entry in plan.entries.items()}
        for note in shutdown_notes(asked, datetime.now(UTC).date()):
            say(note)


def _estimate(plan: Plan, options: Options, *, show_prompts: bool, as_json: bool) -> int:
    """Print what it would take to play a plan; return the exit code."""
    import asyncio

    from merge_runner.run import estimate_lines as lines
    from merge_runner.run.sweep import unsent

    _say_shutdowns(plan, options)
    expected = asyncio.run(unsent(plan, options, say=say))
    if as_json:
        prompts = {"prompts": lines.shown_prompts(plan)} if show_prompts else {}
        print_out(json.dumps(asdict(expected) | prompts, ensure_ascii=False))
        return 0
    blocks = lines.shown_prompt_lines if show_prompts else lines.prompt_lines
    sent = ["Nothing was sent."] if expected.trials else []
    print_out("\n".join([*lines.estimate_lines(expected), *blocks(plan), *sent]))
    return 0


def _play(plan: Plan, options: Options, *, whole: bool, yes: bool, as_json: bool) -> int:
    """Play a plan; return the exit code."""
    import asyncio

    from merge_runner.run import sweep as running
    from merge_runner.run.estimate_lines import estimate_lines
    from merge_runner.run.interrupt import INTERRUPTED
    from merge_runner.run.summary import as_lines

    _say_shutdowns(plan, options)

    def leave(expected: Estimate) -> None:
        lines = "\n".join(estimate_lines(expected))
        agree(lines, "Go ahead?", otherwise="nothing was sent", yes=yes)

    try:
        playing = running.play(plan, options, whole=whole, say=say, agree=leave, stopping=on_signal)
        facts = asyncio.run(playing)
    except KeyboardInterrupt:  # before the trials began or after they ended
        say("interrupted: run the same command again to go on")
        return INTERRUPTED
    as_text = json.dumps(facts, ensure_ascii=False) if as_json else "\n".join(as_lines(facts))
    print_out(as_text)
    for message in facts["messages"]:
        say(f"error: {message}")
    return int(facts["exit_code"])


def sql(
    query: Annotated[str, typer.Argument(metavar="QUERY", help="One SQL query.")],
    db: cli.DbOption = DEFAULT_DB,
    output: Annotated[
        Form, cli.option("FORM", "text (the default), csv or json.", "--format", show_default=False)
    ] = "text",
    as_json: cli.JsonOption = False,
) -> None:
    """Query the results; also while a sweep runs. Nothing can be changed.

    Example: merge-runner sql "select status, count(*) from trials group by all"
    """
    from merge_runner.results import database, export, store

    writers = {"text": export.write_table, "csv": export.write_csv, "json": export.write_json}
    # A slow reader of a pipe would otherwise keep every sweep from writing meanwhile.
    with tempfile.TemporaryFile("w+", encoding="utf-8", newline="") as spooled:
        with store.answer(db, query) as result:
            writers["json" if as_json else output](
                database.names_of(result), database.fetched(result), spooled
            )
        spooled.seek(0)
        shutil.copyfileobj(spooled, sys.stdout)


def digest(
    db: cli.DbOption = DEFAULT_DB,
    study: cli.StudyOption = None,
    as_json: cli.JsonOption = False,
) -> None:
    """Print one line: a hash of all results, equal for equal results.

    Example: merge-runner digest --study my-study/study.toml
    """
    from merge_runner.results.store import results_digest

    value, trials = results_digest(db, cli.runs_of_study(study, db))
    as_text = f"{value}  {trials} trials"
    print_out(json.dumps({"digest": value, "trials": trials}) if as_json else as_text)


def audit(
    db: cli.DbOption = DEFAULT_DB,
    sweep_id: Annotated[
        str | None, cli.option("ID", "A sweep_id; everything if not given.", "--sweep")
    ] = None,
    recording: Annotated[
        Path | None, cli.option("FILE", "Check this recording instead of a database.")
    ] = None,
    cache: Annotated[Path | None, cli.option("DIR", CACHE)] = None,
    study: cli.StudyOption = None,
    trust: cli.TrustOption = False,
    as_json: cli.JsonOption = False,
) -> None:
    """Check that each trial is there and follows from its replies.

    Example: merge-runner audit --recording baseline.parquet
    """
    from merge_runner.audit.checks import audit_recording
    from merge_runner.run.stored_replay import NOT_REPLAYED, audit_database

    cli.use_study(study, trust=trust)
    skipped: list[str] = []
    if recording is not None:
        if any(each is not None for each in (sweep_id, cache, study)):
            raise UsageError(
                "--recording is checked by itself: without --sweep, --study and --cache"
            )
        audits = [audit_recording(recording)]
    else:
        if sweep_id is not None and study is not None:
            raise UsageError(NOT_BOTH)
        named = [sweep_id] if sweep_id is not None else cli.runs_of_study(study, db)
        audits = audit_database(db, named, cache)
        told = {"calls.cached"} if cache is not None else set(NOT_REPLAYED)
        skipped = [name for name in NOT_REPLAYED if name in told or "calls" not in name]
    ok = all(found.ok for found in audits)
    if as_json:
        whole = {"ok": ok, "not_replayed": skipped, "audits": [found.as_dict() for found in audits]}
        print_out(json.dumps(whole, ensure_ascii=False))
    else:
        for found in audits:
            print_out("\n".join(found.lines()))
        if skipped:
            print_out(f"not checked, since no replay tells it: {', '.join(skipped)}")
    sys.exit(0 if ok else 1)


def forget(
    sweeps: Annotated[
        list[str], typer.Argument(metavar="SWEEP...", help="A sweep_id; * stands for anything.")
    ],
    db: cli.DbOption = DEFAULT_DB,
    yes: cli.YesOption = False,
) -> None:
    """Remove sweeps and their trials from the database.

    Their replies stay in the cache.

    Example: merge-runner forget "baseline-*"
    """
    from merge_runner.results import store
    from merge_runner.run.progress_file import running

    for busy in running(db):
        raise UsageError(
            f"the sweep {busy.sweep_id} is running into {db}: stop it, or wait for its end"
        )
    ids, going = store.to_forget(db, sweeps)
    agree(f"these go from {db}: {going}", "Remove them?", otherwise="nothing was removed", yes=yes)
    store.forget(db, ids)
    say(
        f"removed: {going}. Their replies stay in the cache: the same `merge-runner sweep` plays "
        "the trials again without a call"
    )


@recording_app.command("export")
def recording_export(
    file: RecordingFile,
    db: cli.DbOption = DEFAULT_DB,
    cache: cli.CacheOption = DEFAULT_CACHE,
    sweeps: Annotated[list[str] | None, cli.option("ID", SWEEP, "--sweep")] = None,
    study: cli.StudyOption = None,
) -> None:
    """Write what sweeps asked and were answered into one file.

    Example: merge-runner recording export mine.parquet
    """
    from merge_runner.llm.cache import ResponseCache
    from merge_runner.results.recording import carried_plugins, export_recording, provenance_of
    from merge_runner.results.store import recorded_sweeps, sweeps_with_calls

    if sweeps and study is not None:
        raise UsageError(NOT_BOTH)
    rows, keys = recorded_sweeps(db, sweeps or cli.runs_of_study(study, db) or ())
    found = " and ".join(row["sweep_id"] for row in rows)
    if not keys:
        others = " or ".join(f"--sweep {sweep_id}" for sweep_id in sweeps_with_calls(db))
        raise UsageError(
            f"the sweep {found} made no call: there is nothing to record. "
            + (f"Name one that did: {others}" if others else f"None in {db} did: programs drove")
        )
    provenance = provenance_of(rows)
    with closing(ResponseCache(cache, read_only=True)) as opened:
        calls = export_recording(file, opened, keys, provenance)
    say(f"{calls} calls of {found} are in {file}")
    if plugins := carried_plugins(provenance):
        say(f"with them the whole source of the study's plug-ins: {', '.join(plugins)}")


@recording_app.command("import")
def recording_import(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="A recording (.parquet), or a cache folder.")
    ],
    cache: cli.CacheOption = DEFAULT_CACHE,
) -> None:
    """Verify a recording or a cache folder, and add it to the cache.

    Example: merge-runner recording import theirs.parquet
    """
    from merge_runner.llm.cache import ResponseCache, import_folder
    from merge_runner.results.recording import import_recording

    take = import_folder if file.is_dir() else import_recording
    with closing(ResponseCache(cache)) as opened:
        added, there = take(file, opened)
    say(f"{added} calls added to {cache}, {there} were there already")


@recording_app.command("verify")
def recording_verify(file: RecordingFile) -> None:
    """Check that a file is as it was exported.

    Example: merge-runner recording verify theirs.parquet
    """
    from merge_runner.results.recording import summarise

    found = summarise(file)
    say(f"{file} is whole: {found['calls']} calls, as they were exported")


@recording_app.command("info")
def recording_info(
    file: RecordingFile,
    as_json: cli.JsonOption = False,
) -> None:
    """Verify a recording and print what it holds.

    Example: merge-runner recording info theirs.parquet
    """
    from merge_runner.results.recording import summarise, summary_lines

    found = summarise(file)
    as_text = json.dumps(found, indent=2, ensure_ascii=False) if as_json else ""
    print_out(as_text or "\n".join(summary_lines(file, found)))


def ledger(
    cache: cli.CacheOption = DEFAULT_CACHE,
    release: Annotated[
        str | None, cli.option("SWEEP", "Stop counting what is set aside.", "--release")
    ] = None,
    yes: cli.YesOption = False,
    as_json: cli.JsonOption = False,
) -> None:
    """Show what each sweep has spent, and what is set aside.

    Example: merge-runner ledger --cache cache/responses
    """
    from merge_runner.llm.cache import ResponseCache
    from merge_runner.llm.cache_file import require
    from merge_runner.llm.ledger import APART, Ledger, scopes
    from merge_runner.run.summary import as_table

    require(cache)
    with closing(ResponseCache(cache, read_only=release is None)) as opened:
        names = scopes(opened)
        if release is not None:
            if release not in names:
                raise unknown_name("sweep", release, names, f"with a ledger in {cache}")
            chosen = Ledger(opened, release)
            spending = chosen.read()
            agree(
                f"{spending.reserved_usd:.4f} USD are set aside for {spending.open_attempts} "
                f"attempts at {release}. If the provider did charge for them, --max-cost may be "
                "passed by as much",
                "Release it?",
                otherwise="nothing was released",
                yes=yes,
            )
            if not opened.locks.take_all():
                raise UsageError(
                    f"another merge-runner works with {cache}: what it has in flight cannot be "
                    "released; try again when it has ended"
                )
            chosen.release()
            names = [release]
        ledgers = [Ledger(opened, name) for name in names]
        rows = [
            {"sweep": each.scope, **asdict(each.read()), "reasons": each.reasons()}
            for each in ledgers
        ]
        # Without a process nothing is awaited, but by a batch: the next run asks for that.
        if opened.locks.take_all():
            for reason in (reason for row in rows for reason in row["reasons"]):
                if reason["outcome"] == "in flight":
                    reason["outcome"] = "in flight when its process ended"
    if as_json:
        print_out(json.dumps(rows, ensure_ascii=False))
        return
    reasons = [{"sweep": row["sweep"], **reason} for row in rows for reason in row.pop("reasons")]
    told = "\n".join(filter(None, map(as_table, (_shown_spending(rows), reasons))))
    print_out(f"{told}\n{APART}" if told else "Nothing is spent.")


def _shown_spending(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What the ledgers hold, for a reader: without columns that are 0 or empty in all of them."""
    kept = [name for name in rows[0] if any(row[name] for row in rows)] if rows else []
    heads = {"open_attempts": "attempts of unknown cost"}
    return [{heads.get(name, name): row[name] for name in kept} for row in rows]


def models(as_json: cli.JsonOption = False) -> None:
    """List the models and programs that can drive.

    Example: merge-runner models --json
    """
    from merge_runner.config import Price, key_status
    from merge_runner.drivers.registry import PROGRAMS
    from merge_runner.llm.models import load_models, shutdown_notes
    from merge_runner.llm.prices import cost_usd
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

    Example: merge-runner emulate --port 8765
    """
    import asyncio

    from merge_runner.emulator.server import run

    asyncio.run(run(port, announce=print_out))
