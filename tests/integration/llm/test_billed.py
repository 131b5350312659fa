"""What a server bills never passes the cap, and the ledger knows of it, in every scenario.

A client with a cap asks an emulator that bills as much as an honest server could: what a reply
tells in `usage`, and the whole output cap for each request that no reply shows to be free.
"""

import asyncio
import contextlib
import itertools
import json
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from aiohttp import web

from merge_runner.config import Endpoint, ModelEntry, Price
from merge_runner.errors import MergeRunnerError
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.client import LlmClient
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.http import HttpTransport
from merge_runner.llm.ledger import Budget, Ledger, cost_usd
from merge_runner.llm.limiter import Limiter
from merge_runner.records import Slot, Usage, canonical_json
from tests.integration.llm.test_scenarios import (  # noqa: F401 # fixtures
    GEMINI,
    MODELS,
    OPENAI,
    _idle_connections_grow_old_in_virtual_time,
)
from tests.support.harness import each
from tests.support.mock_server import FaultPlan
from tests.support.scenarios import SCENARIOS, ScenarioPlan, playing
from tests.support.virtual_time import in_virtual_time

PRICE = Price(input=2, output=8, source="test")
OUTPUT_CAP, LONG = 16_000, 15_000
PROMPT = "prompt" * 20
CALLS = 8
# Each scenario in one of its formats; in every second case an error tells what is billed.
PLAYED = [
    (scenario, list(scenes)[number % len(scenes)])
    for number, (scenario, scenes) in enumerate(SCENARIOS.items())
]
TELLS = {True: "telling", False: "silent"}
EVERY = [
    pytest.param(
        scenario, wire, bool(number % 2), id=f"{scenario} {wire} {TELLS[bool(number % 2)]}"
    )
    for number, (scenario, wire) in enumerate(PLAYED)
]
BEFORE_ANY_WORK = (400, 401, 402, 403, 404, 413, 429)


@dataclass
class Till:
    """Bills every request; with ``tells`` an error says in `usage` what was billed for it."""

    wire: str
    tells: bool
    entry: ModelEntry
    writes: Iterator[int] | None = None
    usd: float = 0.0

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
        return reply

    def price(self, tokens_in, tokens_out):
        return cost_usd(self.entry, Usage(input_tokens=tokens_in, output_tokens=tokens_out))

    def told(self, reply):
        """The body, with what this server adds to it; None where it is no JSON."""
        try:
            body = json.loads(reply.body)
        except (TypeError, ValueError):
            return None
        part = body[0] if isinstance(body, list) else body
        error = reply.status != 200 or "error" in part
        if (error and self.tells) or self.writes:
            part.update(self.usage(next(self.writes) if self.writes else LONG))
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
            cost = cost_usd(self.entry, FORMATS[self.wire].read(part).usage)
            if cost is not None:
                return cost
        return 0.0 if reply.status in BEFORE_ANY_WORK else most


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("responses")


@pytest.fixture(scope="module")
def shares():
    """What part of its cap each case was billed; `pytest -s` shows the largest."""
    found = {}
    yield found
    if found:
        worst = max(found, key=found.get)
        print(f"\n{len(found)} cases, billed at most {found[worst]:.1%} of the cap: {worst}")  # noqa: T201


@pytest.fixture
def cache(folder):
    """One folder for all tests, as to make a durable one takes a while, opened in each loop."""
    cache = ResponseCache(folder)
    yield cache
    cache.close()


def entry_of(wire):
    return ModelEntry(
        provider="openai",
        format=wire,
        id=MODELS[wire],
        max_output_tokens=OUTPUT_CAP,
        price=PRICE,
        timeout_s=20,
        deadline_s=60,
    )


