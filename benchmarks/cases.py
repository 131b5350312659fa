"""Cases of the benchmark: each runs whole programs and returns its figures.

``wall_s``, ``cpu_s`` and ``peak_mb`` describe the measured process, ``calls`` is how many
calls it made or read; ``stall_s`` is by how much its event loop was late at worst and ``playing_s``
how long its trials took.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

from benchmarks.processes import PROGRAM, PYTHON, RUNNER, Run, Server, run
from benchmarks.recorder import multiply
from benchmarks.workload import CALLS, TRIALS
from merge_runner.results.store import query

Figures = dict[str, float]
# In this condition both vehicles collide early whatever the server answers: 8 calls a trial.
SHORT, SHORT_CALLS = ("--conditions", "R_-4_8"), 8
# Few trials, whose calls are all under way before the first of them is answered.
KILLED, KILLED_TRIALS = ("--reps", "2"), 22
KILLED_DELAY_MS, QUIET_S = 1_000, 0.15
FEW, MANY = 250, 2_000  # short trials
STUDIES, MOST_DRIVEN = (110, 3_300, 11_000), 1_100


@dataclass(frozen=True, slots=True)
class Bench:
    """Folder and server of the cases."""

    folder: Path
    server: Server

    def fresh(self, name: str) -> Path:
        """An empty folder."""
        folder = self.folder / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        return folder

    def sweep(
        self,
        folder: Path,
        *options: str,
        db: str = "sweep",
        delay_ms: int = 0,
        until: Callable[[], bool] | None = None,
    ) -> Run:
        """Our runner, off the server's CPUs where it needs the server."""
        return run(
            [
                *RUNNER,
                "sweep",
                "baseline",
                "--json",
                "--db",
                str(folder / f"{db}.duckdb"),
                "--cache",
                str(folder / "responses"),
                *options,
            ],
            environment={"EMULATOR_BASE_URL": self.server.url(delay_ms)},
            until=until,
            pinned="--replay" not in options,
        )

    def floor(
        self,
        folder: Path,
        *,
        trials: int = TRIALS,
        calls: int = CALLS,
        in_flight: int = 200,
        delay_ms: int = 0,
        pinned: bool = True,
    ) -> Run:
        """The bare client with as many calls."""
        return run(
            [
                PYTHON,
                "-m",
                "benchmarks.floor",
                "--url",
                self.server.url(delay_ms),
                "--cache",
                str(folder / "floor"),
                "--trials",
                str(trials),
                "--calls-per-trial",
                str(calls),
                "--in-flight",
                str(in_flight),
            ],
            pinned=pinned,
        )


@dataclass(frozen=True, slots=True)
class Case:
    """A case, and how often it is run; one that takes long only where it is named."""

    name: str
    rounds: int
    measure: Callable[[Bench], Figures]
    is_long: bool = False

    def chosen(self, only: str, skip: str) -> bool:
        """Return whether these patterns of names choose it."""
        fits = self.name == only or (not self.is_long and fnmatch(self.name, only))
        return fits and not fnmatch(self.name, skip)


def figures_of(ran: Run, *, calls: int | None = None) -> Figures:
    """The figures of a run; a sweep has them in its summary."""
    figures = {"wall_s": ran.wall_s, "cpu_s": ran.cpu_s, "peak_mb": ran.peak_mb}
    if calls is not None:
        return {**figures, "calls": calls}
    summary = ran.summary
    return {
        **figures,
        "calls": summary["calls"]["live"] + summary["calls"]["cached"],
        "trials": summary["trials"]["planned"],
        "stall_s": summary["worst_stall_s"],
        "playing_s": summary["playing_s"],
    }


def cold(delay_ms: int) -> Callable[[Bench], Figures]:
    """A sweep with an empty cache."""
    return lambda bench: figures_of(bench.sweep(bench.fresh("cold"), delay_ms=delay_ms))


def cold_floor(delay_ms: int) -> Callable[[Bench], Figures]:
    """The same calls, bare."""
    return lambda bench: figures_of(
        bench.floor(bench.fresh("floor"), delay_ms=delay_ms), calls=TRIALS * CALLS
    )


def cached_floor(bench: Bench) -> Figures:
    """The calls of the last ``cold_floor`` again."""
    return figures_of(bench.floor(bench.folder / "floor", pinned=False), calls=TRIALS * CALLS)


def replay(bench: Bench) -> Figures:
    """The sweep of the last ``cold`` again, into a fresh database."""
    fresh = f"replay-{time.monotonic_ns()}"
    return figures_of(bench.sweep(bench.folder / "cold", "--replay", db=fresh))


