"""What the pages show of the analysis, computed in a process of its own and remembered.

pandas and the fits hold a Python process for seconds, and no page may wait for another's numbers.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
import time
import tomllib
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import duckdb

from merge_runner.audit.checks import audited_database, check_sweep
from merge_runner.errors import MergeRunnerError, UsageError
from merge_runner.registry import in_use, use
from merge_runner.results.database import read_database
from merge_runner.results.store import results_digest
from merge_runner.study.file import StudyFile
from merge_runner.study.parts import catalogue_of
from merge_runner.text_safety import first_line
from merge_runner_analysis.cache import (
    finished,
    keep_finished,
    options_text,
    present_state,
)
from merge_runner_analysis.tables import make_tables
from merge_runner_analysis.tables.model import from_text, to_text
from merge_runner_analysis.web.reading import stamp_of

if TYPE_CHECKING:
    from merge_runner_analysis.study import Study

REMEMBERED = 100
# While a run goes on the database changes all the time: an answer stands for some seconds.
STANDS_S = 20.0
BROKEN = (
    "the computation ended without an answer; what it said stands where `merge-runner view` was "
    "started"
)
FOUND = 3  # findings of a run that its page shows
Request = tuple[str, ...]
"""``table NAME [SWEEP CONDITION]``, ``cell TABLE ROW COLUMN``, ``figure NAME FORM``,
``audit``."""

RUNS = """
SELECT sweep_id, coalesce(exit_code = 0, false) FROM sweeps
ORDER BY started_at DESC, sweep_id DESC
"""


class Numbers:
    """Answers from one state of a database, whose trials are read once something needs them."""

    def __init__(self, db: Path) -> None:
        self.db = db

    def answer(self, request: Request) -> dict[str, Any]:
        """What is asked for, with ``counted``: how many trials the database holds.

        ``absent`` says that no table has a cell. Raises MergeRunnerError.
        """
        match request:
            case ["table", name, *part]:
                found: dict[str, Any] = {"table": self._table(name, *part)}
            case ["cell", table, row, column]:
                found = self._cell(table, row, column)
            case ["figure", name, "svg" | "png" as form]:
                from merge_runner_analysis.figures.gallery import rendered

                digest, _ = results_digest(self.db)
                found = {"file": rendered(self.study, name, form), "digest": digest}
            case ["audit"]:
                found = {"notes": json.loads(self._kept("audit", self._audit))}
            case _:
                raise UsageError(f"nothing answers {request!r}")
        with read_database(self.db) as connection:
            counted = connection.execute("SELECT count(*) FROM trials WHERE source <> 'seat'")
            return {"counted": counted.fetchall()[0][0], **found}

    @cached_property
    def study(self) -> Study:
        """The study, once it is read."""
        from merge_runner_analysis.study import Study

        return Study(self.db)

    @cached_property
    def _state(self) -> str:
        return present_state(self.db)

    def _kept(self, name: str, make: Callable[[], str], options: str = "") -> str:
        """What is kept of the present state under a name, or else is made, and kept."""
        options = options or options_text(self.db)
        kept = finished(self.db, self._state, options, [name])
        if not kept:
            kept = {name: make()}
            keep_finished(self.db, self._state, options, kept)
        return kept[name]

    def _table(self, name: str, sweep: str = "", condition: str = "") -> str:
        """A table of all trials, or of those of a sweep and a condition; kept for the next time."""

        def make() -> str:
            from merge_runner_analysis.study import Study

            is_part = sweep or condition
            study = Study(self.db, sweep=sweep, condition=condition) if is_part else self.study
            return to_text(make_tables(study, [name])[0])

        return self._kept(name, make, options_text(self.db, sweep=sweep, condition=condition))

    def _audit(self) -> str:
        """What the audit of each run found and notes, by the run's id; nothing is replayed."""
        told = {}
        with audited_database(self.db) as connection:
            for run, ended in connection.execute(RUNS).fetchall():
                audit = check_sweep(connection, run, (), finished=ended)
                told[run] = [f"found: {one}" for one in audit.findings[:FOUND]] + audit.notes
        return json.dumps(told)

    def _cell(self, name: str, row: str, column: str) -> dict[str, Any]:
        from merge_runner_analysis.explain import explain

        table, study = from_text(self._table(name)), self.study
        try:
            found = explain(study, table, f"{row}:{column}")
        except UsageError as exc:
            return {"absent": str(exc)}
        counts = any(one.counts for one in table.columns if one.name == column)
        specs = {
            group.id: dict(zip(trials["trial_id"], trials["spec_hash"], strict=True))
            for group in (*study.measured, *study.asked, *study.unjudged, *study.unjudged_asked)
            for trials in [group.stored.trials]
        }
        trials = [
            (trial, specs[source.group][trial])
            for source in found.sources
            for trial in (source.numerator if counts else source.trials)
        ]
        return {"explained": found, "trials": trials}


