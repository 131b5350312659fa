"""Makes the clients of a sweep's language models: connected, or answering from recordings."""

from __future__ import annotations

import resource
from collections.abc import Callable, Mapping
from contextlib import AsyncExitStack
from dataclasses import dataclass

from merge_runner.config import (
    REHEARSAL,
    Endpoint,
    ModelEntry,
    base_urls,
    check_network,
    driver_name,
    rehearsal_endpoint,
    resolve_endpoint,
    running_emulator_url,
    with_base_urls,
)
from merge_runner.emulator.process import emulator_process
from merge_runner.errors import UsageError
from merge_runner.llm.batch.batches import Batches
from merge_runner.llm.batch.journal import Journal
from merge_runner.llm.batch.modes import batch_service, batch_terms, require_batch
from merge_runner.llm.batch.rounds import Rounds
from merge_runner.llm.budget import Budget, Unpaid
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.call_totals import CallTotals
from merge_runner.llm.client import LlmClient
from merge_runner.llm.first_call import FirstCall
from merge_runner.llm.ledger import Ledger
from merge_runner.llm.limiter import WINDOW_S, Limiter, Pause
from merge_runner.llm.models import load_models
from merge_runner.llm.prices import is_known
from merge_runner.llm.shared_services import BudgetPort, CachePort, RateLimitPort
from merge_runner.llm.transport import SealedTransport
from merge_runner.run.estimate import trial_costs
from merge_runner.run.plan import Options, Plan, most_prompts
from merge_runner.run.rehearsal import SPEED, write_behaviour

# For the database, the cache, the log and what libraries open for themselves.
SPARE_FILES = 64


@dataclass(frozen=True, slots=True)
class EndpointPlan:
    """How the endpoints of a sweep are asked; ``urls`` maps variables to base URLs.

    ``known`` names the models whose endpoint has ever given an answer in its format, ``passed``
    those where it has done so in this run. With ``strict``, an answer from another model than the
    one requested stops the run.
    """

    urls: Mapping[str, str]
    strict: bool = False
    known: frozenset[str] = frozenset()
    passed: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class LocalServices:
    """What the clients of a run share: the rate limiter of each model, and the budget."""

    limiters: Mapping[str, Limiter]
    budget: Budget


def sealed_clients(plan: Plan, cache: ResponseCache) -> dict[str, LlmClient]:
    """Clients that answer from recordings alone: no key, no connection."""
    return {
        name: LlmClient(
            name=name,
            entry=entry,
            endpoint=plan.endpoints[name],
            cache=cache,
            transport=SealedTransport(),
            limiter=Limiter(),
            sealed=True,
        )
        for name, entry in plan.entries.items()
    }


def open_services(
    plan: Plan,
    options: Options,
    cache: ResponseCache,
    ledger: Ledger,
    measured: Mapping[str, CallTotals],
) -> LocalServices:
    """The services of a run.

    ``measured`` is what the cache knows about each model's earlier answers to similar requests.
    Raises UsageError where a cap could not be enforced.
    """
    for name, entry in plan.entries.items():
        if options.max_cost_usd is not None and not is_known(entry):
            raise UsageError(
                f"the price of {name} is unknown, so --max-cost cannot hold: give it a price in "
                "experiments/models.toml"
            )
    if any(entry.price != "free" for entry in plan.entries.values()):
        ledger.read()  # raises where it is damaged, before anything is spent
        ledger.settle_kept({driver_name(name, plan.endpoints[name]) for name in plan.entries})
    # Models at one endpoint share its pauses: a server that is overloaded is so for all of them.
    pauses = {endpoint: Pause() for endpoint in plan.endpoints.values()}
    # An account's limits are those of a model, with whatever parameters it is asked.
    by_model: dict[str, Limiter] = {}
    limiters = {}
    for name, entry in plan.entries.items():
        model = plan.registered[name]
        if model not in by_model:
            rpm, tpm = options.rates(entry)
            window_s = WINDOW_S / SPEED if plan.is_rehearsal else WINDOW_S
            pause = pauses[plan.endpoints[name]]
            by_model[model] = Limiter(rpm=rpm, tpm=tpm, pause=pause, window_s=window_s)
        limiters[name] = by_model[model]
    costs = trial_costs(plan, measured, batch=options.batch)
    budget = Budget(ledger, options.max_cost_usd, costs)
    return LocalServices(limiters=limiters, budget=budget)


async def start_endpoints(plan: Plan, options: Options, stack: AsyncExitStack) -> dict[str, str]:
    """The variables of base URLs that lead to the endpoints of a plan's models.

    Starts the emulator where one needs it; closing ``stack`` stops it.
    """
    urls = base_urls(plan.entries)
    emulated = any(entry.provider == "emulator" for entry in plan.entries.values())
    if plan.is_rehearsal:
        behaviour = options.db.with_name("faults.toml")
        write_behaviour(plan, behaviour)
        process = emulator_process(["--faults", str(behaviour)])
        urls[REHEARSAL] = await stack.enter_async_context(process)
    elif emulated and running_emulator_url() is None:
        url = await stack.enter_async_context(emulator_process(options.emulator_options))
        urls |= {"EMULATOR_BASE_URL": f"{url}/v1"}
    return urls


