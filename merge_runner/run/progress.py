"""What a user sees while a sweep runs: a live text on a terminal, plain lines elsewhere."""

from __future__ import annotations

import asyncio
import sys
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from merge_runner.llm.ledger import Ledger
from merge_runner.results.progress_file import Standing, clear_dead, remove_standing, write_standing
from merge_runner.run.plan import Plan
from merge_runner.text_safety import printable, say

if TYPE_CHECKING:
    from rich.text import Text

    from merge_runner.run.cluster import DaskTasks
    from merge_runner.run.local_runner import LocalRunner

PULSE_S = 0.05
# In pulses: how often the file and a terminal are written, and plain lines.
PUBLISHED_EVERY, PLAIN_EVERY = 20, 100
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
    ended_at: datetime | None = None
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
        live, cached = (sum(m.calls_live for m in meters), sum(m.calls_cached for m in meters))
        cost_usd = sum(meter.cost_usd for meter in meters)
        batches = first_of(self.batches(), "others")
        # How long a batch takes nobody knows.
        left_s = None if batches else self._left_s(elapsed_s, ended + failed, live + cached)
        trials = f"{ended + failed}/{self.planned - self.stored} ended"
        trials += f" (+{self.stored} stored before)" if self.stored else ""
        trials += f", {self.runner.running} running"
        trials += "" if self.runner.workers is None else f" on {self.runner.workers} workers"
        cost = f"{cost_usd:.2f} USD"
        if self.cap_usd is not None:
            cost += f", {self.ledger.spending.committed_usd:.2f} of {self.cap_usd:g} over all runs"
        left = "" if left_s is None else f", about {left_s:.0f} s left"
        rows = [
            *dict.fromkeys(("WARNING", text) for text in self._warnings()),
            ("trials", trials),
            ("failed", str(failed)),
            ("calls", f"{live} live, {cached} from recordings"),
            ("cost", cost),
            *(("waiting", text) for text in batches + [CLOSE_IT] * bool(batches) + self._waits()),
            ("time", f"{elapsed_s:.0f} s{left}"),
        ]
        return Standing(
            sweep_id=sweep_id,
            updated_at=now,
            doing=self.doing,
            ended=self.stored + ended,
            failed=failed,
            cost_usd=cost_usd,
            left_s=left_s,
            rows=tuple((name, printable(text)) for name, text in rows),
        )

    def _left_s(self, elapsed_s: float, ended: int, calls: int) -> float | None:
        """The estimated time left in s; None while there is nothing to estimate it from.

        Trials that run in step all end late, so early in a run the calls are a better basis.
        """
        total = self.planned - self.stored
        expected_calls = self.plan.usual_calls * total / self.plan.trials
        by_calls = min(calls / expected_calls, 0.99) if expected_calls else 0.0
        part = max(ended / total, by_calls) if ended < total else 0.0
        return elapsed_s / part - elapsed_s if part else None

    def _warnings(self) -> Iterator[str]:
        if problem := self.unstored():
            yield problem
        for name, meter in self.runner.meters.items():
            yield from (f"another model answers: {pair}" for pair in sorted(meter.mismatches))
            if meter.stand_ins:
                yield f"a scripted stand-in answers, not {name}"

    def _waits(self) -> list[str]:
        """How many calls wait, for what, and the latest time until when, if known."""
        texts = []
        for what, number in Counter(wait.what for wait in self.runner.waits).most_common():
            ends = [w.until for w in self.runner.waits if w.what == what and w.until is not None]
            until = f" until {max(ends):%H:%M:%S} UTC" if ends else ""
            texts.append(f"{number} {what}{until}")
        return first_of(texts, "other reasons")


def first_of(texts: list[str], others: str, shown: int = REASONS_SHOWN) -> list[str]:
    """The first texts, and how many ``others`` there are."""
    left_out = len(texts) - shown
    return [*texts[:shown], f"{left_out} {others}"] if left_out > 0 else texts


@asynccontextmanager
async def show_progress(
    progress: Progress, db: Path, sweep_id: str, *, quiet: bool
) -> AsyncIterator[None]:
    """Show the progress on stderr and in a file beside the database while the body runs.

    ``quiet``: only the clients' messages.
    """
    live = None
    if not quiet and sys.stderr.isatty():
        from rich.console import Console
        from rich.live import Live

        live = Live(console=Console(stderr=True), auto_refresh=False)
        live.start()  # the text stays below what is printed meanwhile

    def show() -> None:
        with suppress(OSError):  # the terminal may be closed
            for note in _notes(progress):
                say(note)
            if live is not None:
                live.update(terminal_text(progress), refresh=True)
            elif not quiet:
                say("; ".join(f"{name}: {text}" for name, text in progress.standing("").rows))

    def publish() -> None:
        write_standing(db, progress.standing(sweep_id))

    async def follow() -> None:
        """Publish and show it, and measure how late the event loop wakes a task that sleeps."""
        loop = asyncio.get_running_loop()
        for pulse in count(1):
            due = loop.time() + PULSE_S
            await asyncio.sleep(PULSE_S)
            progress.worst_stall_s = max(progress.worst_stall_s, loop.time() - due)
            if pulse % PUBLISHED_EVERY == 0:
                publish()
            if pulse % (PLAIN_EVERY if live is None else PUBLISHED_EVERY) == 0:
                show()

    clear_dead(db)
    publish()
    following = asyncio.create_task(follow())
    try:
        yield
    finally:
        following.cancel()
        show()
        with suppress(OSError):
            if live is not None:
                live.stop()
        remove_standing(db, sweep_id)


def terminal_text(progress: Progress) -> Text:
    """What is shown on a terminal; text from a server must not be read as markup."""
    from rich.text import Text

    mock = " (a mock)" if progress.plan.scripted else ""
    rows = (f"{name:<8} {text}" for name, text in progress.standing("").rows)
    return Text(
        printable("\n".join([f"{progress.plan.name}: {progress.plan.driver}{mock}", *rows]))
    )


def _notes(progress: Progress) -> list[str]:
    """The clients' messages since the last call: each once, and the first NOTES_SHOWN."""
    notes: dict[str, None] = {}
    for meter in progress.runner.meters.values():
        notes |= dict.fromkeys(meter.notes)
        meter.notes.clear()
    return first_of(list(notes), "more like these", NOTES_SHOWN)
