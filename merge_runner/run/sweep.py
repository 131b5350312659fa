"""The composition root: wires drivers, clients, store and display, and runs a sweep."""

from __future__ import annotations

import asyncio
import tempfile
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager, closing
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from merge_runner.audit.checks import Audit, audit_sweep
from merge_runner.config import (
    PROVIDERS,
    UNNAMED,
    ModelEntry,
    driver_name,
    model_id,
    resolve_endpoint,
)
from merge_runner.errors import (
    MergeRunnerError,
    NoValidDecision,
    ProviderDown,
    ReplayMiss,
    StoreError,
    TrialSuspended,
    UsageError,
)
from merge_runner.llm.batch.rounds import Rounds
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.client import Meter
from merge_runner.llm.http_outcome import REGISTRY, TransportFailure, if_nobody
from merge_runner.llm.ledger import Ledger, Spending, scopes
from merge_runner.records import TrialRecord, TrialSpec, canonical_json
from merge_runner.results.database import unreadable_is_usage
from merge_runner.results.progress_file import write_standing
from merge_runner.results.provenance import git_state, versions
from merge_runner.results.recording import Spilled, described
from merge_runner.results.store import Store, SweepFacts, SweepRow, sweep_facts
from merge_runner.run.clients import (
    check_batches,
    live_clients,
    open_rounds,
)
from merge_runner.run.cluster import DaskTasks, connected
from merge_runner.run.estimate import Estimate, earlier_answers, estimate
from merge_runner.run.flusher import AGAIN, BATCH, Flusher
from merge_runner.run.local_runner import MOST_INVALID, FirstDecisions, LocalRunner
from merge_runner.run.plan import Options, Plan, usual_prompts
from merge_runner.run.progress import Progress, show_progress
from merge_runner.run.replay_diagnosis import Miss, explain
from merge_runner.signals import on_interrupt

INTERRUPTED = 130
GO_ON = "Run the same command again to go on."
SHOWN = 5
FROM_PROGRAMS = 16


