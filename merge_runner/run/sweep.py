"""The composition root: wires drivers, clients, store and display, and runs a sweep."""

from __future__ import annotations

import asyncio
import secrets
import tempfile
from collections import Counter
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import (
    AsyncExitStack,
    asynccontextmanager,
    closing,
)
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from merge_runner.audit.checks import Audit, audit_sweep
from merge_runner.config import (
    UNNAMED,
    base_urls,
    resolve_endpoint,
)
from merge_runner.errors import (
    MergeRunnerError,
    NoValidDecision,
    StoreError,
    TrialSuspended,
)
from merge_runner.llm.batch.rounds import Rounds
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.kinds import counted
from merge_runner.llm.ledger import Ledger, scopes
from merge_runner.paths import DEFAULT_DB, SHIPPED_RECORDINGS, command_at
from merge_runner.records import ReplayMiss, TrialRecord, TrialSpec, canonical_json
from merge_runner.registry import using
from merge_runner.results.database import in_thread, unreadable_is_usage
from merge_runner.results.provenance import git_state, versions
from merge_runner.results.recording import Miss, described, explain, recorded_part, spilled
from merge_runner.results.store import Store, sweep_facts
from merge_runner.run.clients import check_batches, live_clients, open_rounds
from merge_runner.run.cluster import ClusterRunner
from merge_runner.run.cluster_chunk import RunSetup
from merge_runner.run.cluster_connection import connected
from merge_runner.run.estimate import Estimate, earlier_answers, estimate, usual_latencies_s
from merge_runner.run.guard import MOST_INVALID, FirstDecisions
from merge_runner.run.interrupt import GO_ON, INTERRUPTED, NEVER, Stopping
from merge_runner.run.local_runner import LocalRunner
from merge_runner.run.plan import Options, Plan, usual_prompts
from merge_runner.run.progress import REASONS_SHOWN, Progress, show_progress
from merge_runner.run.progress_file import write_snapshot
from merge_runner.run.replay import Replay
from merge_runner.run.served_names import with_names
from merge_runner.run.stored_replay import refuse_changed_programs
from merge_runner.run.summary import as_dict
from merge_runner.run.trials import Player
from merge_runner.run.writer import AGAIN, BATCH, Flusher
from merge_runner.text_safety import first_of

SHOWN = 5
# Trials under way in a batch run.
MOST_IN_ROUNDS = 10_000


async def play(
    plan: Plan,
    options: Options,
    *,
    whole: bool,
    say: Callable[[str], None],
    agree: Callable[[Estimate], None],
    stopping: Stopping = NEVER,
) -> dict[str, Any]:
    """Play what is not stored yet of a plan, and return the summary (``summary.as_dict``).

    A replay without a recording, or replies of the models in the cache, is of the recording that
    ships with the program; one that is not ``whole`` plays what its recordings hold. ``agree`` gets
    an estimate before money is spent, and raises where it is not to be. ``stopping`` says who stops
    it; a task that is cancelled saves what is paid for before it ends. Raises UsageError.
    """
    if options.replay:
        shipped = SHIPPED_RECORDINGS / f"{plan.model}-{plan.study.name}.parquet"
        if not options.recordings and shipped.is_file():
            with closing(ResponseCache(options.cache)) as cache:
                has_replies = _has_replies(cache, plan)
            if not has_replies:  # a user's own are never mixed with those of somebody else
                options = replace(options, recordings=(shipped,))
                say(f"The replies are from the recording that ships with merge-runner: {shipped}")
        part = plan if whole else _recorded(plan, options.recordings)
        if part.trials < plan.trials:
            say(f"note: the recording holds {part.trials} of the plan's {plan.trials} trials")
        plan = part
    with using(plan.parts.catalogue):  # it has the study's own wire formats and providers
        async with open_sweep(plan, options, say=say) as sweep:
            expected = None
            if sweep.todo and not (options.replay or plan.is_free):
                expected = await sweep.estimate()
                agree(expected)
            return await sweep.run(expected, stopping)


def _has_replies(cache: ResponseCache, plan: Plan) -> bool:
    """Whether a model of a plan is recorded, or it has none; what is damaged may be of it."""
    models, (_, kinds) = {entry.id or UNNAMED for entry in plan.entries.values()}, counted(cache)
    whole = sum(answers.answers for answers in kinds.values())
    return any(kind.model in models for kind in kinds) or cache.number > whole or not models


