"""What a user sees while a sweep runs: a live table on a terminal, plain lines elsewhere."""

from __future__ import annotations

import asyncio
import errno
import os
import sys
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Literal

from merge_runner.llm.client import Meter, Wait
from merge_runner.llm.ledger import Ledger
from merge_runner.results.progress_file import (
    EVERY_S,
    MACHINE,
    ProgressFile,
    Standing,
    clear_dead,
)
from merge_runner.run.plan import Plan
from merge_runner.text_safety import printable

if TYPE_CHECKING:
    from rich.table import Table

    from merge_runner.run.cluster import DaskTasks
    from merge_runner.run.local_runner import LocalRunner

LIVE_EVERY_S = 0.25
PLAIN_EVERY_S = 5.0
PULSE_S = 0.05
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
    started: float = field(default_factory=time.monotonic)
    began_at: datetime = field(default_factory=lambda: datetime.now(UTC))
    worst_stall_s: float = 0.0
    doing: Literal["playing", "checking"] = "playing"
    unstored: Callable[[], str] = str  # says why trials are not stored; empty: nothing is wrong
    batches: Callable[[], list[str]] = list  # says which batches are waited for

    @property
    def title(self) -> str:
        """A title that says what is played, and by which drivers."""
        stand_in = " (scripted stand-in)" if self.plan.scripted else ""
        return f"{self.plan.name}: {self.plan.driver}{stand_in}"

    @property
    def total(self) -> int:
        """How many trials this run has to play."""
        return self.planned - self.stored

    @property
    def ended(self) -> int:
        """How many trials of this run have ended, in whatever way."""
        return self.outcome_counts.total() - self.outcome_counts["suspended"]

    def fields(self) -> list[tuple[str, str]]:
        """Name and text of every figure that is shown."""
        now = self.standing("")
        elapsed = time.monotonic() - self.started
        rates = [meter.last_minute() for meter in self.meters]
        requests, tokens = (sum(rate[i] for rate in rates) for i in (0, 1))
        left = "" if now.left_s is None else f", about {now.left_s:.0f} s left"
        window = min(60.0, max(elapsed, 1.0)) / 60
        before = f" (+{self.stored} stored before)" if self.stored else ""
        workers = now.workers
        on = "" if workers is None else f" on {workers or 'no'} worker{'s' * (workers != 1)}"
        spent = (
            f", {now.committed_usd:.2f} of {now.cap_usd:g} over all runs"
            if now.cap_usd is not None
            else ""
        )
        batches = _shortened(self.batches(), "others")
        waiting = self._waiting()
        return [
            *(("WARNING", text) for text in now.warnings),
            ("trials", f"{self.ended}/{self.total} ended{before}, {now.running} running{on}"),
            ("failed", str(now.failed)),
            ("calls", f"{now.calls_live} live, {now.calls_cached} from recordings"),
            ("rate", f"{requests / window:.0f} requests/min, {tokens / window:.0f} tokens/min"),
            ("cost", f"{now.cost_usd:.2f} USD{self._in_the_end(now.cost_usd)}{spent}"),
            *(("batches", text) for text in batches + [CLOSE_IT] * bool(batches)),
            *([("calls waiting", "; ".join(waiting))] if waiting else []),
            ("time", f"{elapsed:.0f} s{left}"),
        ]

    def standing(self, sweep_id: str) -> Standing:
        """Where the sweep stands, for the display and for other processes."""
        return Standing(
            sweep_id=sweep_id,
            name=self.plan.name,
            model=self.plan.driver,
            pid=os.getpid(),
            machine=MACHINE,
            started_at=self.began_at,
            updated_at=datetime.now(UTC),
            doing=self.doing,
            trials=self.planned,
            stored_before=self.stored,
            running=self.runner.running,
            workers=self.runner.workers,
            ended=self.stored + self.ended - self.outcome_counts["failed"],
            failed=self.outcome_counts["failed"],
            calls_live=sum(meter.calls_live for meter in self.meters),
            calls_cached=sum(meter.calls_cached for meter in self.meters),
            cost_usd=sum(meter.cost_usd for meter in self.meters),
            cap_usd=self.cap_usd,
            committed_usd=self.ledger.spending.committed_usd,
            left_s=self._left_s(),
            worst_stall_s=self.worst_stall_s,
            waiting=tuple(map(printable, [*self.batches(), *self._waiting()])),
            warnings=tuple(map(printable, self._warnings())),
        )

    @property
    def meters(self) -> Sequence[Meter]:
        """One for each model."""
        return tuple(self.runner.meters.values())

    def _in_the_end(self, cost_usd: float) -> str:
        """What a run in batches will cost, by the calls that are answered."""
        part = self._part()
        if not part or not cost_usd or not self.batches():
            return ""
        return f", about {cost_usd / part:.2f} in the end"

    def _warnings(self) -> list[str]:
        others = sum((meter.mismatches for meter in self.meters), Counter[str]())
        meters = self.runner.meters.items()
        return [
            *(text for text in [self.unstored()] if text),
            *(f"another model answers: {pair}" for pair in sorted(others)),
            *(f"a scripted stand-in answers, not {name}" for name, m in meters if m.stand_ins),
        ]

    def _left_s(self) -> float | None:
        """The estimated time left in s; None while there is nothing to estimate it from.

        How long a batch takes nobody knows.
        Trials that run in step all end late, so early in a run the calls are a better basis.
        """
        if self.batches():
            return None
        part = self._part()
        elapsed = time.monotonic() - self.started
        return elapsed / part - elapsed if part else None

    def _part(self) -> float | None:
        """What part of this run is done, by its trials or its calls; None: none of it, or all."""
        ended, total = self.ended, self.total
        if ended == total:
            return None
        calls = sum(meter.calls_live + meter.calls_cached for meter in self.meters)
        expected_calls = total * self.plan.calls_of_a_trial
        by_calls = min(calls / expected_calls, 0.99) if expected_calls else 0.0
        return max(ended / total, by_calls) or None

    def _waiting(self) -> list[str]:
        """How many calls wait, for what, and the latest time until when, if known."""
        alike: dict[str, list[Wait]] = {}
        for wait in self.runner.waits:
            alike.setdefault(wait.what, []).append(wait)
        texts = []
        for what, those in sorted(alike.items(), key=lambda item: -len(item[1])):
            ends = [wait.until for wait in those if wait.until is not None]
            until = f" until {max(ends):%H:%M:%S} UTC" if ends else ""
            texts.append(f"{len(those)} {what}{until}")
        return _shortened(texts, "other reasons")