@dataclass(slots=True)
class Outcome:
    """What a run of a plan did.

    ``stored_before`` trials were stored already; ``suspended`` ones wait for money. ``meter``
    counts the calls of this run, ``spending`` is that of the sweep over all its runs, and
    ``cache_cost_usd`` that of all sweeps on the cache. ``facts`` and ``audit`` are of what the
    database holds of the sweep; None where nothing is stored, or its user gave up waiting for it.
    ``batches`` go on without this run. ``playing_s`` is how long the trials took,
    ``worst_stall_s`` the longest delay of the event loop.
    """

    plan: Plan
    sweep_id: str = ""
    stored_before: int = 0
    exit_code: int = 0
    messages: list[str] = field(default_factory=list)
    meter: Meter = field(default_factory=Meter)
    suspended: int = 0
    spending: Spending = field(default_factory=Spending)
    cache_cost_usd: float = 0.0
    facts: SweepFacts | None = None
    audit: Audit | None = None
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
    todo: list[TrialSpec]
    _say: Callable[[str], None]
    _ledger: Ledger
    _misses: list[Miss] = field(default_factory=list)
    _rounds: Rounds | None = None

    async def run(self) -> Outcome:
        """Play what is missing and store it; what goes wrong is in the outcome."""
        outcome = Outcome(self._plan, stored_before=len(self._stored))
        if self._options.replay and await self._nothing_is_recorded():
            self._explain(outcome)
            held = described(self._options.recordings, self._cache.entries())
            outcome.messages.append(
                f"nothing of this replay is recorded, and nothing is stored: {held}"
            )
            return outcome
        self._misses.clear()
        async with AsyncExitStack() as stack:
            store = Store(self._options.db)
            runner = await self._runner(store, stack)
            with unreadable_is_usage():
                outcome.sweep_id = await self._begin(store)
            flusher = Flusher(store, outcome.sweep_id, self._say)
            progress = Progress(
                plan=self._plan,
                planned=len(self._stored) + len(self.todo),
                stored=len(self._stored),
                runner=runner,
                ledger=self._ledger,
                cap_usd=self._options.max_cost_usd,
                unstored=lambda: flusher.problem,
                batches=self._rounds.standing if self._rounds else list,
            )
            db, sweep_id, quiet = self._options.db, outcome.sweep_id, self._options.quiet
            await stack.enter_async_context(show_progress(progress, db, sweep_id, quiet=quiet))
            began = time.perf_counter()
            try:
                await self._play(runner, flusher, progress, outcome)
            finally:
                outcome.playing_s = time.perf_counter() - began
                is_stored = await self._store_rest(flusher, outcome)
            self._explain(outcome)
            failed = progress.outcome_counts["failed"]
            if failed and not self._misses:
                outcome.fail(1, f"{failed} trials failed")
            for meter in runner.meters.values():
                outcome.meter.add(meter)
            outcome.batches, outcome.worst_stall_s = progress.batches(), progress.worst_stall_s
            self._add_costs(outcome)
            progress.doing = "checking"
            write_standing(db, progress.standing(sweep_id))
            if is_stored:
                self._check(store, runner.first, outcome)
        return outcome

    async def estimate(self, *, whole: bool = False) -> Estimate:
        """What a live run takes: plays from recorded replies alone, and counts what is missing.

        ``whole``: what all trials take, as if none were stored or recorded yet.
        """
        trials = 0
        arms = self._plan.by_label()
        calls = {label: dict.fromkeys(arm.entries, 0.0) for label, arm in arms.items()}
        runner = LocalRunner.sealed(self._plan, self._cache)
        for spec in [*self._stored, *self.todo] if whole else self.todo:
            arm = arms[spec.arm]
            record = await runner.play_one(spec) if arm.entries and not whole else None
            if record is not None and record.status != "failed":
                continue
            trials += 1
            for side, name in arm.asked.items():
                if name in arm.entries:
                    answered = sum(row.side == side for row in record.decisions) if record else 0
                    calls[spec.arm][name] += max(1.0, usual_prompts(arm) - answered)
        return estimate(
            self._plan,
            self._options,
            trials=trials,
            calls=calls,
            facts=earlier_answers(self._plan, self._cache),
        )

    async def _nothing_is_recorded(self) -> bool:
        """Whether all calls are missing, of which the first of each trial are noted."""
        runner = LocalRunner.sealed(self._plan, self._cache)
        for spec in self.todo:
            self._note_misses(await runner.play_one(spec))
            if any(meter.calls_cached for meter in runner.meters.values()):
                return False
        return bool(self._misses)

    def _note_misses(self, record: TrialRecord) -> None:
        missed = [call.request for call in record.failed_calls if call.missed]
        self._misses += [Miss(record.spec.trial_id, request) for request in missed]

    def _explain(self, outcome: Outcome) -> None:
        left_out: list[str] = []
        for line in explain(self._misses, self._cache.entries(left_out)) if self._misses else ():
            outcome.fail(ReplayMiss.exit_code, line)
        if left_out:
            outcome.messages.append(
                f"{len(left_out)} rows of the cache are left out, the first: {left_out[0]}"
            )

    async def _begin(self, store: Store) -> str:
        started_at = datetime.now(UTC).replace(tzinfo=None)
        commit, dirty = await asyncio.to_thread(git_state)
        row = SweepRow(
            sweep_id=f"{self._plan.name}-{self._plan.model}-{started_at:%Y%m%dT%H%M%S%f}",
            name=self._plan.name,
            started_at=started_at,
            config=canonical_json(
                {**self._plan.model_dump(mode="json"), "max_cost_usd": self._options.max_cost_usd}
            ),
            git_commit=commit,
            git_dirty=dirty,
            versions=canonical_json(versions()),
        )
        store.begin_sweep(row, self._plan.specs(), self._stored)
        return row.sweep_id

    async def _runner(self, store: Store, stack: AsyncExitStack) -> LocalRunner | DaskTasks:
        """What plays the trials: this process, or the workers of a cluster."""
        plan, options = self._plan, self._options
        if options.sends_nothing or not plan.entries:
            in_flight = 1 if plan.entries else min(options.in_flight, FROM_PROGRAMS)
            return LocalRunner.sealed(plan, self._cache, in_flight)
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
            return DaskTasks(client, plan, options, earlier, self._cache, self._ledger, first)
        clients = live_clients(
            plan, options, earlier, self._cache, self._ledger, stack=stack, rounds=rounds
        )
        if rounds is not None:
            stack.push_async_callback(rounds.close)
        # A trial that waits for a round takes up nobody's time.
        in_flight = len(self.todo) if options.batch else options.in_flight
        return LocalRunner(plan, clients, in_flight, first, rounds)

    async def _play(
        self,
        runner: LocalRunner | DaskTasks,
        flusher: Flusher,
        progress: Progress,
        outcome: Outcome,
    ) -> None:
        """Run the trials until all have ended, or the sweep is stopped or interrupted."""
        suspended: list[TrialSuspended] = []

        def ended(spec: TrialSpec, record: TrialRecord | TrialSuspended) -> None:
            if isinstance(record, TrialSuspended):
                progress.outcome_counts["suspended"] += 1
                suspended.append(record)
                return
            progress.outcome_counts[record.status] += 1
            self._note_misses(record)
            flusher.add(record)

        async def drained() -> None:
            await asyncio.wait([work])
            await runner.drain()

        # Two tasks, since Ctrl-C stops the trials but lets the calls that are paid for end.
        work = asyncio.create_task(runner.play(self.todo, ended, room=flusher.room))
        drain = asyncio.create_task(drained())

        def interrupted() -> None:
            work.cancel()  # before anything is written: the terminal may be closed
            self._say(f"Stopping: {runner.unsaved} are saved first; Ctrl-C again drops them.")

        with on_interrupt(interrupted, drain.cancel):
            await asyncio.wait([drain])
            await asyncio.wait([work])
        if work.cancelled():
            outcome.fail(INTERRUPTED, f"Interrupted. {GO_ON}")
        else:
            outcome.fail_by(work.exception())
        outcome.suspended = len(suspended)
        if suspended:
            outcome.fail(
                TrialSuspended.exit_code,
                f"{len(suspended)} trials wait for money: {suspended[-1]}. Their replies are kept: "
                "raise --max-cost, or the study's budget, and run the same command again",
            )

    async def _store_rest(self, flusher: Flusher, outcome: Outcome) -> bool:
        """Store what is not stored yet; False where Ctrl-C ended the waiting for that."""
        closing = asyncio.create_task(self._store_all(flusher))
        with on_interrupt(closing.cancel, closing.cancel):
            await asyncio.wait([closing])
        if closing.cancelled():
            why = f": {flusher.problem}. {AGAIN}" if flusher.problem else ". " + GO_ON
            outcome.fail(INTERRUPTED, f"Interrupted{why}")
            return False
        outcome.fail_by(closing.exception())
        if flusher.differing:
            differing = [*flusher.differing.items()][:SHOWN]
            shown = [f"{trial_id} ({', '.join(columns)})" for trial_id, columns in differing]
            outcome.fail(
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
            runner = LocalRunner.sealed(self._plan, self._cache)
            for spec in again:
                flusher.add(await runner.play_one(spec))
            await flusher.close()

    def _add_costs(self, outcome: Outcome) -> None:
        try:
            ledgers = (Ledger(self._cache, scope) for scope in scopes(self._cache))
            outcome.cache_cost_usd = sum(ledger.read().spent_usd for ledger in ledgers)
            outcome.spending = self._ledger.read()
        except MergeRunnerError as exc:
            if self._options.replay:  # which spends nothing
                outcome.messages.append(str(exc))
            else:
                outcome.fail_by(exc)

    def _check(self, store: Store, first: FirstDecisions, outcome: Outcome) -> None:
        """Read back what the database holds of the sweep, audit it, and note how it ended."""
        db, sweep_id = self._options.db, outcome.sweep_id
        keys = [(spec.trial_id, spec.spec_hash) for spec in self._plan.trial_specs()]
        try:
            outcome.facts = sweep_facts(db, sweep_id)
            outcome.audit = audit_sweep(db, sweep_id, keys, finished=outcome.exit_code == 0)
            if not (outcome.exit_code or self._options.sends_nothing or self._options.keep_going):
                for line in first.without_a_valid_one():
                    outcome.fail(NoValidDecision.exit_code, line)
            # Answers from another model are reported elsewhere; only --strict-model stops for them.
            findings = [f for f in outcome.audit.findings if f.kind != "served"]
            if findings:
                outcome.fail(1, f"the audit found {len(findings)} faults: `merge-runner audit`")
            outcome.messages += map(str, findings[:SHOWN])
            ended_at = datetime.now(UTC).replace(tzinfo=None)
            store.end_sweep(sweep_id, ended_at, outcome.exit_code)
        except (StoreError, UsageError) as exc:
            outcome.fail_by(exc)


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
        options = replace(options, max_cost_usd=plan.study.file.budget.total_usd)
    recorded = partial(Spilled, options.recordings) if options.recordings else None
    with closing(ResponseCache(options.cache, overlay=recorded)) as cache:
        entries = {
            name: await _named(name, entry, options, cache, say)
            for name, entry in plan.entries.items()
        }
        plan = plan.with_entries(entries)
        endpoints = {name: _endpoint(plan, name, options, cache) for name in entries}
        plan = plan.model_copy(update={"endpoints": endpoints})
        specs = {(spec.trial_id, spec.spec_hash): spec for spec in plan.trial_specs()}
        # A replay derives everything from the recorded replies alone, so it plays every trial.
        with unreadable_is_usage():
            ended = set() if options.replay else Store(options.db).ended_trials(specs)
        stored = [spec for key, spec in specs.items() if key in ended]
        todo = [spec for key, spec in specs.items() if key not in ended]
        if todo and not options.sends_nothing:
            if options.dask is None and not plan.is_rehearsal:
                for name, entry in entries.items():
                    resolve_endpoint(name, entry)  # raises where its key is missing
            options = _less_what_is_spent(plan, options, cache, say)
            cache.locks.take({f"{e.id} at {endpoints[name]}" for name, e in entries.items()})
        yield Sweep(plan, options, cache, stored, todo, say, Ledger(cache, plan.ledger))


async def _named(
    name: str, entry: ModelEntry, options: Options, cache: ResponseCache, say: Callable[[str], None]
) -> ModelEntry:
    """The entry with its model's name: as told, as recorded, or as its server says."""
    found = model_id(entry)
    if not found and options.sends_nothing:
        # A server of one's own serves one model, or the recorded replies do not tell which.
        recorded = {r.model for r in cache.recorded(lambda r: r.provider == entry.provider)}
        found = recorded.pop() if len(recorded) == 1 else UNNAMED
    elif not found:
        found = await _served_name(name, entry, say=say)
    return entry.model_copy(update={"id": found})


async def _served_name(name: str, entry: ModelEntry, *, say: Callable[[str], None]) -> str:
    """The one model that a server lists; raises ProviderDown where nobody listens, UsageError."""
    from merge_runner.llm.http import listed_models  # imports httpx, which no replay needs

    endpoint = resolve_endpoint(name, entry)
    driver = driver_name(name, endpoint.identity)
    try:
        listed = await listed_models(endpoint)
    except TransportFailure as exc:
        if exc.outcome == "no_connection":
            raise ProviderDown(f"{driver}: {exc}: {if_nobody(name, entry)}") from exc
        listed, models = [], f"models that it does not list ({exc})"
    else:
        models = ", ".join(listed) or "no model"
    if len(listed) != 1:
        variable = PROVIDERS.require(entry.provider).model_env
        raise UsageError(
            f"{driver} serves {models}: name one with "
            f"{variable}, or with `id` of [{name}] in {REGISTRY}, which goes first"
        )
    say(f"{driver} serves {listed[0]}, which is asked")
    return listed[0]


def _endpoint(plan: Plan, name: str, options: Options, cache: ResponseCache) -> str:
    """The endpoint's identity: in a replay, the one under which the model is recorded."""
    entry, configured = plan.entries[name], plan.endpoints[name]
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
    own, study = plan.ledger, plan.study.name
    others = [
        scope
        for scope in scopes(cache)
        if scope != own
        and (scope in options.ledgers or (study in (own, scope) and scope.split("/")[0] == study))
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
