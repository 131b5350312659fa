"""The command line. Results go to stdout, progress and messages to stderr."""

from __future__ import annotations

import errno
import gc
import json
import math
import shlex
import shutil
import sys
import tempfile
from collections.abc import Sequence
from datetime import UTC, datetime
from enum import StrEnum
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from merge_runner import __version__
from merge_runner.errors import MergeRunnerError, UsageError
from merge_runner.paths import DEFAULT_CACHE, DEFAULT_DB
from merge_runner.text_safety import printable

if TYPE_CHECKING:
    from merge_runner.emulator.faults import FaultPlan
    from merge_runner.run.estimate import Estimate
    from merge_runner.run.plan import Options, Plan
    from merge_runner.run.sweep import Sweep


app = typer.Typer(
    name="merge-runner",
    help="Finds out whether a language model drives like a human.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
recording_app = typer.Typer(
    help="Portable recordings: one Parquet file that anyone can replay.", no_args_is_help=True
)
app.add_typer(recording_app, name="recording")


class Format(StrEnum):
    """Output formats of a table."""

    TEXT = "text"
    CSV = "csv"
    JSON = "json"


DbOption = Annotated[Path, typer.Option("--db", help="The results database.")]
CacheOption = Annotated[Path, typer.Option("--cache", help="The folder of recorded replies.")]
ModelOption = Annotated[
    list[str] | None,
    typer.Option(
        "--model",
        metavar="NAME",
        help="A model of the registry, a program, or LEFT+RIGHT; may be given more than once. "
        "Else those of the study's file, or the emulator.",
    ),
]
OnlyOption = Annotated[
    list[str] | None,
    typer.Option(
        "--only",
        metavar="FACTOR=LEVEL",
        help="A part of the study: a level of a factor, or of model or prompt; may be given more "
        "than once.",
    ),
]
RepsOption = Annotated[
    int | None, typer.Option("--reps", help="Repetitions per condition, for every variant.")
]
ConditionsOption = Annotated[
    str | None, typer.Option("--conditions", help="Conditions, separated by commas.")
]
VariantsOption = Annotated[
    str | None, typer.Option("--variants", help="Prompt variants, separated by commas.")
]
SampleSetOption = Annotated[
    int, typer.Option("--sample-set", help="Another number draws a fresh set of samples.")
]
InFlightOption = Annotated[
    int, typer.Option("--in-flight", help="Trials at once, over all workers.", min=1)
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the summary as one JSON object.")]
NameArgument = Annotated[
    str, typer.Argument(metavar="NAME", help="experiments/NAME.toml, or a path.")
]


def _adopt(file: str | None) -> str | None:
    if file is not None:
        from merge_runner.study.file import read_study
        from merge_runner.study.parts import adopt

        adopt(read_study(file))
    return file


StudyOption = Annotated[
    str | None,
    typer.Option(
        "--study",
        metavar="FILE",
        callback=_adopt,
        help="The study of the trials: its plug-ins run, and its prompts, conditions, drivers and "
        "metrics are known.",
    ),
]
RecordingFile = Annotated[Path, typer.Argument(metavar="FILE", help="A recording (.parquet).")]
ImportedFile = Annotated[
    Path, typer.Argument(metavar="FILE", help="A recording (.parquet), or a cache folder.")
]
RecordingOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--recording", help="Also replay from this file, without importing it; may be repeated."
    ),
]

# A full disk, a limit of file sizes, and a device that fails.
OUTPUT_ERRORS = (errno.ENOSPC, errno.EFBIG, errno.EIO)


def main() -> None:
    """Run the command line and exit with the contract's code."""
    # A trial's objects live until it ends, so frequent garbage collections would find almost none.
    gc.set_threshold(20_000, 10, 100)
    debug = "--debug" in sys.argv
    sys.argv = [argument for argument in sys.argv if argument != "--debug"]
    try:
        app()
    except MergeRunnerError as exc:
        if debug:
            raise
        say(f"error: {exc}")
        sys.exit(exc.exit_code)
    except ModuleNotFoundError as exc:
        if debug or str(exc.name).startswith(("merge_runner", "analysis")):
            raise
        say(f"error: this needs {exc.name}, which is not installed: pip install {exc.name}")
        sys.exit(UsageError.exit_code)
    except RuntimeError as exc:
        if debug or str(exc) != "Query interrupted":  # what DuckDB raises on Ctrl-C
            raise
        say("interrupted: run the same command again")
        sys.exit(130)
    except OSError as exc:
        if debug or exc.errno not in OUTPUT_ERRORS:
            raise
        say(f"error: the output cannot be written: {exc.strerror}")
        sys.exit(1)


