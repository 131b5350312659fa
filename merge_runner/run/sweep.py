"""The composition root: wires drivers, clients, store and display, and runs a sweep."""

from __future__ import annotations

import asyncio
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterable, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, closing
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

from merge_runner.audit.checks import audit_sweep
from merge_runner.audit.findings import Audit
from merge_runner.config import ModelEntry, model_id, resolve_endpoint
from merge_runner.errors import (
    MergeRunnerError,
    NoValidDecision,
    ReplayMiss,
    StoreError,
    TrialSuspended,
    UsageError,
)
from merge_runner.llm.batch.rounds import Rounds
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.call_totals import CallTotals, call_totals
from merge_runner.llm.content_hashes import canonical_json, manner
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.ledger import Ledger, Spending, scopes
from merge_runner.llm.meter import Meter
from merge_runner.records import DecisionRow, TrialRecord, TrialSpec
from merge_runner.results.database import unreadable_is_usage
from merge_runner.results.progress_file import ProgressFile
from merge_runner.results.provenance import git_state, versions
from merge_runner.results.recorded_study import described
from merge_runner.results.recording import Spilled
from merge_runner.results.rows import factor_rows
from merge_runner.results.store import Store, SweepFacts, SweepRow, sweep_facts
from merge_runner.run.clients import (
    check_batches,
    endpoint_plan,
    live_clients,
    open_rounds,
    sealed_clients,
)
from merge_runner.run.estimate import Estimate, estimate
from merge_runner.run.first_decisions import MOST_INVALID, FirstDecisions
from merge_runner.run.flusher import AGAIN, BATCH, BATCH_OF_REPLAY, MOST_HELD, Flusher
from merge_runner.run.local_runner import LocalRunner
from merge_runner.run.model_names import recorded_name, served_name
from merge_runner.run.plan import Options, Plan, usual_prompts
from merge_runner.run.progress import Progress, display_progress, publish_progress
from merge_runner.run.replay_diagnosis import Miss, explain
from merge_runner.signals import on_interrupt

if TYPE_CHECKING:
    from merge_runner.run.dask_tasks import DaskTasks

INTERRUPTED = 130
GO_ON = "Run the same command again to go on."
SHOWN = 5
FROM_PROGRAMS = 16


@dataclass(slots=True)
class Outcome:
    """What a run of a plan did.

    ``stored_before`` trials were not played because they were stored already; ``suspended`` ones
    wait for money, and their replies are in the cache. ``meter`` counts the calls of this run,
    ``spending`` is that of the sweep over all its runs, and ``cache_cost_usd`` that of
    all sweeps on the cache. ``facts`` summarises what the database holds of the sweep,
    and ``audit`` the checks made there; both are None where nothing is stored, or its user
    ``gave_up`` waiting for the database. ``batches`` are those that go on without this run.
    ``playing_s`` is how long the trials took, ``worst_stall_s`` the longest delay of the event
    loop.
    """

    plan: Plan
    sweep_id: str
    stored_before: int
    exit_code: int = 0
    messages: list[str] = field(default_factory=list)
    meter: Meter = field(default_factory=Meter)
    suspended: int = 0
    spending: Spending = field(default_factory=Spending)
    cache_cost_usd: float = 0.0
    facts: SweepFacts | None = None
    audit: Audit | None = None
    gave_up: bool = False
    batches: list[str] = field(default_factory=list)
    playing_s: float = 0.0
    worst_stall_s: float = 0.0

    def fail(self, exit_code: int, message: str) -> None:
        """Note a problem; the first one decides the exit code."""
        self.exit_code = self.exit_code or exit_code
        self.messages.append(message)

    def fail_by(self, error: BaseException | None) -> None:
        """Note an error that a user can act on; raises any other one."""
        if isinstance(error, MergeRunnerError):
            self.fail(error.exit_code, str(error))
        elif error is not None:
            raise error


