"""The display of a sweep while it runs."""

from __future__ import annotations

import asyncio
import re
import sys
import textwrap
from collections import Counter, defaultdict
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from merge_runner.llm.attempts import Meter
from merge_runner.run.plan import usual_prompts
from merge_runner.run.progress_file import (
    ProgressSnapshot,
    clear_dead,
    remove_snapshot,
    write_snapshot,
)
from merge_runner.run.summary import calls_text, underpriced
from merge_runner.text_safety import first_of, printable, say

if TYPE_CHECKING:
    from rich.text import Text

    from merge_runner.run.players import Player
    from merge_runner.run.session import Session

PULSE_S = 0.05
# Pulses between writes of the file and of a terminal, and between plain lines.
PUBLISHED_EVERY, PLAIN_EVERY = 20, 100
REASONS_SHOWN = 3
LONGEST_LINE, CENT_USD = 120, 0.005
CLOSE_IT = "you may close this: the same command goes on"


@dataclass(slots=True)
class Progress:
    """State of a run, as its display shows it; ``runner`` plays the missing trials of ``session``.

    ``todo`` has their number by arm, and ``done`` how many of them ended; ``outcome_counts`` has
    their outcomes: a Status, or ``suspended`` until there is more money. ``unstored`` returns the
    reason why trials are not stored; empty: nothing is wrong. ``worst_stall_s`` is the longest
    delay of the event loop. ``batches`` returns the batches that are waited for.
    """

    session: Session
    runner: Player
    batches: Callable[[], list[str]] = list
    todo: Counter[str] = field(init=False)
    done: Counter[str] = field(default_factory=Counter)
    outcome_counts: Counter[str] = field(default_factory=Counter)
    unstored: Callable[[], str] = str
    began_at: datetime = field(default_factory=lambda: datetime.now(UTC))
    ended_at: datetime | None = None
    worst_stall_s: float = 0.0
    doing: Literal["playing", "checking"] = "playing"

    def __post_init__(self) -> None:
        self.todo = Counter(spec.arm for spec in self.session.todo)

    def meter(self) -> Meter:
        """Return the counts of all models together."""
        total = Meter()
        for meter in self.runner.meters.values():
            total.add(meter)
        return total

    def snapshot(self, sweep_id: str) -> ProgressSnapshot:
        """Return the state of the run now."""
        meter = self.meter()
        now = datetime.now(UTC)
        elapsed_s = (now - self.began_at).total_seconds()
        counts = self.outcome_counts
        failed = counts["failed"]
        ended = counts.total() - counts["suspended"] - failed
        batches = first_of(self.batches(), "others", REASONS_SHOWN)
        # The time that a batch takes is unknown.
        shares = self._shares()
        left_s = None if batches else self._left_s(elapsed_s, ended + failed, shares)
        stored = len(self.session.stored)
        names = {model: f"{model}: " * (len(shares) > 1) for model in shares}
        decided = [f"{names[m]}about {share:.0%} of the decisions" for m, share in shares.items()]
        before = f" (+{stored} stored before)" if stored else ""
        waiting = self.runner.waiting_for_money
        state = f"{max(0, self.runner.running_trials - waiting)} running{self.runner.place}"
        state += f", {waiting} wait for money" if waiting else ""
        total = self.todo.total()
        trials = f"{ended + failed}/{total} ended{before}, {state}"
        cost = f"{meter.cost_usd:.2f} USD"
        ledger = self.session.ledger
        if (cap := ledger.cap) is not None:
            cost += f", {ledger.committed_usd:.2f} of {cap.usd:g} over all runs"
        left = "" if left_s is None else f", about {left_s:.0f} s left"
        rows = [
            *dict.fromkeys(("WARNING", text) for text in self._warnings()),
            ("trials", trials),
            *(("decided", text) for text in decided if ended + failed < total),
            ("failed", str(failed)),
            ("calls", calls_text(*meter.answered)),
            ("cost", cost),
            *(("waiting", text) for text in batches + [CLOSE_IT] * bool(batches) + self._waits()),
            ("time", f"{elapsed_s:.0f} s{left}"),
        ]
        return ProgressSnapshot(
            sweep_id=sweep_id,
            updated_at=now,
            doing=self.doing,
            ended=stored + ended,
            failed=failed,
            cost_usd=meter.cost_usd,
            left_s=left_s,
            rows=tuple((name, printable(text)) for name, text in rows),
        )

    def _left_s(self, elapsed_s: float, ended: int, shares: Mapping[str, float]) -> float | None:
        """Return the estimated time left in s; None while there is nothing to estimate it from.

        The slowest model determines it. Trials that begin together end together, so early in a run
        the calls are a better basis.
        """
        total = self.todo.total()
        if ended >= total:
            return None
        parts = []
        for model, share in shares.items():
            done = self._of(model, self.done)
            todo = self._of(model, self.todo)
            if done < todo:
                parts.append(max(done / todo, share))
        part = min(parts, default=ended / total)
        return elapsed_s / part - elapsed_s if part else None

    def _of(self, model: str, by_arm: Counter[str]) -> int:
        registered = self.session.plan.registered
        return sum(
            by_arm[arm.label]
            for arm in self.session.plan.arms
            if model in {registered[name] for name in arm.entries}
        )

    def _shares(self) -> dict[str, float]:
        """Return the share of its decisions that each model has made, of those left to this run.

        The number of decisions in a trial is known only at its end, so the usual number is taken.
        """
        expected, made = defaultdict[str, float](float), Counter[str]()
        for arm in self.session.plan.arms:
            for name in filter(arm.entries.get, arm.full_names.values()):
                model = self.session.plan.registered[name]
                expected[model] += self.todo[arm.label] * usual_prompts(arm)
        for name, meter in self.runner.meters.items():
            made[self.session.plan.registered.get(name, name)] += (
                meter.calls_live + meter.calls_cached
            )
        return {m: min(made[m] / calls, 0.99) for m, calls in expected.items() if calls}

    def _warnings(self) -> Iterator[str]:
        if problem := self.unstored():
            yield problem
        for name, meter in self.runner.meters.items():
            yield from (f"another model answers: {pair}" for pair in sorted(meter.mismatches))
            if meter.mock_replies:
                yield f"a mock model answers, not {name}"
            yield from (f"{name}: {underpriced(tier)}" for tier in sorted(meter.underpriced))

    def _waits(self) -> list[str]:
        """Return the number of waiting calls by their reason, with the latest end if known."""
        texts = []
        for reason, number in Counter(wait.what for wait in self.runner.waits).most_common():
            ends = [w.until for w in self.runner.waits if w.what == reason and w.until is not None]
            until = f" until {max(ends):%H:%M:%S} UTC" if ends else ""
            texts.append(f"{number} {reason}{until}")
        return first_of(texts, "other reasons", REASONS_SHOWN)