def _print_version(wanted: bool) -> None:
    if wanted:
        print_out(f"merge-runner {__version__}")
        raise typer.Exit


@app.callback()
def common(
    debug: Annotated[
        bool, typer.Option("--debug", help="Show a traceback on errors.")
    ] = False,  # typer's way to declare a flag
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    """Finds out whether a language model drives like a human."""


@app.command()
def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A new folder, or an empty one.")],
) -> None:
    """Write a folder with a study that runs as it is, to be changed into your own."""
    from merge_runner.study.folder import write_folder

    for path in write_folder(folder):
        say(f"wrote {path}")
    print_out(f"go on: cd {shlex.quote(str(folder))} && merge-runner sweep study.toml")


@app.command()
def sweep(
    name: NameArgument,
    model: ModelOption = None,
    only: OnlyOption = None,
    reps: RepsOption = None,
    conditions: ConditionsOption = None,
    variants: VariantsOption = None,
    sample_set: SampleSetOption = 0,
    order_seed: Annotated[
        int, typer.Option("--order-seed", help="Another number draws another order.")
    ] = 0,
    db: DbOption = DEFAULT_DB,
    cache: CacheOption = DEFAULT_CACHE,
    in_flight: InFlightOption = 200,
    rpm: Annotated[int | None, typer.Option(help="Requests a minute.", min=1)] = None,
    tpm: Annotated[int | None, typer.Option(help="Tokens a minute.", min=1)] = None,
    max_cost: Annotated[
        float | None,
        typer.Option(help="Never spend more USD on this sweep, over all its runs.", min=0),
    ] = None,
    until: Annotated[
        str | None,
        typer.Option(
            metavar="TIME",
            help="Begin no trial from this local time on, such as 07:00; the next run goes on.",
        ),
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option(
            "--dask",
            metavar="CLUSTER",
            help="Play on a Dask cluster: local:N, a scheduler's address, or its file.",
        ),
    ] = None,
    strict_model: Annotated[
        bool, typer.Option("--strict-model", help="Stop when another model answers.")
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only estimate.")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before spending.")] = False,
    replay: Annotated[bool, typer.Option("--replay", help="From recorded replies alone.")] = False,
    recording: RecordingOption = None,
    fault_rate: Annotated[
        float, typer.Option(help="Emulator only: share of attempts with a transient fault.")
    ] = 0.0,
    faults: Annotated[Path | None, typer.Option(help="Emulator only: a file of faults.")] = None,
    seed: Annotated[int, typer.Option(help="Emulator only: seed of the faults.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Play all trials of a sweep that are not stored yet."""
    import asyncio

    from merge_runner.run.plan import Options, make_plan
    from merge_runner.run.unsent import unsent
    from merge_runner.run.until import deadline

    if max_cost is not None and not math.isfinite(max_cost):
        raise UsageError("--max-cost is a number of USD")
    if recording and not replay:
        raise UsageError("--recording goes with a replay; to keep its replies: recording import")
    if dask is not None and replay:
        raise UsageError("a replay needs no cluster: leave --dask out")
    options = Options(
        db=db,
        cache=cache,
        in_flight=in_flight,
        rpm=rpm,
        tpm=tpm,
        max_cost_usd=max_cost,
        replay=replay,
        recordings=recording or (),
        emulator_options=_emulator_options(fault_rate, faults, seed),
        faults_identity=_faults(fault_rate, faults, seed).identity,
        strict_model=strict_model,
        dask=dask,
        until=None if until is None else deadline(until, datetime.now(UTC)),
    )
    plan = make_plan(
        name,
        model or (),
        reps,
        listed(conditions),
        listed(variants),
        sample_set=sample_set,
        order_seed=order_seed,
        only=levels(only or (), "--only"),
        db=db,
    )
    if dask is not None and plan.replays_humans:
        raise UsageError("human-replay is played in this process: leave --dask out")
    for note in plan.notes():
        say(note)
    if not replay:
        options = plan.within_budget(options)
    else:
        from merge_runner.run.recorded_plan import replayed

        whole = any(part is not None for part in (reps, conditions, variants))
        plan, options, notes = replayed(plan, options, whole=whole)
        for note in notes:
            say(note)
    if dry_run:
        _print_estimate(asyncio.run(unsent(plan, options, say=say)), as_json=as_json)
    else:
        _run(plan, options, yes=yes, as_json=as_json)


@app.command()
def replay(
    name: NameArgument,
    model: ModelOption = None,
    only: OnlyOption = None,
    reps: RepsOption = None,
    conditions: ConditionsOption = None,
    variants: VariantsOption = None,
    sample_set: SampleSetOption = 0,
    db: DbOption = DEFAULT_DB,
    cache: CacheOption = DEFAULT_CACHE,
    in_flight: InFlightOption = 200,
    recording: RecordingOption = None,
    as_json: JsonOption = False,
) -> None:
    """Play a sweep from recorded replies alone: no key, no network."""
    sweep(
        name=name,
        model=model,
        only=only,
        reps=reps,
        conditions=conditions,
        variants=variants,
        sample_set=sample_set,
        db=db,
        cache=cache,
        in_flight=in_flight,
        replay=True,
        recording=recording,
        as_json=as_json,
    )


@app.command()
def sql(
    query: Annotated[str, typer.Argument(metavar="QUERY", help="One SQL query.")],
    db: DbOption = DEFAULT_DB,
    output: Annotated[Format, typer.Option("--format", help="Form of the result.")] = Format.TEXT,
) -> None:
    """Query the results; also while a sweep runs. Nothing can be changed."""
    from merge_runner.results.query_output import write_csv, write_json, write_table
    from merge_runner.results.store import answers

    writers = {Format.TEXT: write_table, Format.CSV: write_csv, Format.JSON: write_json}
    # A slow reader of a pipe would otherwise keep every sweep from writing meanwhile.
    with tempfile.TemporaryFile("w+", encoding="utf-8", newline="") as spooled:
        with answers(db, query) as (names, rows):
            writers[output](names, rows, spooled)
        spooled.seek(0)
        shutil.copyfileobj(spooled, sys.stdout)


@app.command()
def export(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="A new folder, or that of an earlier export.")
    ],
    db: DbOption = DEFAULT_DB,
) -> None:
    """Write every table and view as Parquet and CSV, with a dictionary of all columns."""
    from merge_runner.results.export import export_tables

    for path in export_tables(db, folder):
        say(f"wrote {path}")


