"""What a user sees while a sweep runs: a live table on a terminal, plain lines elsewhere."""

from __future__ import annotations

import asyncio
import errno
import os
import sys
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Literal

from merge_runner.llm.client import Wait
from merge_runner.llm.ledger import Ledger
from merge_runner.results.progress_file import MACHINE, ProgressFile, Standing, clear_dead
from merge_runner.run.plan import Plan
from merge_runner.text_safety import printable

if TYPE_CHECKING:
    from rich.table import Table

    from merge_runner.run.cluster import DaskTasks
    from merge_runner.run.local_runner import LocalRunner

LIVE_EVERY_S = 0.25
PLAIN_EVERY_S = 5.0
PULSE_S, PULSES = 0.05, 20  # between two writings of the file
NOTES_SHOWN = 10
REASONS_SHOWN = 3
CLOSE_IT = "you may close this: the same command goes on"


@dataclass(slots=True)
class Progress:
    """Where a sweep stands; ``runner`` plays its trials.

    ``planned`` is the number of all trials, ``stored`` of those that were stored before this run.
    ``outcome_counts`` counts how the trials of this run ended: with a Status, or ``suspended``
    until there is more money. ``worst_stall_s`` is the longest delay of the event loop.
    """

    plan: Plan
    planned: int
    runner: LocalRunner | DaskTasks
    ledger: Ledger
    stored: int = 0
    cap_usd: float | None = None
    outcome_counts: Counter[str] = field(default_factory=Counter)
    began_at: datetime = field(default_factory=lambda: datetime.now(UTC))
    worst_stall_s: float = 0.0
    doing: Literal["playing", "checking"] = "playing"
    unstored: Callable[[], str] = str  # says why trials are not stored; empty: nothing is wrong
    batches: Callable[[], list[str]] = list  # says which batches are waited for

    def standing(self, sweep_id: str) -> Standing:
        """Where the sweep stands now."""
        meters = self.runner.meters.values()
        now = datetime.now(UTC)
        elapsed_s = (now - self.began_at).total_seconds()
        failed = self.outcome_counts["failed"]
        ended = self.outcome_counts.total() - self.outcome_counts["suspended"] - failed
        batches = _first(self.batches(), "others")
        return Standing(
            sweep_id=sweep_id,
            name=self.plan.name,
            model=self.plan.driver + " (a mock)" * self.plan.scripted,
            pid=os.getpid(),
            machine=MACHINE,
            started_at=self.began_at,
            updated_at=now,
            doing=self.doing,
            trials=self.planned,
            stored_before=self.stored,
            running=self.runner.running,
            workers=self.runner.workers,
            ended=self.stored + ended,
            failed=failed,
            calls_live=sum(meter.calls_live for meter in meters),
            calls_cached=sum(meter.calls_cached for meter in meters),
            cost_usd=sum(meter.cost_usd for meter in meters),
            cap_usd=self.cap_usd,
            committed_usd=self.ledger.spending.committed_usd,
            # How long a batch takes nobody knows.
            left_s=None if batches else self._left_s(elapsed_s, ended + failed),
            worst_stall_s=self.worst_stall_s,
            waiting=tuple(map(printable, [*batches, *[CLOSE_IT] * bool(batches), *self._waits()])),
            warnings=tuple(map(printable, self._warnings())),
        )

    def _left_s(self, elapsed_s: float, ended: int) -> float | None:
        """The estimated time left in s; None while there is nothing to estimate it from.

        Trials that run in step all end late, so early in a run the calls are a better basis.
        """
        total = self.planned - self.stored
        calls = sum(m.calls_live + m.calls_cached for m in self.runner.meters.values())
        expected_calls = total * self.plan.calls_of_a_trial
        by_calls = min(calls / expected_calls, 0.99) if expected_calls else 0.0
        part = max(ended / total, by_calls) if ended < total else 0.0
        return elapsed_s / part - elapsed_s if part else None

    def _warnings(self) -> list[str]:
        meters = self.runner.meters.items()
        others = {pair for _, meter in meters for pair in meter.mismatches}
        return [
            *filter(None, [self.unstored()]),
            *(f"another model answers: {pair}" for pair in sorted(others)),
            *(f"a scripted stand-in answers, not {name}" for name, m in meters if m.stand_ins),
        ]

    def _waits(self) -> list[str]:
        """How many calls wait, for what, and the latest time until when, if known."""
        alike: dict[str, list[Wait]] = {}
        for wait in self.runner.waits:
            alike.setdefault(wait.what, []).append(wait)
        texts = []
        for what, waits in sorted(alike.items(), key=lambda item: -len(item[1])):
            ends = [wait.until for wait in waits if wait.until is not None]
            until = f" until {max(ends):%H:%M:%S} UTC" if ends else ""
            texts.append(f"{len(waits)} {what}{until}")
        return _first(texts, "other reasons")


