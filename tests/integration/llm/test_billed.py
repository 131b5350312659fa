"""What a server bills never passes the cap, and the ledger knows of it, in every scenario.

A client with a cap asks an emulator that bills as much as an honest server could: what a reply
tells in `usage`, and the whole output cap for each request that no reply shows to be free.
"""

import asyncio
import contextlib
import itertools
import json

import pytest
from aiohttp import web

from merge_runner.errors import MergeRunnerError
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.http import HttpTransport
from merge_runner.llm.ledger import Ledger
from merge_runner.llm.prices import cost_usd
from merge_runner.providers import Endpoint, ModelEntry, Price
from merge_runner.records import Slot, Usage, canonical_json
from tests.support.clients import budget_of, client_of, reply_to
from tests.support.harness import each
from tests.support.mock_server import FaultPlan
from tests.support.scenarios import GEMINI, MODELS, OPENAI, SCENARIOS, ScenarioPlan, playing
from tests.support.virtual_time import in_virtual_time

PRICE = Price(input=2, output=8, source="test")
OUTPUT_CAP, LONG = 16_000, 15_000
PROMPT = "prompt" * 20
CALLS = 8
EVERY = [
    (scenario, list(scenes)[number % len(scenes)], bool(number % 2))
    for number, (scenario, scenes) in enumerate(SCENARIOS.items())
]
BEFORE_ANY_WORK = (400, 401, 402, 403, 404, 413, 429)


class Till:
    """Bills every request; with ``tells`` an error says in `usage` what was billed for it."""

    def __init__(self, wire, tells=False, writes=None):
        self.wire, self.tells, self.writes, self.usd = wire, tells, writes, 0.0
        named = {"provider": "openai", "format": wire, "id": MODELS[wire], "price": PRICE}
        limits = {"max_output_tokens": OUTPUT_CAP, "timeout_s": 20, "deadline_s": 60}
        self.entry = ModelEntry(**named, **limits)

    @web.middleware
    async def middle(self, request, handler):
        most = self.price(len(await request.read()) // 4, OUTPUT_CAP)
        self.usd += most  # until it is known better, or for ever where the connection breaks
        reply = await handler(request)
        try:
            body = json.loads(reply.body)
        except (TypeError, ValueError):
            self.usd -= most if reply.status in BEFORE_ANY_WORK else 0
            return reply
        part = body[0] if isinstance(body, list) else body
        error = reply.status != 200 or "error" in part
        if (error and self.tells) or self.writes:
            part.update(self.usage(next(self.writes) if self.writes else LONG))
        cost = cost_usd(self.entry, FORMATS[self.wire].read(part).usage)
        free = 0.0 if reply.status in BEFORE_ANY_WORK else most
        self.usd += (free if cost is None else cost) - most
        kept = {k: v for k, v in reply.headers.items() if k.startswith(("retry", "x-", "ant"))}
        return web.json_response(body, status=reply.status, headers=kept)

    def price(self, tokens_in, tokens_out):
        return cost_usd(self.entry, Usage(input_tokens=tokens_in, output_tokens=tokens_out))

    def usage(self, tokens):
        if self.wire == GEMINI:
            return {"usageMetadata": {"promptTokenCount": 40, "candidatesTokenCount": tokens}}
        if self.wire == OPENAI[0]:
            return {"usage": {"prompt_tokens": 40, "completion_tokens": tokens}}
        return {"usage": {"input_tokens": 40, "output_tokens": tokens}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("responses")


@pytest.fixture
def cache(folder):
    """One folder for all tests, as to make a durable one takes a while, opened in each loop."""
    cache = ResponseCache(folder)
    yield cache
    cache.close()


async def asked(cache, till, faults, *, cap, name, calls=CALLS, verified=True):
    """Ask for samples at once under a cap of so many worst cases; returns client and cap in USD."""
    sent = canonical_json(FORMATS[till.wire].request(till.entry, PROMPT).body).encode()
    worst = till.price(len(sent), OUTPUT_CAP)
    async with playing(faults, till.middle) as url:
        base_url = f"{url}/v1" if till.wire in OPENAI else url
        transport = HttpTransport(Endpoint("openai", name, base_url, {}), connections=calls)
        budget = budget_of(Ledger(cache, name), cap * worst, each(worst))
        client = client_of(
            "my-model", till.entry, name, cache, transport, budget=budget, verified=verified
        )

        async def ask(number):
            with contextlib.suppress(MergeRunnerError):
                await reply_to(client, PROMPT, Slot("N_0_0", number, "left", 0, 0), order=number)
            client.budget.leave(number)

        try:
            await asyncio.gather(*map(ask, range(calls)))
            await client.calls.drain()
        finally:
            await transport.close()
    return client, cap * worst


@pytest.mark.parametrize(("scenario", "wire", "tells"), EVERY)
@in_virtual_time
async def test_no_scenario_bills_more_than_the_cap(cache, scenario, wire, tells):
    till = Till(wire, tells)
    faults = ScenarioPlan(seed=3, scenario=scenario, rate=0.7, hang_s=600)
    name = f"https://gateway/{scenario}/{wire}/{tells}"
    client, cap_usd = await asked(cache, till, faults, cap=4.5, name=name)
    assert client.meter.outcomes
    assert till.usd <= cap_usd + 1e-9
    assert till.usd <= client.budget.ledger.read().committed_usd + 1e-9


def after(honest, *dear):
    """So many replies within the cap, and then longer ones."""
    return itertools.chain(itertools.repeat(1_000, honest), itertools.cycle(dear))


@pytest.mark.parametrize("wire", MODELS)
@pytest.mark.parametrize(
    ("honest", "dear", "from_now_on"),
    [
        (0, [19_500], 1.2),
        (0, [64_000], 4.0),
        (5, [31_000], 1.9),
        (2, [17_000, 20_000, 25_000, 40_000], 2.5),
    ],
)
@in_virtual_time
async def test_a_server_that_ignores_the_output_cap_does_not_pass_the_other_one(
    cache, wire, honest, dear, from_now_on
):
    till = Till(wire, writes=after(honest, *dear))
    more = {"name": f"https://endless/{from_now_on}/{wire}", "calls": 60, "verified": False}
    client, cap_usd = await asked(cache, till, FaultPlan(), cap=10.5, **more)
    spending = client.budget.ledger.read()
    assert 0.6 * cap_usd < till.usd <= cap_usd
    assert spending.spent_usd == pytest.approx(till.usd)
    assert spending.overruns[client.endpoint.driver] == pytest.approx(from_now_on, rel=0.05)
    assert any("does not keep to the cap of 16000 output" in note for note in client.meter.notes)


@pytest.mark.parametrize("wire", MODELS)
@in_virtual_time
async def test_the_last_reply_alone_can_pass_the_cap_and_nothing_is_asked_after_it(cache, wire):
    till = Till(wire, writes=after(3, 64_000))
    name = f"https://at-the-end/{wire}"
    client, cap_usd = await asked(cache, till, FaultPlan(), cap=1.5, name=name, verified=False)
    assert cap_usd < till.usd < cap_usd + till.price(40, 64_000)
    assert client.meter.outcomes.total() == 4