def live_clients(
    plan: Plan,
    endpoint_plan: EndpointPlan,
    cache: CachePort,
    limiters: Mapping[str, RateLimitPort],
    budget: BudgetPort,
    *,
    connections: int,
    stack: AsyncExitStack,
    rounds: Rounds | None = None,
) -> dict[str, LlmClient]:
    """Clients with connections, closed with ``stack``. Raises UsageError where a key is missing.

    ``rounds`` are those of this run, which get the batch modes of its models.
    """
    from merge_runner.llm.http import HttpTransport

    _allow_open_files(connections + SPARE_FILES)
    transports: dict[str, HttpTransport] = {}
    clients = {}
    for name, entry in plan.entries.items():
        model = plan.registered[name]
        if model not in transports:
            endpoint = _endpoint(plan, name, endpoint_plan.urls)
            check_network(endpoint.base_url)
            transports[model] = HttpTransport(
                endpoint, connections=connections, most_bytes=int(entry.max_reply_mb * 1e6)
            )
            stack.push_async_callback(transports[model].close)
            if rounds is not None and batch_terms(entry) is not None:
                rounds.services[model] = batch_service(entry, endpoint, transports[model])
        clients[name] = LlmClient(
            name=name,
            entry=entry,
            endpoint=plan.endpoints[name],
            cache=cache,
            transport=transports[model],
            limiter=limiters[name],
            budget=None if entry.price == "free" else budget,
            strict=endpoint_plan.strict,
            model=model,
            first=FirstCall(
                # A round is asked at once: no call of it waits for another one's answer.
                passed=name in endpoint_plan.passed or (rounds is not None and rounds.submits),
                known=name in endpoint_plan.known,
            ),
            batches=_batches(model, entry, cache, budget, rounds),
        )
    return clients


def _endpoint(plan: Plan, name: str, urls: Mapping[str, str]) -> Endpoint:
    if plan.is_rehearsal:
        return rehearsal_endpoint(plan.entries[name], urls[REHEARSAL])
    return resolve_endpoint(name, plan.entries[name], with_base_urls(urls))


def _batches(
    model: str, entry: ModelEntry, cache: CachePort, budget: BudgetPort, rounds: Rounds | None
) -> Batches | None:
    """The batches in which a model is asked; None where it has none, and on a cluster."""
    terms = batch_terms(entry)
    if rounds is None or terms is None or not isinstance(budget, Budget):
        return None
    money = Unpaid(cache) if entry.price == "free" else budget
    return Batches(rounds, model, budget.ledger.scope, money, terms.price_factor)


def open_rounds(
    plan: Plan, options: Options, cache: ResponseCache, say: Callable[[str], None]
) -> Rounds | None:
    """The rounds of a run; None where it submits none, and no earlier run has left a batch open."""
    journal = Journal(cache)
    models = set(plan.registered.values())
    left = [each for each in journal.batches() if each.model in models and journal.waiting(each)]
    own = [each for each in left if each.ledger == plan.ledger]
    if options.dask is not None:
        if own:
            raise UsageError(
                "calls wait in batches of an earlier run: run the same command without --dask "
                "until they have ended"
            )
        return None
    if own and not options.batch:
        say("calls that wait in batches of an earlier run are not asked again")
    if others := sorted({each.ledger for each in left} - {plan.ledger}):
        say(f"calls that wait in batches of {', '.join(others)} are not asked again")
    if not options.batch and not left:
        return None
    most = max((most_prompts(arm) for arm in plan.arms), default=1)
    free = {
        plan.registered[name]
        for name, entry in plan.entries.items()
        if plan.is_rehearsal or entry.price == "free"
    }
    return Rounds(journal, {}, submits=options.batch, most_rounds=most, free=free, say=say)


def check_batches(plan: Plan, options: Options) -> None:
    """Raise UsageError where a run cannot use batches as it is told to."""
    if not options.batch:
        return
    if options.replay:
        raise UsageError("a replay asks nothing: leave --batch out")
    if options.dask is not None:
        raise UsageError("--batch plays in this process: leave --dask out")
    if not plan.entries:
        raise UsageError("no language model is asked: leave --batch out")
    registry = load_models(plan.study.path.parent)
    for name, entry in plan.entries.items():
        require_batch(plan.registered[name], entry, registry)


def _allow_open_files(wanted: int) -> None:
    """Raise this process's limit on open files to what the connections need."""
    # 1,024 by default, and a connection is a file: thousands in flight would fail one by one.
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft >= wanted or soft == resource.RLIM_INFINITY:
        return
    if hard != resource.RLIM_INFINITY and hard < wanted:
        raise UsageError(
            f"{wanted} connections exceed this system's limit of {hard} open files: choose a lower "
            "--in-flight or raise `ulimit -n`"
        )
    resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