def committed_recording(bench: Bench) -> Figures:
    """The recording that comes with the program, as ``make replay`` does it."""
    recording = "cache/recordings/emulator-baseline.parquet"
    return figures_of(bench.sweep(bench.fresh("file"), "--replay", "--recording", recording))


def paid(bench: Bench) -> Figures:
    """A model that costs money: its spending is durable before each attempt."""
    folder = bench.fresh("paid")
    return figures_of(
        run(
            [
                *RUNNER,
                "sweep",
                "baseline",
                "--json",
                "--model",
                "o3",
                "--yes",
                "--rpm",
                "10000000",
                "--tpm",
                "100000000000",
                "--db",
                str(folder / "sweep.duckdb"),
                "--cache",
                str(folder / "responses"),
            ],
            environment={"OPENAI_BASE_URL": bench.server.url(), "OPENAI_API_KEY": "benchmark-key"},
            pinned=True,
        )
    )


def in_flight(trials: int, limit: int, delay_ms: int = 0) -> Callable[[Bench], Figures]:
    """Short trials, many at once, while somebody reads the database."""

    def measure(bench: Bench) -> Figures:
        folder = bench.fresh("many")
        options = (*SHORT, "--reps", str(trials), "--in-flight", str(limit))
        with reader(folder / "sweep.duckdb") as waits:
            ran = bench.sweep(folder, *options, delay_ms=delay_ms)
        return {**figures_of(ran), "reader_wait_s": max(waits)}

    return measure


def short(trials: int) -> Callable[[Bench], Figures]:
    """Short trials with an empty cache."""
    return lambda bench: figures_of(
        bench.sweep(bench.fresh("short"), *SHORT, "--reps", str(trials), "--in-flight", "200")
    )


def short_floor(trials: int) -> Callable[[Bench], Figures]:
    """As many short trials, bare."""
    return in_flight_floor(trials, 200, 0)


def further(measure: Callable[[int], Callable[[Bench], Figures]]) -> Callable[[Bench], Figures]:
    """Return the figures of many short trials minus those of few."""

    def difference(bench: Bench) -> Figures:
        few, many = (measure(trials)(bench) for trials in (FEW, MANY))
        return {figure: many[figure] - few[figure] for figure in ("wall_s", "cpu_s", "calls")}

    return difference


def in_flight_floor(trials: int, limit: int, delay_ms: int) -> Callable[[Bench], Figures]:
    """As many short trials, bare."""
    return lambda bench: figures_of(
        bench.floor(
            bench.fresh("many-floor"),
            trials=trials,
            calls=SHORT_CALLS,
            in_flight=limit,
            delay_ms=delay_ms,
        ),
        calls=trials * SHORT_CALLS,
    )


@contextmanager
def reader(db: Path) -> Iterator[list[float]]:
    """Reads a database ten times a second; how long each reading took, in s."""
    waits = [0.0]
    done = threading.Event()

    def read() -> None:
        while not done.wait(0.1):
            if db.exists():
                began = time.perf_counter()
                query(db, "SELECT status, count(*) FROM trials GROUP BY ALL")
                waits.append(time.perf_counter() - began)

    thread = threading.Thread(target=read)
    thread.start()
    try:
        yield waits
    finally:
        done.set()
        thread.join()


def record_many(trials: int) -> Callable[[Bench], Figures]:
    """Not measured: make the recorded replies of this many short trials."""

    def measure(bench: Bench) -> Figures:
        folder = bench.fresh(f"recorded-{trials}")
        bench.sweep(folder, *SHORT, "--reps", "1", db="one")
        multiply(folder / "responses", trials)
        return {}

    return measure


def replay_many(trials: int) -> Callable[[Bench], Figures]:
    """Replay them into a fresh database."""
    return lambda bench: figures_of(
        bench.sweep(
            bench.folder / f"recorded-{trials}",
            *SHORT,
            *("--replay", "--reps", str(trials)),
            db=f"replay-{time.monotonic_ns()}",
        )
    )


def on_a_cache(trials: int, recorded: int, *, replayed: bool) -> Callable[[Bench], Figures]:
    """The first of the recorded trials, replayed or in a sweep that finds all replies."""
    return lambda bench: figures_of(
        bench.sweep(
            bench.folder / f"recorded-{recorded}",
            *SHORT,
            *("--reps", str(trials)),
            *(["--replay"] * replayed),
            db=f"start-{time.monotonic_ns()}",
        )
    )


