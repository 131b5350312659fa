"""The clients of a sweep's language models, with their connections."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import AsyncExitStack
from resource import RLIM_INFINITY, RLIMIT_NOFILE, getrlimit, setrlimit
from typing import TYPE_CHECKING

from merge_runner.errors import UsageError
from merge_runner.llm.batch.providers import SERVICES, batch_terms
from merge_runner.llm.batch.rounds import BatchSender, Rounds
from merge_runner.llm.budget import Budget
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.call import Calls
from merge_runner.llm.client import LlmClient
from merge_runner.llm.endpoint_state import EndpointState
from merge_runner.llm.ledger import Ledger
from merge_runner.llm.limiter import Limiter, Pause
from merge_runner.llm.models import load_models
from merge_runner.llm.prices import cost_usd
from merge_runner.llm.sender import DirectSender
from merge_runner.providers import resolve_endpoint
from merge_runner.records import Usage
from merge_runner.run.estimate import trial_costs
from merge_runner.run.options import Options
from merge_runner.run.plan import Plan

if TYPE_CHECKING:
    from merge_runner.llm.http import HttpTransport

# For the database, the cache, the log and what libraries open for themselves.
SPARE_FILES = 64


def live_clients(
    plan: Plan,
    options: Options,
    usage: Mapping[str, Usage | None],
    cache: ResponseCache,
    ledger: Ledger,
    *,
    calls: Calls,
    stack: AsyncExitStack,
    rounds: Rounds | None = None,
    urls: Mapping[str, str] | None = None,
    share: float = 1.0,
    limiters: dict[str, Limiter] | None = None,
) -> dict[str, LlmClient]:
    """Return clients with connections, closed with ``stack``, and a share of the rate limits.

    ``usage`` is a result of ``earlier_answers``: a model in it has answered before. ``rounds`` are
    this run's; they get the batch modes of its models. Variables in ``urls`` override the
    environment. ``limiters``, by registered model, are reused from earlier clients; new ones are
    added. Raises UsageError where a key is missing, or a cap could not be enforced.
    """
    _check_money(plan, ledger)
    _allow_files(options.connections + SPARE_FILES)
    limiters = {} if limiters is None else limiters
    # Models at one endpoint share its pauses: a server that is overloaded is so for all of them.
    pauses = {endpoint: Pause() for endpoint in plan.endpoints.values()}
    # Connections and limits belong to a model, with whatever parameters it is asked.
    names = {plan.registered[name]: name for name in plan.entries}
    env = {**os.environ, **(urls or {})}
    transports = _connect(names, plan, options, env, stack, rounds)
    for model, name in names.items():
        rates = options.rates(plan.entries[name])
        rpm, tpm = (limit and max(1, int(limit * share)) for limit in rates)
        pause, place = pauses[plan.endpoints[name]], plan.entries[name].place
        limiters.setdefault(model, Limiter(rpm=rpm, tpm=tpm, pause=pause, place=place))
    budget = Budget(ledger, trial_costs(plan, usage, batch=options.batch))
    free = Budget(Ledger(cache, ""))
    clients = {}
    for name, entry in plan.entries.items():
        model, terms = plan.registered[name], batch_terms(entry)
        wire = plan.parts.formats[entry.format]
        # A round is submitted at once: no call of it waits for a probe.
        verified = rounds is not None and rounds.submits
        state = EndpointState(name, entry, plan.endpoints[name], wire, verified, name in usage)
        clients[name] = LlmClient(
            state,
            cache,
            DirectSender(entry, wire, transports[model], limiters[model]),
            free if entry.price == "free" else budget,
            BatchSender(rounds, model, terms.price_factor) if rounds and terms else None,
            strict=options.strict_model,
            calls=calls,
        )
    return clients


def _connect(
    names: Mapping[str, str],
    plan: Plan,
    options: Options,
    env: Mapping[str, str],
    stack: AsyncExitStack,
    rounds: Rounds | None,
) -> dict[str, HttpTransport]:
    """Connect to each model's endpoint, and give the rounds its batch mode.

    The emulator answers in this process unless it has a URL.
    """
    from merge_runner.llm.http import HttpTransport

    in_process, transports = None, {}
    if plan.scripted and not env.get("EMULATOR_BASE_URL"):
        from merge_runner.emulator.handler import Emulator

        in_process = Emulator().transport()
    for model, name in names.items():
        entry = plan.entries[name]
        endpoint = resolve_endpoint(name, entry, env)
        transport = transports[model] = HttpTransport(
            endpoint,
            connections=options.connections,
            most_bytes=int(entry.max_reply_mb * 1e6),
            carrier=in_process if endpoint.provider == "emulator" else None,
        )
        stack.push_async_callback(transport.close)
        if rounds is not None and batch_terms(entry) is not None:
            wire = plan.parts.formats[entry.format]
            rounds.services[model] = SERVICES[entry.format](transport, endpoint, wire)
    return transports


def _check_money(plan: Plan, ledger: Ledger) -> None:
    for name, entry in plan.entries.items():
        unknown = cost_usd(entry, Usage(input_tokens=1, output_tokens=1)) is None
        if ledger.cap is not None and unknown:
            raise UsageError(
                f"the price of {name} is unknown, so {ledger.cap.source} cannot hold: give it a "
                f"`price` in {entry.place}"
            )
    if not plan.is_free:
        ledger.read()


def _allow_files(number: int) -> None:
    """Raise the limit of open files, 1,024 by default: each connection counts as one."""
    soft, hard = getrlimit(RLIMIT_NOFILE)
    try:
        if number > soft != RLIM_INFINITY:
            setrlimit(RLIMIT_NOFILE, (number, hard))
    except ValueError as exc:
        raise UsageError(
            f"{number} connections exceed this system's limit of {hard} open files: choose a lower "
            "--in-flight or raise `ulimit -n`"
        ) from exc


def open_rounds(
    plan: Plan, options: Options, cache: ResponseCache, say: Callable[[str], None]
) -> Rounds | None:
    """Return the rounds of a run; None where it submits none and no batch is open."""
    rounds = Rounds(cache, {*plan.registered.values()}, submits=options.batch, say=say)
    if options.dask is not None and rounds.batches:
        raise UsageError(
            "calls wait in batches of an earlier run: run the same command without --dask until "
            "they have ended"
        )
    if rounds.batches and not options.batch:
        say("calls that wait in batches of an earlier run are not asked again")
    return rounds if rounds.batches or options.batch else None


def check_batches(plan: Plan, options: Options) -> None:
    """Raise UsageError where a run cannot use batches."""
    is_served = bool(os.environ.get("EMULATOR_BASE_URL"))
    in_process = plan.scripted and not is_served
    if options.replay or options.dask is not None or not plan.entries or in_process:
        raise UsageError(
            "--batch asks models from this process, and neither programs nor the emulator have a "
            "batch mode: leave it, --replay or --dask out"
        )
    registry = load_models(plan.study.path.parent)
    for name, entry in plan.entries.items():
        if batch_terms(entry) is None:
            valid = ", ".join(
                model
                for model, listed in registry.items()
                if batch_terms(listed) and (is_served or listed.provider != "emulator")
            )
            raise UsageError(
                f"{plan.registered[name]} has no batch mode that is known; valid with --batch: "
                f"{valid}. Leave --batch out, or give {entry.place} `batch "
                "= { price_factor = 0.5, source = ... }` where its server has one in the same "
                "format"
            )