def _misses(record: TrialRecord) -> list[Miss]:
    missed = [call.request for call in record.failed_calls if call.missed]
    return [Miss(record.spec.trial_id, request) for request in missed]


def _recorded(plan: Plan, recordings: Sequence[Path]) -> Plan:
    """The part of a plan that recordings of the same sweep hold; all of it if they do not say.

    A sweep's recording holds its first situations, too.
    """
    names = {plan.study.name, plan.name}
    held = recorded_part(recordings, names, plan.model, plan.sample_set)
    if held is None:
        return plan
    arms = tuple(
        replace(arm, repetitions=min(arm.repetitions, held.repetitions[arm.variant]))
        for arm in plan.arms
        if held.repetitions.get(arm.variant) and (not held.arms or arm.label in held.arms)
    )
    conditions = tuple(one for one in plan.conditions if one in held.conditions)
    part = plan.model_copy(update={"arms": arms, "conditions": conditions})
    return part if part.trials else plan


@dataclass
class Sweep:
    """One run of a plan (see ``open_sweep``), which plays the trials ``todo``.

    ``exit_code`` is that of the first problem, ``messages`` are of all.
    """

    _plan: Plan
    _options: Options
    _cache: ResponseCache
    _stored: list[TrialSpec]
    todo: list[TrialSpec]
    _say: Callable[[str], None]
    _ledger: Ledger
    exit_code: int = 0
    messages: list[str] = field(default_factory=list)
    _rounds: Rounds | None = None
    _stopping: Stopping = NEVER
    _cancelled: bool = False

    async def run(
        self, expected: Estimate | None = None, stopping: Stopping = NEVER
    ) -> dict[str, Any]:
        """Play what is missing and store it; what goes wrong is in the summary.

        ``expected`` is an estimate that the user has agreed to.
        """
        self._stopping = stopping
        db, sweep_id, checked = self._options.db, "", None
        replay = Replay(self._plan, self._cache)
        ahead = await replay.look_ahead(self.todo) if self._options.replay else []
        if missing := [miss for record in ahead for miss in _misses(record)]:
            progress = self._progress(replay)
            held = described(self._options.recordings, self._cache.entries())
            nothing = f"nothing of this replay is recorded, and nothing is stored: {held}"
            self._explain(missing)
            self.messages.append(nothing)
        else:
            async with AsyncExitStack() as stack:
                store = Store(db)
                live = bool(self._plan.entries) and not self._options.sends_nothing
                progress = self._progress(await self._live(store, stack) if live else replay)
                with unreadable_is_usage():
                    sweep_id = await self._begin(store)
                shown = show_progress(progress, db, sweep_id, quiet=self._options.quiet)
                await stack.enter_async_context(shown)
                is_stored = await self._play(progress, Flusher(store, sweep_id, self._say))
                progress.doing = "checking"
                write_snapshot(db, progress.snapshot(sweep_id))
                if is_stored:
                    self._end(store, sweep_id)
                    checked = await self._check(store, sweep_id, progress.runner.first)
        if self._cancelled:
            raise asyncio.CancelledError
        return as_dict(
            self._options, progress, expected, checked,
            sweep_id=sweep_id, exit_code=self.exit_code, messages=self.messages,
        )  # fmt: skip

    def _explain(self, misses: list[Miss]) -> None:
        left_out: list[str] = []
        for line in explain(misses, self._cache.entries(left_out)) if misses else ():
            self._fail(ReplayMiss.exit_code, line)
        if left_out:
            number = len(left_out)
            self.messages.append(f"{number} rows of the cache are left out, one: {left_out[0]}")

    def _progress(self, runner: Player) -> Progress:
        return Progress(
            plan=self._plan,
            planned=len(self._stored) + len(self.todo),
            todo=Counter(spec.arm for spec in self.todo),
            stored=len(self._stored),
            runner=runner,
            ledger=self._ledger,
            cap_usd=self._options.max_cost_usd,
            batches=self._rounds.standing if self._rounds else list,
        )

    def _fail(self, exit_code: int, message: str) -> None:
        self.exit_code = self.exit_code or exit_code
        self.messages.append(message)

    def _fail_by(self, error: BaseException | None) -> None:
        """Note an error that a user can act on; raises any other one."""
        if isinstance(error, MergeRunnerError):
            self._fail(error.exit_code, str(error))
        elif error is not None:
            raise error

    async def estimate(self, *, whole: bool = False) -> Estimate:
        """What a live run takes: plays from recorded replies alone, and counts what is missing.

        ``whole``: what all trials take, as if none were stored or recorded yet.
        """
        trials = 0
        arms = self._plan.by_label()
        calls = {label: dict.fromkeys(arm.entries, 0.0) for label, arm in arms.items()}
        replay = Replay(self._plan, self._cache)
        for spec in [*self._stored, *self.todo] if whole else self.todo:
            await asyncio.sleep(0)  # another study of this process goes on
            arm = arms[spec.arm]
            record = replay.play_one(spec) if arm.entries and not whole else None
            if record is not None and record.status != "failed":
                continue
            trials += 1
            for side, name in arm.asked.items():
                if name in arm.entries:
                    answered = sum(row.side == side for row in record.decisions) if record else 0
                    calls[spec.arm][name] += max(1.0, usual_prompts(arm) - answered)
        facts = earlier_answers(self._plan, self._cache)
        expected = estimate(
            self._plan,
            self._options,
            trials=trials,
            stored=0 if whole else len(self._stored),
            calls=calls,
            facts=facts,
            latencies_s=usual_latencies_s(self._plan, self._cache, facts),
        )
        cap_usd = self._options.max_cost_usd
        if cap_usd is None or whole:
            return expected
        self._ledger.read()
        return replace(expected, left_usd=max(0.0, cap_usd - self._ledger.committed_usd))

    async def _begin(self, store: Store) -> str:
        started_at = datetime.now(UTC).replace(tzinfo=None)
        commit, dirty = await asyncio.to_thread(git_state)
        sweep_id = f"{self._plan.name}-{self._plan.model}-{started_at:%Y%m%dT%H%M%S%f}"
        row = {
            "sweep_id": sweep_id,
            "name": self._plan.name,
            "started_at": started_at,
            "config": canonical_json(
                {
                    **self._plan.model_dump(mode="json"),
                    "max_cost_usd": self._options.max_cost_usd,
                    "typed": self._options.typed,
                    **({"run_name": name} if (name := self._options.name) else {}),
                }
            ),
            "git_commit": commit,
            "git_dirty": dirty,
            "versions": canonical_json(versions()),
        }
        store.begin_sweep(row, self._plan.specs(), self._stored)
        return sweep_id

    async def _live(self, store: Store, stack: AsyncExitStack) -> Player:
        """What plays trials that may ask models: this process, or the workers of a cluster."""
        plan, options = self._plan, self._options
        earlier = earlier_answers(plan, self._cache)
        self._rounds = rounds = open_rounds(plan, options, self._cache, self._say)
        first = FirstDecisions()
        if not options.keep_going:
            first = FirstDecisions(MOST_INVALID, one_by_one=rounds is None)
            labels = plan.by_label()
            arms = {spec.spec_hash: labels[spec.arm] for spec in self._stored}
            for spec_hash, side, *decisions in store.decisions_by_spec(arms) if arms else ():
                if (model := arms[spec_hash].asked[side]) in plan.entries:
                    first.add(model, *decisions)
        if options.dask is not None:
            client = await stack.enter_async_context(connected(options.dask))
            urls = base_urls(plan.entries)
            setup = RunSetup(secrets.token_hex(), plan, options, earlier, first, urls)
            return ClusterRunner(client, setup, self._ledger)
        clients = live_clients(
            plan, options, earlier, self._cache, self._ledger, stack=stack, rounds=rounds
        )
        if rounds is not None:
            stack.push_async_callback(rounds.close)
        # A trial that waits for a round takes up nobody's time, but memory.
        in_flight = MOST_IN_ROUNDS if options.batch else options.in_flight
        return LocalRunner(plan, clients, in_flight, first, rounds)

    async def _play(self, progress: Progress, flusher: Flusher) -> bool:
        """Run the trials until all have ended, or the sweep is stopped or interrupted; store them.

        False where Ctrl-C ended the waiting for a database that another program holds.
        """
        runner, counts, suspended = progress.runner, progress.outcome_counts, ""
        misses: list[Miss] = []
        waiting = Counter[str](dict.fromkeys(map(_played_as, self.todo), 0))
        progress.unstored = lambda: flusher.problem

        def ended(spec: TrialSpec, record: TrialRecord | TrialSuspended) -> None:
            nonlocal suspended
            if isinstance(record, TrialSuspended):
                counts["suspended"] += 1
                waiting[_played_as(spec)] += 1
                suspended = str(record)
            else:
                counts[record.status] += 1
                progress.done[spec.arm] += 1
                misses.extend(_misses(record))
                flusher.add(record)

        async def drained() -> None:
            await asyncio.wait([work])
            await runner.drain()

        # Two tasks, since Ctrl-C stops the trials but lets the calls that are paid for end.
        work = asyncio.create_task(runner.play(self.todo, ended, room=flusher.room))
        flusher.on_break = work.cancel  # no money is spent on what cannot be stored
        drain = asyncio.create_task(drained())

        def interrupted() -> None:
            work.cancel()  # before anything is written: the terminal may be closed
            self._say(f"Stopping: {runner.unsaved} are saved first; Ctrl-C again drops them.")

        try:
            with self._stopping(interrupted, drain.cancel):
                try:
                    await asyncio.wait([drain])
                except asyncio.CancelledError:  # by whoever runs this task
                    self._cancelled = True
                    interrupted()
                    await asyncio.wait([drain])
                finally:
                    drain.cancel()
                await asyncio.wait([work])
            if not work.cancelled():
                self._fail_by(work.exception())
            elif not flusher.broken:  # whose error is told below
                self._fail(INTERRUPTED, f"Interrupted. {GO_ON}")
            if suspended:
                self._fail(
                    TrialSuspended.exit_code,
                    f"{counts['suspended']} trials wait for money{_unbalanced(waiting)}: "
                    f"{suspended}. Their replies are kept: raise --max-cost, or the study's "
                    "budget, and run the same command again",
                )
        finally:
            progress.ended_at = datetime.now(UTC)
            is_stored = await self._store_rest(flusher)
        self._explain(misses)
        if counts["failed"] and not misses:
            self._fail(1, f"{counts['failed']} trials failed")
        return is_stored

    async def _store_rest(self, flusher: Flusher) -> bool:
        """Store what is not stored yet; False where Ctrl-C ended the waiting for that."""
        closing = asyncio.create_task(self._store_all(flusher))
        with self._stopping(None, closing.cancel):
            try:
                await asyncio.wait([closing])
            finally:
                closing.cancel()
        if closing.cancelled():
            why = f": {flusher.problem}. {AGAIN}" if flusher.problem else ". " + GO_ON
            self._fail(INTERRUPTED, f"Interrupted{why}")
            return False
        self._fail_by(closing.exception())
        if flusher.differing:
            differing = [*flusher.differing.items()][:SHOWN]
            shown = [f"{trial_id} ({', '.join(columns)})" for trial_id, columns in differing]
            self._fail(
                StoreError.exit_code,
                f"{len(flusher.differing)} trials are stored otherwise in {self._options.db}, "
                f"which is left as it is: {'; '.join(shown)}. Replay into another --db.",
            )
        return True

    async def _store_all(self, flusher: Flusher) -> None:
        """Store the trials in memory, and play those again that were dropped: without a call."""
        await flusher.close()
        if flusher.dropped:
            self._say(
                f"{len(flusher.dropped)} trials that are not stored yet are played again from the "
                "recorded replies, without a call; Ctrl-C leaves them to the next run"
            )
        while flusher.dropped:
            again, flusher.dropped = flusher.dropped[:BATCH], flusher.dropped[BATCH:]
            replay = Replay(self._plan, self._cache)
            await replay.play(again, lambda _, record: flusher.add(record))
            await flusher.close()

    def _end(self, store: Store, sweep_id: str) -> None:
        """Note that the run has ended, and how."""
        try:
            store.end_sweep(sweep_id, datetime.now(UTC).replace(tzinfo=None), self.exit_code)
        except StoreError as exc:
            self._fail_by(exc)

    async def _check(
        self, store: Store, sweep_id: str, first: FirstDecisions
    ) -> tuple[dict[str, Any], Audit] | None:
        """Read back what the database holds of the run, which has ended, and audit it."""
        keys = [(spec.trial_id, spec.spec_hash) for spec in (*self._stored, *self.todo)]
        ended_with, checked = self.exit_code, None
        audited = partial(audit_sweep, store.path, sweep_id, keys, finished=self.exit_code == 0)
        try:
            if not self._options.replay:
                self._ledger.read()
            facts = await in_thread(partial(sweep_facts, store.path, sweep_id))
            audit = await in_thread(audited)
            checked = facts, audit
            if not (self.exit_code or self._options.sends_nothing or self._options.keep_going):
                for line in first.without_a_valid_one():
                    self._fail(NoValidDecision.exit_code, line)
            # Answers from another model are reported elsewhere; only --strict-model stops for them.
            findings = [f for f in audit.findings if f.kind != "served"]
            if findings:
                audit_it = command_at("merge-runner audit", "--db", store.path, DEFAULT_DB)
                self._fail(1, f"the audit found {len(findings)} faults: `{audit_it}`")
            self.messages += map(str, findings[:SHOWN])
        except MergeRunnerError as exc:
            self._fail_by(exc)
        if self.exit_code != ended_with:
            self._end(store, sweep_id)
        return checked


