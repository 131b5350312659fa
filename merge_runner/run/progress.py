"""What a user sees while a sweep runs: a live table on a terminal, plain lines elsewhere."""

from __future__ import annotations

import asyncio
import os
import sys
import time
from collections import Counter
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Literal

from merge_runner.llm.call import Wait
from merge_runner.llm.ledger import Ledger
from merge_runner.llm.meter import Meter
from merge_runner.records import Cell
from merge_runner.results.progress_file import (
    EVERY_S,
    MACHINE,
    CellStanding,
    ProgressFile,
    Standing,
    clear_dead,
)
from merge_runner.text_safety import printable

if TYPE_CHECKING:
    from rich.table import Table

    from merge_runner.run.local_runner import TrialRunner

LIVE_EVERY_S = 0.25
PLAIN_EVERY_S = 5.0
PULSE_S = 0.05
NOTES_SHOWN = 10
REASONS_SHOWN = 3


@dataclass(slots=True)
class Progress:
    """Where a sweep stands; ``runner`` plays its trials.

    ``expected_calls`` is about how many calls all trials take: trials that run in step all end
    late, so the calls tell the time left better than the trials do. ``worst_stall_s`` is by how
    much the event loop was late at worst. ``planned``, ``stored`` before this run, and ``by_cell``,
    how this run's trials ended, are told to other processes alone.
    """

    title: str
    total: int
    expected_calls: int = 0
    runner: TrialRunner | None = None
    cap_usd: float | None = None
    ledger: Ledger | None = None
    done: Counter[str] = field(default_factory=Counter)
    stored_before: int = 0
    started: float = field(default_factory=time.monotonic)
    worst_stall_s: float = 0.0
    name: str = ""
    model: str = ""
    planned: dict[Cell, int] = field(default_factory=dict)
    stored: Counter[Cell] = field(default_factory=Counter)
    by_cell: dict[Cell, Counter[str]] = field(default_factory=dict)
    began_at: datetime = field(default_factory=lambda: datetime.now(UTC))
    doing: Literal["playing", "checking"] = "playing"

    def count(self, cell: Cell, status: str) -> None:
        """A trial has ended, or waits for money: ``suspended``."""
        self.by_cell.setdefault(cell, Counter())[status] += 1
        if status != "suspended":
            self.done[status] += 1

    @property
    def ended(self) -> int:
        """How many trials of this run have ended, in whatever way."""
        return self.done.total()

    def fields(self) -> list[tuple[str, str]]:
        """Name and text of every figure that is shown."""
        elapsed = time.monotonic() - self.started
        meters = self.meters
        live = sum(meter.calls_live for meter in meters)
        cached = sum(meter.calls_cached for meter in meters)
        rates = [meter.last_minute() for meter in meters]
        requests, tokens = (sum(rate[i] for rate in rates) for i in (0, 1))
        cost = sum(meter.cost_usd for meter in meters)
        left_s = self._left_s(elapsed, live + cached)
        left = "" if left_s is None else f", about {left_s:.0f} s left"
        window = min(60.0, max(elapsed, 1.0)) / 60
        before = f" (+{self.stored_before} stored before)" if self.stored_before else ""
        running = self.runner.running if self.runner else 0
        return [
            *(("WARNING", text) for text in self._warnings()),
            ("trials", f"{self.ended}/{self.total} ended{before}, {running} running{self._on()}"),
            ("failed", str(self.done["failed"])),
            ("calls", f"{live} live, {cached} from recordings"),
            ("rate", f"{requests / window:.0f} requests/min, {tokens / window:.0f} tokens/min"),
            ("cost", f"{cost:.2f} USD{self._spent()}"),
            *(("calls waiting", "; ".join(texts)) for texts in [_waiting(self._waits)] if texts),
            ("time", f"{elapsed:.0f} s{left}"),
        ]

    def standing(self, sweep_id: str) -> Standing:
        """The same for other processes, cell by cell."""
        meters, runner = self.meters, self.runner
        live = sum(meter.calls_live for meter in meters)
        cached = sum(meter.calls_cached for meter in meters)
        return Standing(
            sweep_id=sweep_id,
            name=self.name,
            model=self.model,
            pid=os.getpid(),
            machine=MACHINE,
            started_at=self.began_at,
            updated_at=datetime.now(UTC),
            doing=self.doing,
            trials=self.total + self.stored_before,
            stored_before=self.stored_before,
            running=runner.running if runner else 0,
            workers=runner.workers if runner else None,
            cells=tuple(map(self._cell, self.planned)),
            calls_live=live,
            calls_cached=cached,
            cost_usd=sum(meter.cost_usd for meter in meters),
            cap_usd=self.cap_usd,
            committed_usd=self.ledger.spending.committed_usd if self.ledger else None,
            left_s=self._left_s(time.monotonic() - self.started, live + cached),
            worst_stall_s=self.worst_stall_s,
            waiting=tuple(map(printable, _waiting(self._waits))),
            warnings=tuple(map(printable, self._warnings())),
        )

    @property
    def meters(self) -> Sequence[Meter]:
        """One for each model."""
        return tuple(self.runner.meters.values()) if self.runner else ()

    @property
    def _waits(self) -> Sequence[Wait]:
        return self.runner.waits if self.runner else ()

    def _on(self) -> str:
        workers = self.runner.workers if self.runner else None
        return "" if workers is None else f" on {workers or 'no'} worker{'s' * (workers != 1)}"

    def _spent(self) -> str:
        """What counts against the cap: all runs of the sweep, and what is set aside."""
        if self.cap_usd is None or self.ledger is None:
            return ""
        return f", {self.ledger.spending.committed_usd:.2f} of {self.cap_usd:g} over all runs"

    def _cell(self, cell: Cell) -> CellStanding:
        playing = self.runner.playing if self.runner else {}
        ways = self.by_cell.get(cell, Counter())
        return CellStanding(
            *cell,
            planned=self.planned[cell],
            stored=self.stored[cell],
            running=None if playing is None else playing.get(cell, 0),
            finished=ways["finished"],
            collided=ways["collided"],
            timeout=ways["timeout"],
            failed=ways["failed"],
            suspended=ways["suspended"],
        )

    def _warnings(self) -> list[str]:
        others = sum((meter.mismatches for meter in self.meters), Counter[str]())
        meters = self.runner.meters.items() if self.runner else ()
        return [
            *(f"another model answers: {pair}" for pair in sorted(others)),
            *(f"a scripted stand-in answers, not {name}" for name, m in meters if m.stand_ins),
        ]

    def _left_s(self, elapsed: float, calls: int) -> float | None:
        if self.ended == self.total or not (self.ended or calls):
            return None
        by_calls = min(calls / self.expected_calls, 0.99) if self.expected_calls else 0.0
        part = max(self.ended / self.total, by_calls)
        return elapsed / part - elapsed if part else None