@lru_cache(1)
def numbers(db: Path, _: tuple[int, ...]) -> Numbers:
    """The numbers of a database with a stamp: what was read is read once."""
    return Numbers(db)


def answer(db: Path, request: Request) -> dict[str, Any]:
    """The answer of the database as it is now; raises MergeRunnerError."""
    try:
        return numbers(db, stamp_of(db)).answer(request)
    except duckdb.Error as exc:  # as where the file is replaced while it is read
        raise UsageError(f"{db} cannot be read: {first_line(exc)}") from exc


def _begin(text: str, plugins: Mapping[str, str]) -> None:
    """Use the study of the explorer, whatever stands in its files by now."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the explorer, which then ends it
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if text:
        use(catalogue_of(StudyFile.model_validate(tomllib.loads(text)), text, plugins))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(0)


def processes(number: int) -> ProcessPoolExecutor:
    """So many processes, with the same study's plug-ins as this one."""
    return ProcessPoolExecutor(
        max_workers=number,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_begin,
        initargs=(in_use().text, dict(in_use().plugins)),
    )


class Worker:
    """A process that computes."""

    def __init__(self, db: Path) -> None:
        self._db = db
        self._pool = processes(1)
        self._pid = self._pool.submit(os.getpid)

    def submit(self, request: Request) -> Future[dict[str, Any]]:
        """Compute an answer after what was asked before."""
        return self._pool.submit(answer, self._db, request)

    def close(self) -> None:
        """End it, whatever is under way, and the thread that serves it."""
        with suppress(BrokenProcessPool, ProcessLookupError):
            os.kill(self._pid.result(), signal.SIGKILL)
        # A thread that still ended while the program exits could make it fail.
        self._pool.shutdown(cancel_futures=True)


@dataclass(frozen=True, slots=True)
class Job:
    """A computation, of a state of the database (its stamp), begun at a time (s since 1970).

    ``before`` is that of an earlier state, whose answer stands until this one is there. It has an
    answer, or a ``failure``, or goes on; the database has changed since where it is ``older``.
    """

    answer: Future[dict[str, Any]]
    state: tuple[int, ...]
    begun: float
    before: Job | None = None
    failure: str = ""
    older: bool = False

    @property
    def at(self) -> str:
        """When it was begun, in local time with its zone."""
        return f"{datetime.fromtimestamp(self.begun).astimezone():%Y-%m-%d %H:%M:%S %Z}"

    @property
    def elapsed_s(self) -> float:
        """How long it takes so far."""
        return time.time() - self.begun

    @property
    def content(self) -> dict[str, Any] | None:
        """The answer; None while it is not there, and where there will be none."""
        is_there = self.answer.done() and self.answer.exception() is None
        return self.answer.result() if is_there else None


class Computing:
    """Answers by request. One computation goes on at a time, the others wait for it."""

    def __init__(self, db: Path, start: Callable[[Path], Worker] = Worker) -> None:
        self.db = db
        self._start = start
        self._lock = threading.Lock()
        self._jobs: dict[Request, Job] = {}
        self._worker: Worker | None = None

    def ask(self, request: Request, state: tuple[int, ...], wait_s: float = 0.0) -> Job:
        """A computation, waiting at most ``wait_s`` for its answer.

        ``state`` is the present one. An answer of an earlier state is given while a newer one is
        computed, but what was absent then may be there now.
        """
        with self._lock:
            job = self._jobs.pop(request, None)
            content = job.content if job else None
            is_absent = content is not None and "absent" in content
            if job is None or (
                content is not None
                and job.state != state
                and (is_absent or job.elapsed_s > STANDS_S)
            ):
                before = None if job is None or is_absent else replace(job, before=None)
                job = Job(self._submit(request), state, time.time(), before)
            self._jobs[request] = job
            if len(self._jobs) > REMEMBERED:
                del self._jobs[next(iter(self._jobs))]
        wait([job.answer], timeout=wait_s)
        if not job.answer.done():
            job = job.before or job
        elif failure := job.answer.exception():
            with self._lock:  # no failure stays
                if self._jobs.get(request) is job:
                    del self._jobs[request]
            if isinstance(failure, BrokenProcessPool):
                return replace(job, failure=BROKEN)
            if not isinstance(failure, MergeRunnerError):
                raise failure
            return replace(job, failure=str(failure))
        return replace(job, older=job.state != state)

    def _submit(self, request: Request) -> Future[dict[str, Any]]:
        if self._worker is not None:
            with suppress(BrokenProcessPool):  # another process takes its place
                return self._worker.submit(request)
        self._worker = self._start(self.db)
        return self._worker.submit(request)

    def close(self) -> None:
        """Stop computing."""
        if self._worker is not None:
            self._worker.close()