@asynccontextmanager
async def open_sweep(
    plan: Plan, options: Options, *, say: Callable[[str], None]
) -> AsyncIterator[Sweep]:
    """Open the cache, and the database unless it is a replay, and find out what is missing.

    Asks a server of one's own what its model is called, and locks the models that a live run is to
    ask. ``say`` shows a line to the user. Raises UsageError.
    """
    check_batches(plan, options)
    if options.max_cost_usd is None:
        options = replace(options, max_cost_usd=plan.study.file.budget.get("total_usd"))
    recorded = partial(spilled, options.recordings) if options.recordings else None
    with closing(ResponseCache(options.cache, overlay=recorded)) as cache:
        plan = await with_names(plan, options, cache, say)
        specs = {(spec.trial_id, spec.spec_hash): spec for spec in plan.trial_specs()}
        # A replay derives everything from the recorded replies alone, so it plays every trial.
        with unreadable_is_usage():
            ended = set() if options.replay else Store(options.db).ended_trials(specs)
            stored = [spec for key, spec in specs.items() if key in ended]
            refuse_changed_programs(options.db, plan, stored)
        todo = [spec for key, spec in specs.items() if key not in ended]
        others: list[str] = []
        if todo and not options.sends_nothing:
            if options.dask is None:
                for name, entry in plan.entries.items():
                    resolve_endpoint(name, entry)  # raises where its key is missing
            others = _others_under_the_cap(plan, options, cache, say)
            asked = plan.entries.items()
            cache.locks.take({f"{e.id} at {plan.endpoints[name]}" for name, e in asked})
        ledger = Ledger(cache, plan.ledger, others)
        yield Sweep(plan, options, cache, stored, todo, say, ledger)