@asynccontextmanager
async def publish_progress(progress: Progress, file: ProgressFile) -> AsyncIterator[None]:
    """Keep the file of a sweep up to date while the body runs, and remove it at its end."""
    clear_dead(file.db)
    file.write(progress.standing(file.sweep_id))
    publishing = asyncio.create_task(_publish(progress, file))
    try:
        yield
    finally:
        publishing.cancel()
        file.remove()


@asynccontextmanager
async def display_progress(progress: Progress) -> AsyncIterator[None]:
    """Show the progress on stderr while the body runs, and once more at its end."""
    show = _show_live if sys.stderr.isatty() else _show_plain
    stop = asyncio.Event()
    display = asyncio.create_task(show(progress, stop))
    pulse = asyncio.create_task(_feel_pulse(progress))
    try:
        yield
    finally:
        pulse.cancel()
        stop.set()
        await display


async def _publish(progress: Progress, file: ProgressFile) -> None:
    while True:
        await asyncio.sleep(EVERY_S)
        await asyncio.to_thread(file.write, progress.standing(file.sweep_id))


async def _feel_pulse(progress: Progress) -> None:
    """Measure how late the event loop comes back to who waits for it."""
    loop = asyncio.get_running_loop()
    while True:
        due = loop.time() + PULSE_S
        await asyncio.sleep(PULSE_S)
        progress.worst_stall_s = max(progress.worst_stall_s, loop.time() - due)


async def _show_live(progress: Progress, stop: asyncio.Event) -> None:
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    console = Console(stderr=True)
    with Live(_table(progress), console=console, auto_refresh=False) as live:
        while not await _stopped(stop, LIVE_EVERY_S):
            for note in _notes(progress):
                console.print(Text(note))
            live.update(_table(progress), refresh=True)
        for note in _notes(progress):
            console.print(Text(note))
        live.update(_table(progress), refresh=True)


async def _show_plain(progress: Progress, stop: asyncio.Event) -> None:
    while not await _stopped(stop, PLAIN_EVERY_S):
        for note in _notes(progress):
            _say(note)
        _say(_line(progress))
    for line in (*_notes(progress), _line(progress)):
        _say(line)


def _table(progress: Progress) -> Table:
    from rich.table import Table
    from rich.text import Text

    table = Table(title=progress.title, title_justify="left", show_header=False, box=None)
    for name, text in progress.fields():
        table.add_row(name, Text(printable(text)))  # a server's words are no markup
    return table


def _line(progress: Progress) -> str:
    return "; ".join(f"{name}: {text}" for name, text in progress.fields())


def _notes(progress: Progress) -> list[str]:
    """What the clients had to say since the last look, equal lines once, not too many."""
    notes: dict[str, None] = {}
    for meter in progress.meters:
        while meter.notes:
            notes[meter.notes.popleft()] = None
    lines = [printable(note) for note in notes]
    more = [f"... and {len(lines) - NOTES_SHOWN} more like these"] * (len(lines) > NOTES_SHOWN)
    return lines[:NOTES_SHOWN] + more


def _waiting(waits: Sequence[Wait]) -> list[str]:
    """How many calls wait for what, and until when at the latest, where that is known."""
    alike: dict[str, list[Wait]] = {}
    for wait in waits:
        alike.setdefault(wait.what, []).append(wait)
    texts = []
    for what, those in sorted(alike.items(), key=lambda item: -len(item[1])):
        ends = [wait.until for wait in those if wait.until is not None]
        until = f" until {max(ends):%H:%M:%S} UTC" if ends else ""
        texts.append(f"{len(those)} {what}{until}")
    more = [f"{len(texts) - REASONS_SHOWN} other reasons"] * (len(texts) > REASONS_SHOWN)
    return texts[:REASONS_SHOWN] + more


async def _stopped(stop: asyncio.Event, seconds: float) -> bool:
    try:
        async with asyncio.timeout(seconds):
            await stop.wait()
    except TimeoutError:
        return False
    return True


def _say(line: str) -> None:
    print(printable(line), file=sys.stderr, flush=True)  # noqa: T201 # the display
