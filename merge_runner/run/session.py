"""An open sweep: its plan, cache and ledger, its missing trials, and its problems."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, closing
from dataclasses import dataclass, field
from functools import partial

from merge_runner.errors import MergeRunnerError
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.ledger import Cap, Ledger, scopes
from merge_runner.providers import resolve_endpoint
from merge_runner.records import ReplayMiss
from merge_runner.registry import using
from merge_runner.results.database import unreadable_is_usage
from merge_runner.results.replay_misses import Miss, explain
from merge_runner.results.store import Store
from merge_runner.run.options import Options
from merge_runner.run.plan import Plan
from merge_runner.run.served_names import with_names
from merge_runner.trial_records import TrialRecord, TrialSpec


@dataclass
class Session:
    """An open plan; its trials are ``stored`` by earlier runs, or ``todo``.

    ``say`` shows a line to the user. The first problem sets ``exit_code``; all problems are in
    ``messages``.
    """

    plan: Plan
    options: Options
    cache: ResponseCache
    ledger: Ledger
    stored: list[TrialSpec]
    todo: list[TrialSpec]
    say: Callable[[str], None]
    exit_code: int = 0
    messages: list[str] = field(default_factory=list)

    def fail(self, exit_code: int, message: str) -> None:
        """Note a problem."""
        self.exit_code = self.exit_code or exit_code
        self.messages.append(message)

    def fail_by(self, error: BaseException | None) -> None:
        """Note an error that a user can act on; raise any other one."""
        if isinstance(error, MergeRunnerError):
            self.fail(error.exit_code, str(error))
        elif error is not None:
            raise error

    def fail_by_misses(self, misses: list[Miss]) -> None:
        """Note the calls that have no recorded reply, each with the nearest one that has."""
        left_out: list[str] = []
        for line in explain(misses, self.cache.entries(left_out)) if misses else ():
            self.fail(ReplayMiss.exit_code, line)
        if left_out:
            number = len(left_out)
            self.messages.append(f"{number} rows of the cache are left out, one: {left_out[0]}")


def misses_of(record: TrialRecord) -> list[Miss]:
    """Return the calls of a trial that have no recorded reply."""
    missed = [call.request for call in record.failed_calls if call.missed]
    return [Miss(record.spec.trial_id, request) for request in missed]


@asynccontextmanager
async def open_session(
    plan: Plan, options: Options, *, say: Callable[[str], None]
) -> AsyncIterator[Session]:
    """Open the cache, and the database unless it is a replay, and list the missing trials.

    Asks a user's own server for the name of its model, and locks the models of a live run.
    ``say`` shows a line to the user. Raises UsageError.
    """
    overlay = None
    if options.recordings:
        from merge_runner.results.recording import spilled

        overlay = partial(spilled, options.recordings)
    with (
        using(plan.parts.catalogue),  # it has the study's own providers
        closing(ResponseCache(options.cache, overlay=overlay)) as cache,
    ):
        if options.batch:
            from merge_runner.run.clients import check_batches

            check_batches(plan, options)
        plan = await with_names(plan, options, cache, say)
        specs = {spec.key: spec for spec in plan.trial_specs()}
        # A replay derives everything from the recorded replies alone, so it plays every trial.
        with unreadable_is_usage():
            ended = set() if options.replay else Store(options.db).ended_trials(specs)
            stored = [spec for key, spec in specs.items() if key in ended]
            if stored:
                from merge_runner.run.stored_replay import check_programs

                check_programs(options.db, plan, stored)
        todo = [spec for key, spec in specs.items() if key not in ended]
        live = bool(todo) and not options.sends_nothing
        if live and options.dask is None:
            for name, entry in plan.entries.items():
                resolve_endpoint(name, entry)  # raises where its key is missing
        cap = _cap(plan, options, cache, say, is_open=bool(todo))
        if live:
            cache.run_now([])  # raises before anything is asked if it cannot be written
            models = plan.entries.items()
            cache.locks.take({f"{e.id} at {plan.endpoints[name]}" for name, e in models})
        ledger = Ledger(cache, plan.ledger, cap)
        yield Session(plan, options, cache, ledger, stored, todo, say)


def _cap(
    plan: Plan, options: Options, cache: ResponseCache, say: Callable[[str], None], *, is_open: bool
) -> Cap | None:
    """Return the cap of a run, by --max-cost or by its study's budget; None in a replay, too.

    If something ``is_open`` to be run, it also covers the ledgers of sweeps under the same cap. A
    study with a budget has one ledger by its name, without a budget one for each set of models:
    both kinds count, or a changed file would start from 0.
    """
    ledger, study = plan.ledger, plan.study.name
    usd, source = options.max_cost_usd, "--max-cost"
    if usd is None:
        usd, source = plan.study.file.budget.get("total_usd"), f"[budget] of {study}"
    if usd is None or options.replay:
        return None
    others = []
    for scope in scopes(cache) if is_open else ():
        is_same_study = study in (ledger, scope) and scope.split("/")[0] == study
        if scope != ledger and (scope in options.ledgers or is_same_study):
            others.append(scope)
    if spent_usd := sum(Ledger(cache, scope).read().committed_usd for scope in others):
        say(f"{spent_usd:.4f} USD of {', '.join(others)} count against the budget, too")
    return Cap(usd, source, tuple(others))