@asynccontextmanager
async def show_progress(
    progress: Progress, db: Path, sweep_id: str, *, quiet: bool
) -> AsyncIterator[None]:
    """Show the progress on stderr and in a file beside the database while the body runs.

    ``quiet``: only the clients' messages.
    """
    live, log = None, Log()
    if not quiet and sys.stderr.isatty():
        from rich.console import Console
        from rich.live import Live

        live = Live(console=Console(stderr=True), auto_refresh=False)
        live.start()  # the text stays below what is printed meanwhile

    def show(*, ended: bool = False) -> None:
        with suppress(OSError):  # the terminal may be closed
            for note in _notes(progress):
                say(note)
            if live is not None:
                live.update(terminal_text(progress), refresh=not ended)
            elif not quiet:
                log.show(progress)

    def publish() -> None:
        write_snapshot(db, progress.snapshot(sweep_id))

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
        show(ended=True)  # a terminal is written once more when the display stops
        with suppress(OSError):
            if live is not None:
                live.stop()
        remove_snapshot(db, sweep_id)
        with suppress(asyncio.CancelledError):
            await following


def terminal_text(progress: Progress) -> Text:
    """Return the text on a terminal; text from a server must not be read as markup."""
    from rich.text import Text

    plan = progress.session.plan
    mock = " (a mock)" if plan.scripted else ""
    rows = (f"{name:<8} {text}" for name, text in progress.snapshot("").rows)
    return Text(printable("\n".join([f"{plan.name}: {plan.driver}{mock}", *rows])))


@dataclass
class Log:
    """The progress as short lines, for an output that is no terminal: only unusual facts.

    A warning, or a hint that is shown once, is a line of its own.
    """

    last_line: str = ""
    shown_once: set[str] = field(default_factory=set)

    def show(self, progress: Progress) -> None:
        """Print the state of the run; once the trials have ended, only changes."""
        snapshot = progress.snapshot("")
        for name, text in snapshot.rows:
            # Numbers of the same warning change.
            kind = re.sub(r"\d+", "", text)
            if (name == "WARNING" or text == CLOSE_IT) and kind not in self.shown_once:
                say(f"{name}: {text}")
                self.shown_once.add(kind)
        rows = dict(reversed(snapshot.rows))  # the first of each name
        ended = snapshot.ended + snapshot.failed - len(progress.session.stored)
        line = f"trials: {ended}/{progress.todo.total()} ended{progress.runner.place}"
        line += f"; failed: {snapshot.failed}" if snapshot.failed else ""
        line += f"; cost: {rows['cost']}" if snapshot.cost_usd >= CENT_USD else ""
        if line != self.last_line or progress.doing == "playing":
            waits = f"; waiting: {rows['waiting']}" if "waiting" in rows else ""
            say(
                textwrap.shorten(f"{line}; {rows['time']}{waits}", LONGEST_LINE, placeholder=" ...")
            )
        self.last_line = line


def _notes(progress: Progress) -> list[str]:
    """Return the clients' messages since the last call: each once, and the first few."""
    notes: dict[str, None] = {}
    for meter in progress.runner.meters.values():
        notes |= dict.fromkeys(meter.notes)
        meter.notes.clear()
    return first_of(list(notes), "more like these")