@app.command()
def digest(db: DbOption = DEFAULT_DB) -> None:
    """Print one line: a hash of all results, equal for equal results."""
    from merge_runner.results.store import results_digest

    value, trials = results_digest(db)
    print_out(f"{value}  {trials} trials")


@app.command()
def audit(
    db: DbOption = DEFAULT_DB,
    sweep_id: Annotated[
        str | None, typer.Option("--sweep", help="A sweep_id; everything if not given.")
    ] = None,
    recording: Annotated[
        Path | None, typer.Option("--recording", help="Check this recording instead of a database.")
    ] = None,
    cache: Annotated[
        Path | None,
        typer.Option("--cache", help="Also compare every attempt with this cache folder."),
    ] = None,
    study: StudyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Check that each sample is there, once, and that all else follows from the replies."""
    from merge_runner.audit import (
        NOT_DERIVED,
        audit_cache,
        audit_database,
        audit_recording,
        audit_sweep,
    )

    skipped: list[str] = []
    if recording is not None:
        if sweep_id is not None or cache is not None:
            raise UsageError("--recording is checked by itself: without --sweep and --cache")
        audits = [audit_recording(recording)]
    else:
        audits = audit_database(db) if sweep_id is None else [audit_sweep(db, sweep_id)]
        skipped = list(NOT_DERIVED)
        if cache is not None:
            audits.append(audit_cache(db, cache, sweep_id))
            skipped = [name for name in skipped if name == "calls.cached" or "calls" not in name]
    ok = all(found.ok for found in audits)
    if as_json:
        whole = {"ok": ok, "not_derived": skipped, "audits": [found.as_dict() for found in audits]}
        print_out(json.dumps(whole, ensure_ascii=False))
    else:
        for line in chain.from_iterable(found.lines() for found in audits):
            print_out(line)
        if skipped:
            print_out(f"not checked, since neither replies nor specs tell it: {', '.join(skipped)}")
    sys.exit(0 if ok else 1)


@app.command()
def ledger(
    cache: CacheOption = DEFAULT_CACHE,
    release: Annotated[
        str | None,
        typer.Option("--release", metavar="SWEEP", help="Stop counting what is set aside."),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before releasing.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Show what each sweep has spent, and what is set aside and why; or release that."""
    from merge_runner.run import spending

    if release is None:
        found = spending.accounts(cache)
    else:
        aside = spending.account(cache, release).spending
        _agree(
            f"{aside.reserved_usd:.4f} USD are set aside for {aside.open_attempts} attempts at "
            f"{release}. If the provider did charge for them, --max-cost may be passed by as much",
            "Release it?",
            otherwise="nothing was released",
            yes=yes,
        )
        found = [spending.release(cache, release)]
    if as_json:
        print_out(json.dumps([each.as_dict() for each in found], ensure_ascii=False))
        return
    for line in chain.from_iterable(each.lines() for each in found):
        print_out(line)
    if not found:
        print_out("No sweep has spent anything.")


@app.command()
def forget(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME ...]", help="Sweeps or trials; * stands for anything."),
    ] = None,
    sweeps: Annotated[
        list[str] | None, typer.Option("--sweep", metavar="ID", help="A sweep_id.")
    ] = None,
    trials: Annotated[
        list[str] | None, typer.Option("--trial", metavar="ID", help="A trial_id.")
    ] = None,
    db: DbOption = DEFAULT_DB,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before removing.")] = False,
) -> None:
    """Remove sweeps and trials from the database; their replies stay in the cache."""
    from merge_runner.results import forgetting

    # A trial's id has a slash, a sweep's has none.
    of_trials = [*(trials or ()), *(name for name in names or () if "/" in name)]
    of_sweeps = [*(sweeps or ()), *(name for name in names or () if "/" not in name)]
    if not of_trials and not of_sweeps:
        raise UsageError("name a sweep or a trial; `merge-runner sql 'from sweeps'` lists sweeps")
    going = forgetting.to_forget(db, of_sweeps, of_trials)
    _agree(
        f"these go from {db}: {going}",
        "Remove them?",
        otherwise="nothing was removed",
        yes=yes,
    )
    gone = forgetting.forget(db, of_sweeps, of_trials, going)
    say(
        f"removed: {gone}. Their replies stay in the cache: the same `merge-runner sweep` plays "
        "the trials again without a call"
    )