def _first(texts: list[str], others: str, shown: int = REASONS_SHOWN) -> list[str]:
    """The first texts, and how many ``others`` there are."""
    left_out = len(texts) - shown
    return [*texts[:shown], f"{left_out} {others}"] if left_out > 0 else texts


@asynccontextmanager
async def publish_progress(progress: Progress, file: ProgressFile) -> AsyncIterator[None]:
    """Keep a sweep's progress file up to date while the body runs; remove the file at the end.

    Also measures how late the event loop wakes a task that sleeps.
    """

    async def publish() -> None:
        loop = asyncio.get_running_loop()
        while True:
            file.write(progress.standing(file.sweep_id))
            for _ in range(PULSES):
                due = loop.time() + PULSE_S
                await asyncio.sleep(PULSE_S)
                progress.worst_stall_s = max(progress.worst_stall_s, loop.time() - due)

    clear_dead(file.db)
    publishing = asyncio.create_task(publish())
    try:
        yield
    finally:
        publishing.cancel()
        file.remove()


@asynccontextmanager
async def display_progress(progress: Progress, *, quiet: bool) -> AsyncIterator[None]:
    """Show the progress on stderr while the body runs, and at its end.

    ``quiet``: only the clients' messages.
    """
    stop = asyncio.Event()
    display = asyncio.create_task(_show(progress, stop, quiet=quiet))
    try:
        yield
    finally:
        stop.set()
        try:
            await display
        except OSError as exc:
            if exc.errno != errno.EIO:  # that of a terminal that is closed
                raise


async def _show(progress: Progress, stop: asyncio.Event, *, quiet: bool) -> None:
    live = None
    if not quiet and sys.stderr.isatty():
        from rich.console import Console
        from rich.live import Live

        live = Live(console=Console(stderr=True), auto_refresh=False)
    with live or nullcontext():  # the table stays below what is printed meanwhile
        while True:
            with suppress(TimeoutError):
                async with asyncio.timeout(LIVE_EVERY_S if live else PLAIN_EVERY_S):
                    await stop.wait()
            for note in _notes(progress):
                say(note)
            if live is not None:
                live.update(table_of(progress.standing("")), refresh=True)
            elif not quiet:
                rows = rows_of(progress.standing(""))
                say("; ".join(f"{name}: {text}" for name, text in rows))
            if stop.is_set():
                return


def rows_of(now: Standing) -> list[tuple[str, str]]:
    """Name and text of every figure that is shown."""
    this_run = now.ended + now.failed - now.stored_before
    before = f" (+{now.stored_before} stored before)" if now.stored_before else ""
    workers = "" if now.workers is None else f" on {now.workers} workers"
    cap = ""
    if now.cap_usd is not None:
        cap = f", {now.committed_usd:.2f} of {now.cap_usd:g} over all runs"
    left = "" if now.left_s is None else f", about {now.left_s:.0f} s left"
    elapsed_s = (now.updated_at - now.started_at).total_seconds()
    return [
        *(("WARNING", text) for text in now.warnings),
        (
            "trials",
            f"{this_run}/{now.trials - now.stored_before} ended{before}, {now.running} "
            f"running{workers}",
        ),
        ("failed", str(now.failed)),
        ("calls", f"{now.calls_live} live, {now.calls_cached} from recordings"),
        ("cost", f"{now.cost_usd:.2f} USD{cap}"),
        *(("waiting", text) for text in now.waiting),
        ("time", f"{elapsed_s:.0f} s{left}"),
    ]


def table_of(now: Standing) -> Table:
    """The same as a table for a terminal."""
    from rich.table import Table
    from rich.text import Text

    title = Text(printable(f"{now.name}: {now.model}"))
    table = Table(title=title, title_justify="left", show_header=False, box=None)
    for name, text in rows_of(now):
        table.add_row(name, Text(text))  # text from a server must not be read as markup
    return table


def _notes(progress: Progress) -> list[str]:
    """The clients' messages since the last call: each once, and the first NOTES_SHOWN."""
    notes: dict[str, None] = {}
    for meter in progress.runner.meters.values():
        while meter.notes:
            notes[meter.notes.popleft()] = None
    return _first(list(notes), "more like these", NOTES_SHOWN)


def say(line: str) -> None:
    """Print a message beside the results."""
    print(printable(line), file=sys.stderr, flush=True)  # noqa: T201 # the display
