"""Runs a sweep: the composition root, which wires player, store, display and audit."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Callable, Sequence
from contextlib import AsyncExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.templates import answer_counts
from merge_runner.paths import SHIPPED_RECORDINGS
from merge_runner.providers import UNNAMED
from merge_runner.results.database import unreadable_is_usage
from merge_runner.results.provenance import git_state
from merge_runner.results.replay_misses import described
from merge_runner.results.store import Store
from merge_runner.run.interrupt import NEVER, Stopping
from merge_runner.run.options import Options
from merge_runner.run.plan import Plan, usual_prompts
from merge_runner.run.playing import play_and_store
from merge_runner.run.progress import Progress, show_progress
from merge_runner.run.progress_file import write_snapshot
from merge_runner.run.replay import Replay
from merge_runner.run.run_record import begin, check, end
from merge_runner.run.session import Session, misses_of, open_session
from merge_runner.run.summary import as_dict
from merge_runner.run.writer import TrialWriter

if TYPE_CHECKING:
    from merge_runner.run.estimate import Estimate
    from merge_runner.run.players import Player


async def play(
    plan: Plan,
    options: Options,
    *,
    whole: bool,
    say: Callable[[str], None],
    agree: Callable[[Estimate], None],
    stopping: Stopping = NEVER,
) -> dict[str, Any]:
    """Play the trials of a plan that are not stored yet; return ``summary.as_dict``.

    A replay without named recordings uses the shipped one, if the cache has no replies of the
    models. Unless ``whole``, it plays only the trials in its recordings. ``agree``
    gets an estimate before money is spent, and raises to prevent that. ``stopping`` gives the
    events that stop the run; a cancelled task stores paid replies first. Raises UsageError.
    """
    if options.replay:
        shipped = SHIPPED_RECORDINGS / f"{plan.model}-{plan.study.name}.parquet"
        if not options.recordings and shipped.is_file():
            with closing(ResponseCache(options.cache)) as cache:
                has_replies = _has_replies(cache, plan)
            if not has_replies:  # a user's replies are never mixed with other people's
                options = replace(options, recordings=(shipped,))
                say(f"The replies are from the recording that ships with merge-runner: {shipped}")
        is_part = options.recordings and not whole
        part = _recorded_part(plan, options.recordings) if is_part else plan
        if part.trials < plan.trials:
            say(f"note: the recording holds {part.trials} of the plan's {plan.trials} trials")
        plan = part
    async with open_session(plan, options, say=say) as session:
        expected = None
        if session.todo and not (options.replay or plan.is_free):
            expected = await estimate_rest(session)
            if expected.trials:  # some call is not stored yet
                agree(expected)
        return await run(session, expected, stopping)


async def run(
    session: Session, expected: Estimate | None = None, stopping: Stopping = NEVER
) -> dict[str, Any]:
    """Play and store the missing trials; return the summary, with all problems.

    ``expected`` is an estimate that the user has agreed to.
    """
    plan, options, db = session.plan, session.options, session.options.db
    replay, sweep_id, checked = Replay(plan, session.cache), "", None
    ahead = await replay.look_ahead(session.todo) if options.replay else []
    if misses := [miss for record in ahead for miss in misses_of(record)]:
        progress = Progress(session, replay)
        session.fail_by_misses(misses)
        contents = described(options.recordings, session.cache.entries())
        session.messages.append(
            f"nothing of this replay is recorded, and nothing is stored: {contents}"
        )
    else:
        async with AsyncExitStack() as stack:
            # While git reads the checkout, DuckDB makes the database.
            git = asyncio.get_running_loop().run_in_executor(None, git_state)
            store, rounds = Store(db), None
            player: Player = replay
            if plan.entries and not options.sends_nothing:
                # Imported here, since that takes long, and a replay needs no clients.
                from merge_runner.run.clients import open_rounds
                from merge_runner.run.players import open_player

                rounds = open_rounds(plan, options, session.cache, session.say)
                player = await open_player(session, store, rounds, stack)
            progress = Progress(session, player, rounds.status_lines if rounds else list)
            commit, dirty = await git
            with unreadable_is_usage():
                sweep_id = begin(session, store, commit, dirty=dirty)
            shown = show_progress(progress, db, sweep_id, quiet=options.quiet)
            await stack.enter_async_context(shown)
            writer = TrialWriter(store, sweep_id, session.say, is_live=not options.replay)
            is_writable, cancelled = await play_and_store(progress, writer, stopping)
            progress.doing = "checking"
            write_snapshot(db, progress.snapshot(sweep_id))
            if is_writable:
                end(session, store, sweep_id)
                checked = await check(session, store, sweep_id, player.first)
        if cancelled:
            raise asyncio.CancelledError
    return as_dict(progress, sweep_id, expected, checked)


async def estimate_rest(session: Session, *, whole: bool = False) -> Estimate:
    """Return the estimate of a live run: replay recorded replies, and count the missing ones.

    ``whole``: of all trials, as if none were stored or recorded yet.
    """
    # A replay needs no estimate.
    from merge_runner.run.estimate import earlier_answers, estimate, usual_latencies_s

    plan, options, cache = session.plan, session.options, session.cache
    trials, arms = 0, plan.by_label()
    calls = {label: dict.fromkeys(arm.entries, 0.0) for label, arm in arms.items()}
    replay = Replay(plan, cache)
    for spec in [*session.stored, *session.todo] if whole else session.todo:
        await asyncio.sleep(0)  # another study of this process goes on
        arm = arms[spec.arm]
        record = replay.play_one(spec) if arm.entries and not whole else None
        if record is not None and record.status != "failed":
            continue
        trials += 1
        for side, name in arm.full_names.items():
            if name in arm.entries:
                answered = sum(row.side == side for row in record.decisions) if record else 0
                calls[spec.arm][name] += max(1.0, usual_prompts(arm) - answered)
    facts = earlier_answers(plan, cache)
    expected = estimate(
        plan,
        options,
        trials=trials,
        stored=0 if whole else len(session.stored),
        calls=calls,
        facts=facts,
        latencies_s=usual_latencies_s(plan, cache, facts),
    )
    ledger = session.ledger
    if ledger.cap is None or whole:
        return expected
    ledger.read()
    return replace(expected, left_usd=max(0.0, ledger.left_usd), cap_source=ledger.cap.source)


async def unsent(
    plan: Plan, options: Options, *, say: Callable[[str], None], whole: bool = False
) -> Estimate:
    """Return the estimate of a run, without creating a database or a cache.

    ``whole``: as if nothing were stored or recorded.
    """
    with tempfile.TemporaryDirectory() as folder:
        db = options.db if options.db.is_file() else Path(folder) / "none.duckdb"
        has_cache = (options.cache / "cache.db").is_file()
        cache = options.cache if has_cache else Path(folder) / "responses"
        options = replace(options, db=db, cache=cache, dry_run=True)
        async with open_session(plan, options, say=say) as session:
            return await estimate_rest(session, whole=whole)


def _has_replies(cache: ResponseCache, plan: Plan) -> bool:
    """Return whether a plan's models are recorded; True for damaged replies, or without a model."""
    models = {entry.id or UNNAMED for entry in plan.entries.values()}
    if not models or any(call.request.model in models for call in cache.newest(1)):
        return True  # without counting all replies
    _, counts = answer_counts(cache)
    are_damaged = cache.number > sum(answers.answers for answers in counts.values())
    return any(template.model in models for template in counts) or are_damaged


def _recorded_part(plan: Plan, recordings: Sequence[Path]) -> Plan:
    """Return the part of a plan that recordings hold.

    It is the whole plan if they do not name its sweep, or hold none of its trials. A sweep of first
    decisions can be played from the recording of the whole study, too.
    """
    from merge_runner.results.recorded_sweeps import recorded_part

    names = {plan.study.name, plan.name}
    available = recorded_part(recordings, names, plan.model, plan.sample_set)
    if available is None:
        return plan
    arms = []
    for arm in plan.arms:
        most = available.repetitions.get(arm.variant)
        if most and (not available.arms or arm.label in available.arms):
            arms.append(replace(arm, repetitions=min(arm.repetitions, most)))
    conditions = tuple(name for name in plan.conditions if name in available.conditions)
    part = plan.model_copy(update={"arms": tuple(arms), "conditions": conditions})
    return part if part.trials else plan