def _agree(what: str, question: str, *, otherwise: str, yes: bool) -> None:
    """Say what is about to be done, and ask once; ``otherwise`` says that it was not done."""
    say(what)
    if yes:
        return
    if not sys.stdin.isatty():
        raise UsageError(f"there is no terminal to ask at, so {otherwise}: add --yes")
    if not typer.confirm(question, err=True):
        raise UsageError(otherwise)


@app.command()
def models() -> None:
    """List who can drive: the models with provider, id, key and price, and the programs."""
    from merge_runner.config import Price, key_status
    from merge_runner.drivers.registry import PROGRAMS
    from merge_runner.llm.models import load_models
    from merge_runner.llm.prices import cost_usd
    from merge_runner.records import Usage
    from merge_runner.results.query_output import write_table

    million = 1_000_000
    rows = []
    for name, entry in load_models().items():
        costs = [
            cost_usd(entry, Usage(input_tokens=i, output_tokens=o))
            for i, o in ((1000, 0), (0, 1000))
        ]
        shown = ["unknown" if c is None else f"{c * million / 1000:g}" for c in costs]
        source = entry.price.source if isinstance(entry.price, Price) else entry.price
        rows.append(
            (
                name,
                entry.provider,
                entry.id,
                key_status(name, entry),
                *shown,
                source,
                str(entry.shutdown or ""),
                entry.note,
            )
        )
    for name, program in PROGRAMS.items():
        rows.append((name, "program", "", "not needed", "0", "0", "", "", program.described))
    headings = ["name", "provider", "id", "key", "USD/M in", "USD/M out", "prices", "shutdown"]
    write_table([*headings, "note"], rows, sys.stdout)