@dataclass
class Sweep:
    """One run of a plan (see ``open_sweep``), which plays the trials ``todo``."""

    _plan: Plan
    _options: Options
    _cache: ResponseCache
    _stored: list[TrialSpec]
    _todo: list[TrialSpec]
    _say: Callable[[str], None]
    _misses: list[Miss] = field(default_factory=list)
    _suspended: TrialSuspended | None = None
    _rounds: Rounds | None = None

    def __post_init__(self) -> None:
        """Nobody plays yet."""
        self._arms = self._plan.by_label()
        self._ledger = Ledger(self._cache, self._plan.ledger)
        self._progress = Progress(
            plan=self._plan,
            planned=len(self._stored) + len(self._todo),
            stored=len(self._stored),
            runner=LocalRunner(self._plan, {}, in_flight=0),
            ledger=self._ledger,
            cap_usd=self._options.max_cost_usd,
        )

    @property
    def trials_to_play(self) -> int:
        """How many trials are not stored yet."""
        return len(self._todo)

    async def run(self) -> Outcome:
        """Play what is missing and store it; what goes wrong is in the outcome."""
        # Git is another process, and takes as long as it takes to make a database.
        source = asyncio.get_running_loop().run_in_executor(None, git_state)
        if self._options.replay and (misses := await self._all_missing()):
            return self._not_recorded(misses)
        with unreadable_is_usage():
            store = self._store
            sweep_id = self._begin(store, *await source)
        file = ProgressFile(self._options.db, sweep_id)
        async with publish_progress(self._progress, file):
            outcome = await self._run(sweep_id)
            self._progress.doing = "checking"
            file.write(self._progress.standing(sweep_id))
            if not outcome.gave_up:
                self._end(outcome)
        return outcome

    @cached_property
    def _store(self) -> Store:
        return Store(self._options.db)

    async def _all_missing(self) -> list[Miss]:
        """The first calls of all trials if none is recorded; else nothing."""
        runner = LocalRunner(self._plan, sealed_clients(self._plan, self._cache), in_flight=1)
        misses: list[Miss] = []
        for spec in self._todo:
            misses += _misses(spec, await runner.play_one(spec))
            if any(meter.calls_cached for meter in runner.meters.values()):
                return []
        return misses

    def _not_recorded(self, misses: list[Miss]) -> Outcome:
        """The outcome of a replay that stores nothing, since it has none of its calls."""
        outcome = Outcome(self._plan, "", 0)
        self._explain(misses, outcome)
        held = described(self._options.recordings, self._cache.entries())
        outcome.messages.append(
            f"nothing of this replay is recorded, and nothing is stored: {held}"
        )
        return outcome

    async def _run(self, sweep_id: str) -> Outcome:
        """Play what is missing and store it."""
        outcome = Outcome(self._plan, sweep_id, len(self._stored))
        async with AsyncExitStack() as stack:
            runner = await self._runner(stack)
            self._progress.runner = runner
            batch = BATCH_OF_REPLAY if self._options.replay else BATCH
            flusher = Flusher(self._store, outcome.sweep_id, self._say, batch)
            self._progress.unstored = lambda: flusher.problem
            began = time.perf_counter()
            try:
                async with display_progress(self._progress, quiet=self._options.quiet):
                    await self._play(runner, flusher, outcome)
            finally:
                outcome.playing_s = time.perf_counter() - began
                outcome.worst_stall_s = self._progress.worst_stall_s
                await self._store_rest(flusher, outcome)
            self._explain(self._misses, outcome)
            try:
                ledgers = (Ledger(self._cache, scope) for scope in scopes(self._cache))
                outcome.cache_cost_usd = sum(ledger.read().spent_usd for ledger in ledgers)
                outcome.spending = self._ledger.read()
            except MergeRunnerError as exc:
                if self._options.replay:  # which spends nothing
                    outcome.messages.append(str(exc))
                else:
                    outcome.fail_by(exc)
        for meter in runner.meters.values():
            outcome.meter.add(meter)
        counts = self._progress.outcome_counts
        outcome.suspended = counts["suspended"]
        if self._suspended:
            outcome.fail(
                TrialSuspended.exit_code,
                f"{outcome.suspended} trials wait for money: {self._suspended}. Their "
                "replies are kept: raise --max-cost, or the study's budget, and run it again",
            )
        if counts["failed"] and not self._misses:
            outcome.fail(1, f"{counts['failed']} trials failed")
        return outcome

    async def estimate(self, *, whole: bool = False) -> Estimate:
        """What a live run takes: plays from recorded replies alone, and counts what is missing.

        ``whole``: what all trials take, as if none were stored or recorded yet.
        """
        trials: Counter[str] = Counter()
        calls = {label: dict.fromkeys(arm.entries, 0.0) for label, arm in self._arms.items()}

        def count(spec: TrialSpec, decisions: Sequence[DecisionRow] = ()) -> None:
            arm = self._arms[spec.arm]
            trials[spec.arm] += 1
            for side, name in arm.asked.items():
                if name in arm.entries:
                    answered = sum(row.side == side for row in decisions)
                    calls[spec.arm][name] += max(1.0, usual_prompts(arm) - answered)

        if whole:
            for spec in [*self._stored, *self._todo]:
                count(spec)
        else:
            clients = sealed_clients(self._plan, self._cache)
            runner = LocalRunner(self._plan, clients, in_flight=1)
            for spec in self._todo:
                if not self._arms[spec.arm].entries:
                    count(spec)
                elif (record := await runner.play_one(spec)).status == "failed":
                    count(spec, record.decisions)
        return estimate(
            self._plan,
            self._options,
            trials=trials,
            calls=calls,
            facts=self._measured(),
            spending=self._ledger.spending,
        )

    def _measured(self) -> dict[str, CallTotals]:
        """What is known about each model's answers to requests like those of this sweep."""
        facts = {}
        for name, entry in self._plan.entries.items():
            sent = FORMATS[entry.format].request(entry, "")
            asked = manner(sent.path, canonical_json(sent.body))
            place = entry.id, self._plan.endpoints[name], asked
            facts[name] = self._totals.get(place, CallTotals())
        return facts

    @cached_property
    def _totals(self) -> dict[tuple[str, str, str], CallTotals]:
        """What the recorded calls took, by model, endpoint and how it was asked."""
        return call_totals(self._cache.entries())

    def _explain(self, misses: list[Miss], outcome: Outcome) -> None:
        if not misses:
            return
        left_out: list[str] = []
        for line in explain(misses, self._cache.entries(left_out)):
            outcome.fail(ReplayMiss.exit_code, line)
        if left_out:
            outcome.messages.append(
                f"{len(left_out)} rows of the cache are left out of this, the first: {left_out[0]}"
            )

    def _begin(self, store: Store, commit: str, dirty: bool | None) -> str:
        """Add the sweep to the database, with the trials that are stored already."""
        started_at = datetime.now(UTC).replace(tzinfo=None)
        sweep_id = f"{self._plan.name}-{self._plan.model}-{started_at:%Y%m%dT%H%M%S%f}"
        config = {**self._plan.model_dump(mode="json"), "max_cost_usd": self._options.max_cost_usd}
        store.begin_sweep(
            SweepRow(
                sweep_id=sweep_id,
                name=self._plan.name,
                started_at=started_at,
                config=canonical_json(config),
                git_commit=commit,
                git_dirty=dirty,
                versions=canonical_json(versions()),
            ),
            self._plan.specs(),
            [(spec.trial_id, spec.spec_hash) for spec in self._stored],
            [row for spec in self._stored for row in factor_rows(spec)],
        )
        return sweep_id

    async def _runner(self, stack: AsyncExitStack) -> LocalRunner | DaskTasks:
        """What plays the trials: this process, or the workers of a cluster."""
        plan, options = self._plan, self._options
        if options.sends_nothing or not plan.entries:
            clients = sealed_clients(plan, self._cache)
            # Recorded replies come at once: more trials in flight would only wait for each other.
            in_flight = 1 if plan.entries else min(options.in_flight, FROM_PROGRAMS)
            return LocalRunner(plan, clients, in_flight)
        answered = {(model, endpoint) for model, endpoint, _ in self._totals}
        known = frozenset(
            name
            for name, entry in plan.entries.items()
            if (entry.id, plan.endpoints[name]) in answered
        )
        endpoints = endpoint_plan(plan, options, known, self._measured())
        self._rounds = rounds = open_rounds(plan, options, self._cache, self._say)
        first = self._first_decisions(one_by_one=rounds is None)
        if options.dask is not None:
            from merge_runner.run.dask_cluster import connected

            client = await stack.enter_async_context(connected(options.dask))
            from merge_runner.run.dask_tasks import DaskTasks  # imports Dask

            return DaskTasks(client, plan, options, endpoints, self._cache, self._ledger, first)
        clients = live_clients(
            plan, options, endpoints, self._cache, self._ledger, stack=stack, rounds=rounds
        )
        if rounds is not None:
            stack.push_async_callback(rounds.close)
            self._progress.batches = rounds.standing
        # A trial that waits for a round takes up nobody's time.
        in_flight = len(self._todo) if options.batch else options.in_flight
        return LocalRunner(plan, clients, in_flight, first)

    async def _play(
        self, runner: LocalRunner | DaskTasks, flusher: Flusher, outcome: Outcome
    ) -> None:
        """Run the trials until all have ended, or the sweep is stopped or interrupted."""

        def ended(spec: TrialSpec, record: TrialRecord | TrialSuspended) -> None:
            if isinstance(record, TrialSuspended):
                self._progress.outcome_counts["suspended"] += 1
                self._suspended = record
                return
            self._progress.outcome_counts[record.status] += 1
            self._misses += _misses(spec, record)
            flusher.add(record)

        # Two tasks, since Ctrl-C stops the trials but lets the calls that are paid for end.
        work = asyncio.create_task(runner.play(self._todo, ended, room=flusher.room))
        drain = asyncio.create_task(_drained(runner, work))

        def interrupted() -> None:
            work.cancel()  # before anything is written: the terminal may be closed
            self._say(f"Stopping: {runner.unsaved} are saved first; Ctrl-C again drops them.")

        beside = []
        if self._rounds is not None and isinstance(runner, LocalRunner):
            watching = asyncio.create_task(self._rounds.watch(lambda: runner.is_idle))
            watching.add_done_callback(lambda _: work.cancel())  # nobody would close a round
            beside = [watching]
        with on_interrupt(interrupted, drain.cancel):
            await asyncio.wait([drain])
            await asyncio.wait([work])
        for task in beside:
            task.cancel()
        for error in await asyncio.gather(*beside, return_exceptions=True):
            if isinstance(error, Exception):
                raise error
        if self._rounds is not None:
            outcome.batches = self._rounds.standing()
        if work.cancelled():
            outcome.fail(INTERRUPTED, f"Interrupted. {GO_ON}")
        else:
            outcome.fail_by(work.exception())

    async def _store_rest(self, flusher: Flusher, outcome: Outcome) -> None:
        """Store what has ended and is not stored yet; Ctrl-C ends the waiting for that."""
        closing = asyncio.create_task(self._store_all(flusher))
        with on_interrupt(closing.cancel, closing.cancel):
            await asyncio.wait([closing])
        if closing.cancelled():
            outcome.gave_up = True
            why = f": {flusher.problem}. {AGAIN}" if flusher.problem else ". " + GO_ON
            outcome.fail(INTERRUPTED, f"Interrupted{why}")
        elif error := closing.exception():
            outcome.fail_by(error)
        elif flusher.differing:
            outcome.fail(
                StoreError.exit_code,
                f"{len(flusher.differing)} trials are stored otherwise in {self._options.db}, "
                f"which is left as it is: {_differing(flusher.differing)}. Replay into "
                "another --db.",
            )

    async def _store_all(self, flusher: Flusher) -> None:
        """Store the trials in memory, and play those again that were dropped: without a call."""
        await flusher.close()
        if flusher.dropped:
            self._say(
                f"{len(flusher.dropped)} trials that are not stored yet are played again from the "
                "recorded replies, without a call; Ctrl-C leaves them to the next run"
            )
        while flusher.dropped:
            again, flusher.dropped = flusher.dropped[:MOST_HELD], flusher.dropped[MOST_HELD:]
            clients = sealed_clients(self._plan, self._cache)
            runner = LocalRunner(self._plan, clients, in_flight=1)
            for spec in again:
                flusher.add(await runner.play_one(spec))
            await flusher.close()

    def _end(self, outcome: Outcome) -> None:
        """Note how the sweep ended, read back what the database holds of it, and audit that."""
        try:
            outcome.facts = sweep_facts(self._options.db, outcome.sweep_id)
            outcome.audit = audit_sweep(
                self._options.db,
                outcome.sweep_id,
                [(spec.trial_id, spec.spec_hash) for spec in self._plan.trial_specs()],
                finished=outcome.exit_code == 0,
            )
            if not (outcome.exit_code or self._options.sends_nothing or self._options.keep_going):
                stored = FirstDecisions()
                self._add_stored(stored, [*self._stored, *self._todo])
                for line in stored.without_a_valid_one():
                    outcome.fail(NoValidDecision.exit_code, line)
            # Answers from another model are reported elsewhere; only --strict-model stops for them.
            findings = [f for f in outcome.audit.findings if f.kind != "served"]
            if findings:
                outcome.fail(1, f"the audit found {len(findings)} faults: `merge-runner audit`")
            outcome.messages += map(str, findings[:SHOWN])
            ended_at = datetime.now(UTC).replace(tzinfo=None)
            self._store.end_sweep(outcome.sweep_id, ended_at, outcome.exit_code)
        except (StoreError, UsageError) as exc:
            outcome.fail_by(exc)

    def _first_decisions(self, *, one_by_one: bool = False) -> FirstDecisions:
        """The first decisions of the models, with those that are stored already."""
        if self._options.keep_going:
            return FirstDecisions()
        first = FirstDecisions(MOST_INVALID, one_by_one=one_by_one)
        self._add_stored(first, self._stored)
        return first

    def _add_stored(self, first: FirstDecisions, specs: Iterable[TrialSpec]) -> None:
        arms = {spec.spec_hash: self._arms[spec.arm] for spec in specs}
        stored = self._store.decisions_by_spec(arms) if arms else []
        for spec, side, valid, invalid, failure, rationale in stored:
            model = arms[spec].asked[side]
            if model in self._plan.entries:
                first.add_stored(model, valid, invalid, failure, rationale)


