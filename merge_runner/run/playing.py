"""Plays the trials of a run and stores them, until all have ended or the run is stopped."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime

from merge_runner.errors import StoreError, TrialSuspended
from merge_runner.results.replay_misses import Miss
from merge_runner.run.interrupt import GO_ON, INTERRUPTED, Stopping
from merge_runner.run.progress import REASONS_SHOWN, Progress
from merge_runner.run.replay import Replay
from merge_runner.run.session import Session, misses_of
from merge_runner.run.writer import AGAIN, BATCH, TrialWriter
from merge_runner.text_safety import first_of
from merge_runner.trial_records import TrialRecord, TrialSpec

SHOWN = 5  # trials that are stored otherwise


@dataclass
class Endings:
    """Tally of trials as they end, which also go to the writer."""

    progress: Progress
    writer: TrialWriter
    misses: list[Miss] = field(default_factory=list)
    suspended: Counter[str] = field(default_factory=Counter)  # by drivers and prompt
    why_suspended: str = ""

    def add(self, spec: TrialSpec, record: TrialRecord | TrialSuspended) -> None:
        """Take a trial that has ended, or is suspended for lack of money."""
        counts = self.progress.outcome_counts
        if isinstance(record, TrialSuspended):
            counts["suspended"] += 1
            self.suspended[_played_as(spec)] += 1
            self.why_suspended = str(record)
            return
        counts[record.status] += 1
        self.progress.done[spec.arm] += 1
        self.misses += misses_of(record)
        self.writer.add(record)

    def note_suspended(self) -> None:
        """Note the trials that wait for money."""
        if not self.suspended:
            return
        session = self.progress.session
        cap = session.ledger.cap
        assert cap is not None  # without one no trial waits
        waiting = dict.fromkeys(map(_played_as, session.todo), 0) | self.suspended
        session.fail(
            TrialSuspended.exit_code,
            f"{self.suspended.total()} trials wait for money{_unbalanced(waiting)}: "
            f"{self.why_suspended}. Their replies stay stored: raise {cap.source}, and run the "
            "same command again",
        )


async def play_and_store(
    progress: Progress, writer: TrialWriter, stopping: Stopping
) -> tuple[bool, bool]:
    """Play and store the missing trials; problems are noted in the session.

    Returns whether the database can be written, and whether the task was cancelled. It cannot if
    Ctrl-C ends the wait for another program that holds it.
    """
    session, endings = progress.session, Endings(progress, writer)
    progress.unstored = lambda: writer.problem
    try:
        cancelled = await _play_until_stopped(endings, stopping)
        endings.note_suspended()
    finally:
        progress.ended_at = datetime.now(UTC)
        is_writable = await _store_rest(session, writer, stopping)
    session.fail_by_misses(endings.misses)
    failed = progress.outcome_counts["failed"]
    if failed and not endings.misses:
        session.fail(1, f"{failed} trials failed")
    return is_writable, cancelled


async def _play_until_stopped(endings: Endings, stopping: Stopping) -> bool:
    """Play trials until all have ended, or the run is stopped; return whether it is cancelled.

    Two tasks, since Ctrl-C stops the trials but lets the calls that are paid for end.
    """
    session, player = endings.progress.session, endings.progress.runner
    writer = endings.writer
    work = asyncio.create_task(
        player.play(session.todo, endings.add, capacity=writer.wait_for_capacity)
    )
    writer.on_break = work.cancel  # no money is spent on what cannot be stored

    async def drained() -> None:
        await asyncio.wait([work])
        await player.drain()

    drain = asyncio.create_task(drained())

    def interrupted() -> None:
        work.cancel()  # before anything is written: the terminal may be closed
        session.say(f"Stopping: {player.unsaved} are stored first; Ctrl-C again drops them.")

    cancelled = False
    with stopping(interrupted, drain.cancel):
        try:
            await asyncio.wait([drain])
        except asyncio.CancelledError:  # by the caller of this task
            cancelled = True
            interrupted()
            await asyncio.wait([drain])
        finally:
            drain.cancel()
        await asyncio.wait([work])
    if not work.cancelled():
        session.fail_by(work.exception())
    elif not writer.broken:  # whose error is noted when the rest is stored
        session.fail(INTERRUPTED, f"Interrupted. {GO_ON}")
    return cancelled


async def _store_rest(session: Session, writer: TrialWriter, stopping: Stopping) -> bool:
    """Store the remaining trials; return whether the database can be written."""
    closing = asyncio.create_task(_store_all(session, writer))
    with stopping(None, closing.cancel):
        try:
            await asyncio.wait([closing])
        finally:
            closing.cancel()
    if closing.cancelled():
        why = f": {writer.problem}. {AGAIN}" if writer.problem else ". " + GO_ON
        session.fail(INTERRUPTED, f"Interrupted{why}")
        return False
    session.fail_by(closing.exception())
    if writer.differing:
        differing = [*writer.differing.items()][:SHOWN]
        shown = [f"{trial_id} ({', '.join(columns)})" for (trial_id, _), columns in differing]
        session.fail(
            StoreError.exit_code,
            f"{len(writer.differing)} trials are stored otherwise in {session.options.db}, "
            f"which is left as it is: {'; '.join(shown)}. Replay into another --db.",
        )
    return closing.exception() is None or writer.broken  # what breaks is not the database


async def _store_all(session: Session, writer: TrialWriter) -> None:
    """Store the trials in memory, and replay the dropped ones, without a call."""
    await writer.close()
    if writer.dropped:
        session.say(
            f"{len(writer.dropped)} trials that are not stored yet are played again from the "
            "recorded replies, without a call; Ctrl-C leaves them to the next run"
        )
    while writer.dropped:
        again, writer.dropped = writer.dropped[:BATCH], writer.dropped[BATCH:]
        replay = Replay(session.plan, session.cache)
        await replay.play(again, lambda _, record: writer.add(record))
        await writer.close()


def _played_as(spec: TrialSpec) -> str:
    """Return the drivers and the prompt of a trial, the beginning of its name."""
    name = spec.trial_id.rsplit("/", 2)[0]
    return name.removeprefix("seat/") if spec.source == "first_decision" else name


def _unbalanced(waiting: Mapping[str, int]) -> str:
    """Return the numbers of waiting trials by arm, as text, where they differ."""
    if len({*waiting.values()}) <= 1:
        return ""
    parts = first_of(
        [f"{number} of {name}" for name, number in waiting.items()], "others", REASONS_SHOWN
    )
    return f" ({', '.join(parts)}: what has ended is not balanced)"
