"""Makes the clients of a sweep's language models: connected, or answering from recordings."""

from __future__ import annotations

import os
import resource
from collections.abc import Callable, Mapping
from contextlib import AsyncExitStack
from dataclasses import dataclass

from merge_runner.config import (
    Endpoint,
    base_urls,
    check_network,
    driver_name,
    rehearsal_endpoint,
    resolve_endpoint,
)
from merge_runner.emulator.faults import FaultPlan
from merge_runner.errors import UsageError
from merge_runner.llm.batch.providers import SERVICES, batch_terms, require_batch
from merge_runner.llm.batch.rounds import Rounds
from merge_runner.llm.budget import Budget
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.call import Call
from merge_runner.llm.call_totals import CallTotals
from merge_runner.llm.client import LlmClient
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.http_outcome import FirstCall
from merge_runner.llm.ledger import Ledger
from merge_runner.llm.limiter import WINDOW_S, Limiter, Pause
from merge_runner.llm.models import load_models
from merge_runner.llm.prices import is_known
from merge_runner.run.estimate import trial_costs
from merge_runner.run.plan import Options, Plan
from merge_runner.run.rehearsal import SPEED, behaviour

# For the database, the cache, the log and what libraries open for themselves.
SPARE_FILES = 64


@dataclass(frozen=True, slots=True)
class EndpointPlan:
    """How the endpoints of a sweep are asked; ``urls`` maps variables to base URLs.

    ``emulator`` says how the emulator of this process behaves, None where none is needed. ``known``
    names the models whose endpoint has ever given an answer in its format, and ``measured`` is what
    the cache knows about each model's answers to similar requests.
    """

    urls: Mapping[str, str]
    emulator: FaultPlan | None
    known: frozenset[str]
    measured: Mapping[str, CallTotals]


def sealed_clients(plan: Plan, cache: ResponseCache) -> dict[str, LlmClient]:
    """Clients that answer from recordings alone: no key, no connection."""
    return {
        name: LlmClient(
            name=name,
            entry=entry,
            endpoint=plan.endpoints[name],
            cache=cache,
            transport=None,
            limiter=Limiter(),
            sealed=True,
        )
        for name, entry in plan.entries.items()
    }


def _limiters(plan: Plan, options: Options, share: float) -> dict[str, Limiter]:
    """The rate limiter of each entry, with a share of its model's limits."""
    # Models at one endpoint share its pauses: a server that is overloaded is so for all of them.
    pauses = {endpoint: Pause() for endpoint in plan.endpoints.values()}
    # An account's limits are those of a model, with whatever parameters it is asked.
    by_model: dict[str, Limiter] = {}
    for name, entry in plan.entries.items():
        if plan.registered[name] not in by_model:
            rpm, tpm = (limit and max(1, int(limit * share)) for limit in options.rates(entry))
            by_model[plan.registered[name]] = Limiter(
                rpm=rpm,
                tpm=tpm,
                pause=pauses[plan.endpoints[name]],
                window_s=WINDOW_S / SPEED if plan.is_rehearsal else WINDOW_S,
            )
    return {name: by_model[plan.registered[name]] for name in plan.entries}


def endpoint_plan(
    plan: Plan, options: Options, known: frozenset[str], measured: Mapping[str, CallTotals]
) -> EndpointPlan:
    """Return how the endpoints of a plan's models are asked; see EndpointPlan for the last two."""
    emulated = any(entry.provider == "emulator" for entry in plan.entries.values())
    if plan.is_rehearsal:
        emulator: FaultPlan | None = behaviour(plan)
    else:
        runs = bool(os.environ.get("EMULATOR_BASE_URL"))  # and is the one to ask
        emulator = options.faults if emulated and not runs else None
    return EndpointPlan(base_urls(plan.entries), emulator, known, measured)


def live_clients(
    plan: Plan,
    options: Options,
    endpoint_plan: EndpointPlan,
    cache: ResponseCache,
    ledger: Ledger,
    *,
    stack: AsyncExitStack,
    rounds: Rounds | None = None,
    share: float = 1.0,
) -> dict[str, LlmClient]:
    """Clients with connections, closed with ``stack``, and a share of the rate limits.

    ``rounds`` are those of this run, which get the batch modes of its models. Raises UsageError
    where a key is missing, or a cap could not be enforced.
    """
    from merge_runner.llm.http import HttpTransport

    for name, entry in plan.entries.items():
        if options.max_cost_usd is not None and not is_known(entry):
            raise UsageError(
                f"the price of {name} is unknown, so --max-cost cannot hold: give it a price in "
                "experiments/models.toml"
            )
    if any(entry.price != "free" for entry in plan.entries.values()):
        ledger.read()  # raises where it is damaged, before anything is spent
        ledger.settle_kept({driver_name(name, plan.endpoints[name]) for name in plan.entries})
    costs = trial_costs(plan, endpoint_plan.measured, batch=options.batch)
    budget = Budget(ledger, options.max_cost_usd, costs)
    limiters = _limiters(plan, options, share)
    _allow_open_files(options.connections + SPARE_FILES)
    in_process = None
    if endpoint_plan.emulator is not None:
        from merge_runner.emulator.handler import Emulator, InProcess

        in_process = InProcess(Emulator(endpoint_plan.emulator))
    transports: dict[str, HttpTransport] = {}
    clients: dict[str, LlmClient] = {}
    under_way: dict[str, Call] = {}  # two names of one model may ask the same
    for name, entry in plan.entries.items():
        model, terms = plan.registered[name], batch_terms(entry)
        if model not in transports:
            endpoint = _endpoint(plan, name, endpoint_plan.urls)
            check_network(endpoint.base_url)
            transports[model] = HttpTransport(
                endpoint,
                connections=options.connections,
                most_bytes=int(entry.max_reply_mb * 1e6),
                carrier=in_process if endpoint.is_emulator else None,
            )
            stack.push_async_callback(transports[model].close)
            if rounds is not None and terms is not None:
                service = SERVICES[entry.format]
                rounds.services[model] = service(transports[model], endpoint, FORMATS[entry.format])
        clients[name] = LlmClient(
            name=name,
            entry=entry,
            endpoint=plan.endpoints[name],
            cache=cache,
            transport=transports[model],
            limiter=limiters[name],
            budget=None if entry.price == "free" else budget,
            strict=options.strict_model,
            model=model,
            first=FirstCall(
                # A round is asked at once: no call of it waits for another one's answer.
                passed=rounds is not None and rounds.submits,
                known=name in endpoint_plan.known,
            ),
            rounds=rounds if terms else None,
            batch_price=terms.price_factor if terms else 1.0,
            under_way=under_way,
        )
    return clients


def _endpoint(plan: Plan, name: str, urls: Mapping[str, str]) -> Endpoint:
    if plan.is_rehearsal:
        return rehearsal_endpoint(plan.entries[name])
    return resolve_endpoint(name, plan.entries[name], {**os.environ, **urls})


def open_rounds(
    plan: Plan, options: Options, cache: ResponseCache, say: Callable[[str], None]
) -> Rounds | None:
    """The rounds of a run; None where it submits none, and no earlier run has left a batch open."""
    models = set(plan.registered.values())
    rounds = Rounds(cache, models, submits=options.batch, say=say)
    left = bool(rounds.batches)
    if options.dask is not None:
        if left:
            raise UsageError(
                "calls wait in batches of an earlier run: run the same command without --dask "
                "until they have ended"
            )
        return None
    if left and not options.batch:
        say("calls that wait in batches of an earlier run are not asked again")
    if not options.batch and not left:
        return None
    return rounds


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
