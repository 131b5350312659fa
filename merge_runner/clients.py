"""Makes the clients of a sweep's language models, with their connections or sealed."""

from __future__ import annotations

import resource
from collections.abc import Mapping, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass

from merge_runner.config import ModelEntry, resolve_endpoint, running_emulator_url
from merge_runner.emulator.process import emulator_process
from merge_runner.errors import UsageError
from merge_runner.llm.budget import Budget
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.claims import Claims
from merge_runner.llm.client import LlmClient
from merge_runner.llm.ledger import Ledger
from merge_runner.llm.limiter import Limiter, Pause
from merge_runner.llm.prices import Pricing, pricing
from merge_runner.llm.transport import SealedTransport
from merge_runner.plan import Limits

SPARE_FILES = 64


@dataclass(frozen=True, slots=True)
class Terms:
    """On what terms a sweep asks.

    ``ledger`` holds its spending, over all its runs; ``trial_usd`` is the worst case of a whole
    trial. ``strict`` stops at an answer of another model.
    """

    limits: Limits
    ledger: Ledger
    trial_usd: float
    strict: bool = False


def sealed_clients(
    entries: Mapping[str, ModelEntry],
    endpoints: Mapping[str, str],
    cache: ResponseCache,
    transport: SealedTransport,
) -> dict[str, LlmClient]:
    """Clients that answer from recordings alone: no key, no connection."""
    return {
        name: LlmClient(
            name=name,
            entry=entry,
            endpoint=endpoints[name],
            cache=cache,
            transport=transport,
            limiter=Limiter(),
            pricing=pricing(entry),
            sealed=True,
        )
        for name, entry in entries.items()
    }


async def live_clients(
    entries: Mapping[str, ModelEntry],
    endpoints: Mapping[str, str],
    cache: ResponseCache,
    terms: Terms,
    *,
    emulator_options: Sequence[str],
    stack: AsyncExitStack,
) -> dict[str, LlmClient]:
    """Clients with connections, closed with ``stack``; starts the emulator where it is asked.

    Raises UsageError where a key is missing.
    """
    from merge_runner.llm.http import HttpTransport

    limits = terms.limits
    _allow_open_files(limits.connections + SPARE_FILES)
    budget = Budget(terms.ledger, cap_usd=limits.max_cost_usd, trial_usd=terms.trial_usd)
    claims = Claims(cache.folder)
    stack.callback(claims.close)
    pauses: dict[str, Pause] = {}
    clients = {}
    for name, entry in entries.items():
        environment = None
        if entry.provider == "emulator" and running_emulator_url() is None:
            url = await stack.enter_async_context(emulator_process(emulator_options))
            environment = {"EMULATOR_BASE_URL": f"{url}/v1"}
        transport = HttpTransport(
            resolve_endpoint(name, entry, environment), connections=limits.connections
        )
        stack.push_async_callback(transport.close)
        clients[name] = LlmClient(
            name=name,
            entry=entry,
            endpoint=endpoints[name],
            cache=cache,
            transport=transport,
            limiter=Limiter(
                rpm=limits.rpm or entry.rpm,
                tpm=limits.tpm or entry.tpm,
                pause=pauses.setdefault(endpoints[name], Pause()),
            ),
            pricing=_pricing(name, entry, capped=limits.max_cost_usd is not None),
            budget=None if entry.price == "free" else budget,
            claims=claims,
            strict=terms.strict,
        )
    return clients


def _pricing(name: str, entry: ModelEntry, *, capped: bool) -> Pricing:
    price = pricing(entry)
    if capped and not price.known:
        raise UsageError(
            f"the price of {name} is unknown, so --max-cost cannot hold: give it a price in "
            "experiments/models.toml"
        )
    return price


def _allow_open_files(wanted: int) -> None:
    """Raise this process's limit of open files to what the connections need."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft >= wanted or soft == resource.RLIM_INFINITY:
        return
    if hard != resource.RLIM_INFINITY and hard < wanted:
        raise UsageError(
            f"{wanted} connections exceed this system's limit of {hard} open files: choose a lower "
            "--in-flight or raise `ulimit -n`"
        )
    resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