def resume(bench: Bench) -> Figures:
    """A sweep that is killed without a word at half, and run again."""
    folder = bench.fresh("killed")
    bench.server.reset()
    until = half_is_answered(bench.server, KILLED_TRIALS)
    bench.sweep(folder, *KILLED, delay_ms=KILLED_DELAY_MS, until=until)
    return asked_again(bench.server, lambda: bench.sweep(folder, *KILLED, delay_ms=KILLED_DELAY_MS))


def asked_again(server: Server, go_on: Callable[[], Run], calls: int | None = None) -> Figures:
    """Count the answered calls that a run repeats after a kill."""
    before = server.stats()["answered"]
    ran = go_on()
    stats = server.stats()
    if stats["answered"] == before:
        raise RuntimeError("it was killed when everything was answered")
    counts = {"answered_before": before, "asked_again": stats["asked_again"]}
    return {**figures_of(ran, calls=calls), "answered_after": stats["answered"] - before, **counts}


def half_is_answered(server: Server, trials: int) -> Callable[[], bool]:
    """Says when half of the workload is answered and all calls in flight wait for the server.

    An answer that is on its way when its reader dies is lost to whatever reader.
    """
    seen, since = 0, time.perf_counter()

    def quiet_at_half() -> bool:
        nonlocal seen, since
        answered, now = server.stats()["answered"], time.perf_counter()
        if answered != seen:
            seen, since = answered, now
        return bool(answered >= trials * CALLS // 2 and now - since > QUIET_S)

    return quiet_at_half


def limited(bench: Bench) -> Figures:
    """A sweep of 6,000 requests a minute: what the server saw of it."""
    bench.server.reset()
    ran = bench.sweep(bench.fresh("limited"), *SHORT, "--reps", "110", "--rpm", "6000")
    arrivals = bench.server.stats()["arrivals"]
    span_s = arrivals[-1] - arrivals[0]
    return {**figures_of(ran), "achieved_per_s": (len(arrivals) - 1) / span_s, "limit_per_s": 100}


def start(*argv: str) -> Callable[[Bench], Figures]:
    """Measure the time until the program prints something."""

    def measure(bench: Bench) -> Figures:
        folder = bench.fresh("start")
        places = ["--db", str(folder / "none.duckdb"), "--cache", str(folder / "none")]
        ran = run([*PROGRAM, *argv, *(places if "--dry-run" in argv else [])])
        return figures_of(ran, calls=0)

    return measure


def parts(bench: Bench) -> Figures:
    """The limiter and the store by themselves; see parts.py."""
    ran = run([PYTHON, "-m", "benchmarks.parts", str(bench.fresh("parts"))])
    return {**ran.summary, "peak_mb": ran.peak_mb}


def import_humans(bench: Bench) -> Figures:
    """990 recorded human trials, each in a file of its own, as in the experiment's archive."""
    archive = bench.folder / "humans.zip"
    if not archive.exists():
        run([PYTHON, "-m", "benchmarks.humans", str(archive)])
    db = bench.fresh("imported") / "humans.duckdb"
    return figures_of(run([*PROGRAM, "human", "import", str(archive), "--db", str(db)]), calls=0)


def make_study(bench: Bench, trials: int) -> Path:
    """A study of that size; a large one is a smaller one many times over."""
    driven = bench.folder / f"driven-{min(trials, MOST_DRIVEN)}.duckdb"
    studies = [PYTHON, "-m", "benchmarks.studies"]
    if not driven.exists():
        run([*studies, str(driven), "--trials", str(min(trials, MOST_DRIVEN))])
    made = bench.folder / "made.duckdb"
    shutil.copy(driven, made)
    run([*studies, str(made), "--copies", str(max(1, trials // MOST_DRIVEN))])
    return made


def study_of(bench: Bench, trials: int, *, anew: bool = False) -> Path:
    """The study of that size that all cases share; it is made where there is none, or ``anew``."""
    db = bench.folder / f"study-{trials}.duckdb"
    if anew or not db.exists():
        make_study(bench, trials).replace(db)
    return db


def imports(modules: str) -> Callable[[Bench], Figures]:
    """The interpreter and libraries that a program cannot do without."""
    return lambda _: figures_of(run([PYTHON, "-c", f"import {modules}"]), calls=0)


def analysis(trials: int, what: str, *, warm: bool) -> Callable[[Bench], Figures]:
    """Tables or a report of a study; cold: nothing of it is stored, of a report but the tables."""

    def measure(bench: Bench) -> Figures:
        db = study_of(bench, trials, anew=not warm and what == "tables")
        out = ["--out", str(bench.fresh("report") / "report.html")] if what == "report" else []
        return figures_of(run([*PROGRAM, what, "--db", str(db), *out]), calls=0)

    return measure