async def asked(cache, till, faults, *, cap, name, calls=CALLS, passed=True):
    """Ask for samples at once under a cap of so many worst cases; returns client and cap in USD."""
    entry = entry_of(till.wire)
    sent = canonical_json(FORMATS[till.wire].request(entry, PROMPT).body).encode()
    worst = cost_usd(entry, Usage(input_tokens=len(sent), output_tokens=entry.max_output_tokens))
    async with playing(faults, till.middle) as url:
        base_url = f"{url}/v1" if till.wire in OPENAI else url
        transport = HttpTransport(Endpoint("openai", name, base_url, {}), connections=calls)
        client = LlmClient(
            name="my-model",
            entry=entry,
            endpoint=name,
            cache=cache,
            transport=transport,
            limiter=Limiter(),
            budget=Budget(Ledger(cache, name), cap * worst, each(worst)),
            passed=passed,
        )

        async def ask(number):
            with contextlib.suppress(MergeRunnerError):
                await client.ask(PROMPT, Slot("N_0_0", number, "left", 0, 0), order=number)
            client.money.leave(number)

        try:
            await asyncio.gather(*map(ask, range(calls)))
            await client.drain()
        finally:
            await transport.close()
    return client, cap * worst


@pytest.mark.parametrize(("scenario", "wire", "tells"), EVERY)
@in_virtual_time
async def test_no_scenario_bills_more_than_the_cap(cache, shares, scenario, wire, tells):
    till = Till(wire, tells, entry_of(wire))
    faults = ScenarioPlan(seed=3, scenario=scenario, rate=0.7, hang_s=600)
    name = f"https://gateway/{scenario}/{wire}/{tells}"
    client, cap_usd = await asked(cache, till, faults, cap=4.5, name=name)
    spending = client.budget.ledger.read()
    assert client.meter.outcomes
    shares[f"{scenario} {wire}{' with usage' if tells else ''}"] = till.usd / cap_usd
    assert till.usd <= cap_usd + 1e-9
    assert till.usd <= spending.committed_usd + 1e-9


def after(honest, *dear):
    """So many replies within the cap, and then longer ones."""
    return itertools.chain(itertools.repeat(1_000, honest), itertools.cycle(dear))


@pytest.mark.parametrize("wire", MODELS)
@pytest.mark.parametrize(
    ("honest", "dear", "from_now_on"),
    [
        pytest.param(0, [19_500], 1.2, id="always a fifth too long"),
        pytest.param(0, [64_000], 4.0, id="always four times too long"),
        pytest.param(5, [31_000], 1.9, id="after honest ones"),
        pytest.param(2, [17_000, 20_000, 25_000, 40_000], 2.5, id="ever longer"),
    ],
)
@in_virtual_time
async def test_a_server_that_ignores_the_output_cap_does_not_pass_the_other_one(
    cache, shares, wire, honest, dear, from_now_on
):
    till = Till(wire, tells=False, entry=entry_of(wire), writes=after(honest, *dear))
    more = {"name": f"https://endless/{from_now_on}/{wire}", "calls": 60, "passed": False}
    client, cap_usd = await asked(cache, till, FaultPlan(), cap=10.5, **more)
    spending = client.budget.ledger.read()
    shares[f"output cap ignored, {from_now_on} times, {wire}"] = till.usd / cap_usd
    assert 0.6 * cap_usd < till.usd <= cap_usd
    assert spending.spent_usd == pytest.approx(till.usd)
    assert spending.overruns[client.driver] == pytest.approx(from_now_on, rel=0.05)
    assert any("does not keep to the cap of 16000 output" in note for note in client.meter.notes)


@pytest.mark.parametrize("wire", MODELS)
@in_virtual_time
async def test_the_last_reply_alone_can_pass_the_cap_and_nothing_is_asked_after_it(cache, wire):
    till = Till(wire, tells=False, entry=entry_of(wire), writes=after(3, 64_000))
    name = f"https://at-the-end/{wire}"
    client, cap_usd = await asked(cache, till, FaultPlan(), cap=1.5, name=name, passed=False)
    dearest = till.price(40, 64_000)
    assert cap_usd < till.usd < cap_usd + dearest
    assert client.meter.outcomes.total() == 4