@app.command()
def emulate(
    port: Annotated[int, typer.Option(help="0: any free port.", min=0, max=65535)] = 8765,
    fault_rate: Annotated[float, typer.Option(help="Share of attempts with a fault.")] = 0.0,
    faults: Annotated[Path | None, typer.Option(help="A TOML file of faults.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of the faults.")] = 0,
    until_stdin_closes: Annotated[bool, typer.Option(hidden=True)] = False,
) -> None:
    """Run the local stand-in for a language model on 127.0.0.1; prints its base URL."""
    import asyncio

    from merge_runner.emulator.server import run

    asyncio.run(
        run(
            port,
            _faults(fault_rate, faults, seed),
            announce=print_out,
            until_stdin_closes=until_stdin_closes,
        )
    )


@recording_app.command("export")
def recording_export(
    file: RecordingFile,
    db: DbOption = DEFAULT_DB,
    cache: CacheOption = DEFAULT_CACHE,
    sweeps: Annotated[
        list[str] | None,
        typer.Option(
            "--sweep", help="A sweep_id, which may be repeated; the newest sweep if none is given."
        ),
    ] = None,
    sign: Annotated[
        Path | None,
        typer.Option("--sign", metavar="KEY", help="Sign it with ssh-keygen or minisign."),
    ] = None,
) -> None:
    """Write what sweeps asked and were answered into one file."""
    from merge_runner.llm.cache import ResponseCache
    from merge_runner.results import signing
    from merge_runner.results.recording import export_recording, provenance_of
    from merge_runner.results.store import recorded_sweeps

    if sign is not None:
        signing.tool_for(sign)
    rows, keys = recorded_sweeps(db, sweeps or ())
    found = " and ".join(row["sweep_id"] for row in rows)
    if not keys:
        raise UsageError(f"the sweep {found} made no call: there is nothing to record")
    calls = export_recording(file, ResponseCache(cache, read_only=True), keys, provenance_of(rows))
    say(f"{calls} calls of {found} are in {file}")
    if sign is not None:
        say(f"signed: {signing.sign(file, sign)}")


@recording_app.command("import")
def recording_import(file: ImportedFile, cache: CacheOption = DEFAULT_CACHE) -> None:
    """Verify a recording, or the cache folder of somebody else, and add it to the cache."""
    from merge_runner.llm.cache import ResponseCache
    from merge_runner.llm.cache_import import import_folder
    from merge_runner.results.recording import import_recording

    take = import_folder if file.is_dir() else import_recording
    added, there = take(file, ResponseCache(cache))
    say(f"{added} calls added to {cache}, {there} were there already")


@recording_app.command("verify")
def recording_verify(
    file: RecordingFile,
    signers: Annotated[
        Path | None,
        typer.Option(help="Whose signature it must have: allowed signers, or a minisign key."),
    ] = None,
) -> None:
    """Check that a file is as it was exported, and by whom."""
    from merge_runner.results import signing
    from merge_runner.results.recording import summarise

    found = summarise(file)
    say(f"{file} is whole: {found.calls} calls, as they were exported")
    for note in found.notes:
        say(f"note: {note}")
    if signers is not None:
        say(signing.verified(file, signers))


@recording_app.command("info")
def recording_info(file: RecordingFile) -> None:
    """Verify a recording and print what it holds, as JSON."""
    from dataclasses import asdict

    from merge_runner.results.recording import summarise

    print_out(json.dumps(asdict(summarise(file)), indent=2, ensure_ascii=False))


def _run(plan: Plan, options: Options, *, yes: bool, as_json: bool) -> None:
    import asyncio

    from merge_runner.run import summary
    from merge_runner.run.sweep import INTERRUPTED, Sweep

    prepared = Sweep(plan, options, say=say)
    expected = None
    if not options.replay and prepared.trials_to_play:
        expected = _confirm(plan, prepared, yes=yes)
    try:
        outcome = asyncio.run(prepared.run())
    except KeyboardInterrupt:  # before the trials began or after they ended
        say("interrupted: run the same command again to go on")
        sys.exit(INTERRUPTED)
    if as_json:
        whole = summary.as_dict(outcome, options, expected)
        print_out(json.dumps(whole, ensure_ascii=False))
    else:
        for line in summary.as_lines(outcome, options, expected):
            print_out(line)
    for message in outcome.messages:
        say(f"error: {message}")
    sys.exit(outcome.exit_code)