@asynccontextmanager
async def open_sweep(
    plan: Plan, options: Options, *, say: Callable[[str], None]
) -> AsyncIterator[Sweep]:
    """Open the cache, and the database unless it is a replay, and find out what is missing.

    Asks a server of one's own what its model is called, and locks the models that a live run is to
    ask. ``say`` shows a line to the user. Raises UsageError.
    """
    check_batches(plan, options)
    recorded = partial(Spilled, options.recordings) if options.recordings else None
    with closing(ResponseCache(options.cache, overlay=recorded)) as cache:
        plan = plan.with_entries(await _named(plan.entries, options, cache, say))
        endpoints = {name: _endpoint(plan, name, options, cache) for name in plan.entries}
        plan = plan.model_copy(update={"endpoints": endpoints})
        specs = {(spec.trial_id, spec.spec_hash): spec for spec in plan.trial_specs()}
        # A replay derives everything from the recorded replies alone, so it plays every trial.
        with unreadable_is_usage():
            ended = set() if options.replay else Store(options.db).ended_trials(specs)
        todo = [spec for key, spec in specs.items() if key not in ended]
        if todo and not options.sends_nothing:
            if not plan.is_rehearsal:
                for name, entry in plan.entries.items():
                    resolve_endpoint(name, entry)  # raises where its key is missing
            options = _less_what_is_spent(plan, options, cache, say)
            entries = plan.entries.items()
            cache.locks.take({f"{e.id} at {plan.endpoints[name]}" for name, e in entries})
        stored = [spec for key, spec in specs.items() if key in ended]
        yield Sweep(plan, options, cache, stored, todo, say)