def _shortened(texts: list[str], others: str, shown: int = REASONS_SHOWN) -> list[str]:
    """The first texts, and how many ``others`` there are."""
    more = [f"{len(texts) - shown} {others}"] * (len(texts) > shown)
    return texts[:shown] + more


@asynccontextmanager
async def publish_progress(progress: Progress, file: ProgressFile) -> AsyncIterator[None]:
    """Keep a sweep's progress file up to date while the body runs; remove the file at the end."""
    clear_dead(file.db)
    publishing = asyncio.create_task(_publish(progress, file))
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
    pulse = asyncio.create_task(_measure_stalls(progress))
    try:
        yield
    finally:
        pulse.cancel()
        stop.set()
        try:
            await display
        except OSError as exc:
            if exc.errno != errno.EIO:  # that of a terminal that is closed
                raise


async def _publish(progress: Progress, file: ProgressFile) -> None:
    while True:
        file.write(progress.standing(file.sweep_id))
        await asyncio.sleep(EVERY_S)


async def _measure_stalls(progress: Progress) -> None:
    """Measure how late the event loop wakes a task that sleeps."""
    loop = asyncio.get_running_loop()
    while True:
        due = loop.time() + PULSE_S
        await asyncio.sleep(PULSE_S)
        progress.worst_stall_s = max(progress.worst_stall_s, loop.time() - due)


async def _show(progress: Progress, stop: asyncio.Event, *, quiet: bool) -> None:
    with _screen(progress, quiet=quiet) as (every_s, say, update):
        stopped = False
        while not stopped:
            with suppress(TimeoutError):
                async with asyncio.timeout(every_s):
                    await stop.wait()
            stopped = stop.is_set()
            for note in _notes(progress):
                say(note)
            update()


@contextmanager
def _screen(
    progress: Progress, *, quiet: bool
) -> Iterator[tuple[float, Callable[[str], None], Callable[[], None]]]:
    """How often to show something in s, what shows a note, and what shows the figures."""
    if quiet:
        yield PLAIN_EVERY_S, _say, lambda: None
    elif not sys.stderr.isatty():
        yield (
            PLAIN_EVERY_S,
            _say,
            lambda: _say("; ".join(f"{name}: {text}" for name, text in progress.fields())),
        )
    else:
        from rich.console import Console
        from rich.live import Live
        from rich.text import Text

        console = Console(stderr=True)
        with Live(_table(progress), console=console, auto_refresh=False) as live:
            yield (
                LIVE_EVERY_S,
                lambda note: console.print(Text(note)),
                lambda: live.update(_table(progress), refresh=True),
            )


def _table(progress: Progress) -> Table:
    from rich.table import Table
    from rich.text import Text

    table = Table(title=progress.title, title_justify="left", show_header=False, box=None)
    for name, text in progress.fields():
        table.add_row(name, Text(printable(text)))  # text from a server must not be read as markup
    return table


def _notes(progress: Progress) -> list[str]:
    """The clients' messages since the last call: each once, and the first NOTES_SHOWN."""
    notes: dict[str, None] = {}
    for meter in progress.meters:
        while meter.notes:
            notes[meter.notes.popleft()] = None
    lines = [printable(note) for note in notes]
    return _shortened(lines, "more like these", NOTES_SHOWN)


def _say(line: str) -> None:
    print(printable(line), file=sys.stderr, flush=True)  # noqa: T201 # the display