def _confirm(plan: Plan, prepared: Sweep, *, yes: bool) -> Estimate | None:
    """Check the keys, say what a live run of a paid model will cost, and ask once."""
    import asyncio

    from merge_runner.config import resolve_endpoint

    for name, entry in plan.entries.items():
        resolve_endpoint(name, entry)
        if entry.shutdown:
            say(f"note: {name} ({entry.id}) is announced to shut down on {entry.shutdown}")
    if all(entry.price == "free" for entry in plan.entries.values()):
        return None
    expected = asyncio.run(prepared.estimate())
    cost = "an unknown price" if expected.cost_usd is None else f"about {expected.cost_usd} USD"
    say(
        f"{expected.driver}: {expected.trials} trials, about {expected.calls} calls that are not "
        f"recorded yet, {cost}, {expected.minutes} minutes or more"
    )
    if yes:
        return expected
    if not sys.stdin.isatty():
        raise UsageError(
            "this run spends money and there is no terminal to ask at: add --yes to go ahead, or "
            "--dry-run to only see the estimate"
        )
    if not typer.confirm("Go ahead?", err=True):
        raise UsageError("nothing was sent")
    return expected


def _print_estimate(expected: Estimate, *, as_json: bool) -> None:
    from dataclasses import asdict, astuple

    from merge_runner.results.query_output import write_table

    if as_json:
        print_out(json.dumps(asdict(expected)))
        return
    cost = "unknown" if expected.cost_usd is None else f"{expected.cost_usd:.2f} USD"
    for name, text in (
        ("driver", expected.driver),
        ("trials", f"{expected.trials} that have not ended yet"),
        ("calls", f"about {expected.calls} that are not recorded yet"),
        (
            "tokens",
            f"about {expected.input_tokens} in, {expected.output_tokens} out"
            + (", as measured before" if expected.measured else ""),
        ),
        ("cost", f"about {cost}"),
        ("time", f"about {expected.minutes} minutes"),
    ):
        print_out(f"{name:<8}{text}")
    if expected.trials_within_cap is not None:
        print_out(f"cap     buys about {expected.trials_within_cap} trials")
    if len(expected.cells) > 1:
        headings = ["cell", "trials", "calls", "tokens in", "tokens out", "USD", "minutes"]
        write_table(
            [*headings, "trials within the cap"],
            [tuple("" if v is None else v for v in astuple(c)) for c in expected.cells],
            sys.stdout,
        )
    print_out("Nothing was sent.")


def _faults(fault_rate: float, faults: Path | None, seed: int) -> FaultPlan:
    """What goes wrong on purpose at the emulator; raises UsageError."""
    from merge_runner.emulator.faults import load_faults, transient_faults

    if faults is None:
        return transient_faults(fault_rate, seed)
    if fault_rate or seed:
        raise UsageError("--faults names a file that holds the rates and the seed: give it alone")
    return load_faults(faults)


def _emulator_options(fault_rate: float, faults: Path | None, seed: int) -> list[str]:
    if faults is not None:
        return ["--faults", str(faults.resolve())]
    return ["--fault-rate", str(fault_rate), "--seed", str(seed)]


def levels(given: Sequence[str], option: str) -> dict[str, list[str]]:
    """The levels of each factor that an option names; raises UsageError."""
    found: dict[str, list[str]] = {}
    for each in given:
        factor, equals, level = each.partition("=")
        if not equals:
            raise UsageError(f"{option} {each}: write FACTOR=LEVEL, as in {option} temperature=0.2")
        found.setdefault(factor.strip(), []).append(level.strip())
    return found


def listed(text: str | None) -> list[str] | None:
    """The parts of an option that takes several names, None where it is not given."""
    return None if text is None else [part.strip() for part in text.split(",") if part.strip()]


def print_out(text: str) -> None:
    """Print a result."""
    print(printable(text), flush=True)  # noqa: T201 # the command line's output


def say(text: str) -> None:
    """Print a message beside the result."""
    print(printable(text), file=sys.stderr, flush=True)  # noqa: T201 # the command line's messages