def _others_under_the_cap(
    plan: Plan, options: Options, cache: ResponseCache, say: Callable[[str], None]
) -> list[str]:
    """The other ledgers whose money counts under the cap, where there is one and they hold any.

    They are those of sweeps that share the cap, and others of this study: it was run before its
    file had a budget, or has none any more.
    """
    if options.max_cost_usd is None:
        return []
    own, study = plan.ledger, plan.study.name
    others = [
        scope
        for scope in scopes(cache)
        if scope != own
        and (scope in options.ledgers or (study in (own, scope) and scope.split("/")[0] == study))
    ]
    if spent_usd := sum(Ledger(cache, scope).read().committed_usd for scope in others):
        say(f"{spent_usd:.4f} USD of {', '.join(others)} count against the budget, too")
    return others


def _played_as(spec: TrialSpec) -> str:
    """The drivers and the prompt of a trial, as its name begins."""
    name = spec.trial_id.rsplit("/", 2)[0]
    return name.removeprefix("seat/") if spec.source == "first_decision" else name


def _unbalanced(waiting: Counter[str]) -> str:
    """How many trials of each arm wait, where they are not as many of each."""
    if len({*waiting.values()}) <= 1:
        return ""
    parts = first_of(
        [f"{number} of {name}" for name, number in waiting.items()], "others", REASONS_SHOWN
    )
    return f" ({', '.join(parts)}: what has ended is not balanced)"


async def unsent(
    plan: Plan, options: Options, *, say: Callable[[str], None], whole: bool = False
) -> Estimate:
    """What is neither stored nor recorded yet; makes no database or cache that is not there.

    ``whole``: as if nothing were stored or recorded.
    """
    with tempfile.TemporaryDirectory() as folder:
        db = options.db if options.db.is_file() else Path(folder) / "none.duckdb"
        recorded = (options.cache / "cache.db").is_file()
        cache = options.cache if recorded else Path(folder) / "responses"
        options = replace(options, db=db, cache=cache, dry_run=True)
        with using(plan.parts.catalogue):
            async with open_sweep(plan, options, say=say) as sweep:
                return await sweep.estimate(whole=whole)