async def _named(
    entries: Mapping[str, ModelEntry],
    options: Options,
    cache: ResponseCache,
    say: Callable[[str], None],
) -> dict[str, ModelEntry]:
    """The entries, each with its model's name: as told, as recorded, or as its server says."""
    named = {}
    for name, entry in entries.items():
        found = model_id(entry)
        if not found and options.sends_nothing:
            found = recorded_name(entry, cache)
        elif not found:
            found = await served_name(name, entry, say=say)
        named[name] = entry.model_copy(update={"id": found})
    return named


def _endpoint(plan: Plan, name: str, options: Options, cache: ResponseCache) -> str:
    """The endpoint's identity: in a replay, the one under which the model is recorded."""
    entry, configured = plan.entries[name], plan.endpoints[name]
    if entry.provider == "emulator":
        configured += options.faults.identity
    if not options.replay:
        return configured
    recorded = sorted({r.endpoint for r in cache.recorded(lambda r: r.model == entry.id)})
    if configured in recorded or not recorded:
        return configured
    if len(recorded) > 1:
        raise UsageError(
            f"replies of {name} are recorded from several endpoints: {', '.join(recorded)}. "
            "Set the base URL variable of its provider to the one to replay."
        )
    return recorded[0]


def _less_what_is_spent(
    plan: Plan, options: Options, cache: ResponseCache, say: Callable[[str], None]
) -> Options:
    """The options with a cap that is lower by what other ledgers under it hold.

    They are those of sweeps that share the cap, and others of this study: it was run before its
    file had a budget, or has none any more.
    """
    own, name = plan.ledger, plan.study.name
    others = [
        scope
        for scope in scopes(cache)
        if (scope.startswith(f"{name}/") if own == name else scope == name)
        or (scope in options.ledgers and scope != own)
    ]
    spent_usd = sum(Ledger(cache, scope).read().committed_usd for scope in others)
    if options.max_cost_usd is None or not spent_usd:
        return options
    say(f"{spent_usd:.4f} USD of {', '.join(others)} count against the budget, too")
    return replace(options, max_cost_usd=max(0.0, options.max_cost_usd - spent_usd))


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
        async with open_sweep(plan, options, say=say) as sweep:
            return await sweep.estimate(whole=whole)


def _misses(spec: TrialSpec, record: TrialRecord) -> list[Miss]:
    """The calls of a trial for which nothing was recorded."""
    return [Miss(spec.trial_id, call.request) for call in record.failed_calls if call.missed]


def _differing(trials: Mapping[str, Sequence[str]]) -> str:
    """The first trials that are stored with other values, each with the columns that differ."""
    shown = list(trials.items())[:SHOWN]
    return "; ".join(f"{trial_id} ({', '.join(columns)})" for trial_id, columns in shown)


async def _drained(runner: LocalRunner | DaskTasks, work: asyncio.Task[None]) -> None:
    """Once the work has ended, however it did, save the calls that are in flight."""
    await asyncio.wait([work])
    await runner.drain()
