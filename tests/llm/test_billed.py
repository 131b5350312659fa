"""What a server bills never passes the cap, and the ledger knows of it, in every scenario.

A client with a cap asks an emulator that bills as much as an honest server could: what a reply
tells in `usage`, and the whole output cap for each request that no reply shows to be free.
"""

from __future__ import annotations

import asyncio
import json
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

import pytest
from aiohttp import web
from test_scenarios import (  # noqa: F401 # fixtures
    GEMINI,
    MODELS,
    OPENAI,
    _idle_connections_grow_old_in_virtual_time,
    _no_settings_of_the_user,
)
from virtual_time import in_virtual_time

from merge_runner.config import Endpoint, ModelEntry, Price
from merge_runner.emulator.faults import FaultPlan
from merge_runner.emulator.scenarios import SCENARIOS
from merge_runner.emulator.server import HOST, Emulator
from merge_runner.errors import MergeRunnerError
from merge_runner.llm.budget import Budget
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.client import LlmClient
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.http import HttpTransport
from merge_runner.llm.ledger import Ledger
from merge_runner.llm.limiter import Limiter
from merge_runner.llm.prices import pricing
from merge_runner.records import Slot, Usage

PRICE = Price(input=2, output=8, source="test")
OUTPUT_CAP, LONG = 16_000, 15_000
PROMPT = "prompt" * 20
CALLS = 8
EVERY = [
    pytest.param(scenario, wire, id=f"{scenario} {wire}")
    for scenario, scenes in SCENARIOS.items()
    for wire in scenes
]
BEFORE_ANY_WORK = (400, 401, 402, 403, 404, 413, 429)


@dataclass
class Till:
    """Bills every request; with ``tells`` an error says in `usage` what was billed for it."""

    wire: str
    tells: bool
    pricing: object
    output_tokens: int | None = None
    usd: float = 0.0
    largest: float = 0.0
    replies: list[int] = field(default_factory=list)

    @web.middleware
    async def middle(self, request, handler):
        most = self.price(len(await request.read()) // 4, OUTPUT_CAP)
        self.usd += most  # until it is known better, or for ever where the connection breaks
        reply = await handler(request)
        body = self.told(reply)
        if body is not None and body is not reply:
            headers = {
                k: v for k, v in reply.headers.items() if k.startswith(("retry", "x-", "ant"))
            }
            reply = web.json_response(body, status=reply.status, headers=headers)
        billed = self.billed(reply, body, most)
        self.usd += billed - most
        self.largest = max(self.largest, billed)
        return reply

    def price(self, tokens_in, tokens_out):
        return self.pricing.cost_usd(Usage(input_tokens=tokens_in, output_tokens=tokens_out))

    def told(self, reply):
        """The body, with what this server adds to it; None where it is no JSON."""
        try:
            body = json.loads(reply.body)
        except (TypeError, ValueError):
            return None
        part = body[0] if isinstance(body, list) else body
        error = reply.status != 200 or "error" in part
        if (error and self.tells) or self.output_tokens:
            part.update(self.usage(self.output_tokens or LONG))
        return body

    def usage(self, tokens):
        if self.wire == GEMINI:
            return {"usageMetadata": {"promptTokenCount": 40, "candidatesTokenCount": tokens}}
        if self.wire == OPENAI[0]:
            return {"usage": {"prompt_tokens": 40, "completion_tokens": tokens}}
        return {"usage": {"input_tokens": 40, "output_tokens": tokens}}

    def billed(self, reply, body, most):
        part = body[0] if isinstance(body, list) else body
        if part is not None:
            cost = self.pricing.cost_usd(FORMATS[self.wire].read(part).usage)
            if cost is not None:
                return cost
        return 0.0 if reply.status in BEFORE_ANY_WORK else most


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("responses")


@pytest.fixture
def cache(folder):
    """One folder for all tests, as to make a durable one takes a while, opened in each loop."""
    cache = ResponseCache(folder)
    yield cache
    cache.close()


def entry_of(wire, **changes):
    fields = {
        "provider": "openai",
        "format": wire,
        "id": MODELS[wire],
        "max_output_tokens": OUTPUT_CAP,
        "price": PRICE,
        "timeout_s": 20,
        "deadline_s": 60,
    }
    return ModelEntry(**fields | changes)


@asynccontextmanager
async def billing(till, faults):
    """An emulator that plays these faults and bills what it does."""
    app = Emulator(faults).app
    app.middlewares.append(till.middle)
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.01)
    await runner.setup()
    await web.TCPSite(runner, HOST, 0).start()
    try:
        yield f"http://{HOST}:{runner.addresses[0][1]}"
    finally:
        await runner.cleanup()


async def asked(cache, till, faults, *, cap, name, calls=CALLS):
    """Ask for samples at once under a cap of so many worst cases; returns client and cap in USD."""
    entry = entry_of(till.wire)
    async with billing(till, faults) as url:
        base_url = f"{url}/v1" if till.wire in OPENAI else url
        transport = HttpTransport(Endpoint("openai", name, base_url, {}), connections=calls)
        client = LlmClient(
            name="my-model",
            entry=entry,
            endpoint=name,
            cache=cache,
            transport=transport,
            limiter=Limiter(),
            pricing=pricing(entry),
        )
        worst = pricing(entry).cost_usd(client._worst_case(client._request(PROMPT, slot(0))))
        client.budget = Budget(Ledger(cache, name), cap_usd=cap * worst, trial_usd=worst)

        async def ask(number):
            try:
                await client.ask(PROMPT, slot(number), order=number)
            except MergeRunnerError:
                pass
            finally:
                client.leave(number)

        try:
            await asyncio.gather(*map(ask, range(calls)))
            await client.drain()
        finally:
            await transport.close()
    return client, cap * worst


def slot(number):
    return Slot("N_0_0", number, "left", 0, 0)


@pytest.mark.parametrize("tells", [False, True], ids=["silent", "telling"])
@pytest.mark.parametrize(("scenario", "wire"), EVERY)
@in_virtual_time
async def test_no_scenario_bills_more_than_the_cap(cache, scenario, wire, tells):
    till = Till(wire, tells, pricing(entry_of(wire)))
    faults = FaultPlan(seed=3, scenarios={scenario: 0.7}, hang_s=600)
    name = f"https://gateway/{scenario}/{wire}/{tells}"
    client, cap_usd = await asked(cache, till, faults, cap=4.5, name=name)
    spending = client.budget.ledger.read()
    assert client.meter.outcomes
    assert till.usd <= cap_usd + 1e-9
    assert till.usd <= spending.committed_usd + 1e-9
