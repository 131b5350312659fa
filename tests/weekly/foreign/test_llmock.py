"""A server that others wrote, and that grades its clients: LLMock, in all four formats."""

import asyncio

import pytest
from llmock.scenarios import Delay, Fail, Match, Reply

from merge_runner.errors import EndpointRefused
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.http import HttpTransport
from merge_runner.providers import Endpoint, ModelEntry
from merge_runner.records import CallFailed, Slot
from tests.support.clients import client_of as a_client
from tests.support.clients import reply_to
from tests.support.harness import FAST, a_model

PASSING = (408, 409, 429, 500, 502, 503, 504, 529)
LASTING = dict.fromkeys((400, 413, 422), CallFailed)
LASTING |= dict.fromkeys((401, 403, 404), EndpointRefused)
PROVIDERS = {"openai-chat": "openai", "openai-responses": "openai"}
PROVIDERS |= {name: name for name in ("gemini", "anthropic")}
KEYS = dict.fromkeys(("OPENAI_API_KEY", "GOOGLE_API_KEY", "ANTHROPIC_API_KEY"), "a-dummy-key")
PLAN = f"M\nI keep my speed.\n```python\n{[0.0] * 20}\n```"
BACKOFF_S = 0.05  # a tenth of ours, so that tests end soon


@pytest.fixture
async def client_of(llmock, tmp_path, monkeypatch):
    """Makes clients of LLMock, one for each format and model."""
    monkeypatch.setenv("SSL_CERT_DIR", str(tmp_path))  # nothing here speaks TLS
    monkeypatch.setattr("merge_runner.llm.delays.FIRST_BACKOFF_S", BACKOFF_S)
    cache = ResponseCache(tmp_path / "responses")
    transports = {
        wire: HttpTransport(Endpoint("openai", wire, llmock.base_url(name), {}), connections=16)
        for wire, name in PROVIDERS.items()
    }

    def make(wire, model, **changes):
        entry = ModelEntry(
            provider="openai", format=wire, id=model, max_output_tokens=100, price="free", **changes
        )
        return a_client(model, entry, wire, cache, transports[wire])

    yield make
    for transport in transports.values():
        await transport.close()
    cache.close()


def ask(client, decision=0):
    # By its body a grader tells a call from another one that is tried again.
    return reply_to(
        client, f"Where do you go at {decision} s?", Slot("N_0_0", 1, "left", decision, 0)
    )


def asks(llmock, model):
    """How often a model was asked."""
    return sum(request.model == model for request in llmock.requests)


async def test_answers_are_read_as_a_foreign_server_writes_them(llmock, client_of):
    endings = {"ok": None, "truncated": "length", "refusal": "content_filter"}
    known = {
        (wire, outcome)
        for wire in PROVIDERS
        for outcome in endings
        if (wire, outcome) != ("openai-responses", "refusal")  # LLMock knows none of these
    }
    for wire, outcome in known:
        model = f"{wire}-{outcome}"
        llmock.add(Reply(PLAN, finish_reason=endings[outcome], match=Match(model=model)))
    for wire, outcome in known:
        reply = await ask(client_of(wire, f"{wire}-{outcome}"))
        assert (wire, reply.outcome, reply.text) == (wire, outcome, PLAN)
        assert reply.attempts[0].usage.input_tokens > 0 < reply.attempts[0].usage.output_tokens


async def test_what_passes_is_tried_again_as_the_server_asks(llmock, client_of):
    clients = {(wire, status): client_of(wire, f"{wire}-{status}")
               for wire in PROVIDERS for status in PASSING}  # fmt: skip
    for wire, status in clients:
        told_s = 0.2 if status in (429, 503, 529) else None
        llmock.add(Fail(status, retry_after=told_s, match=Match(model=f"{wire}-{status}")))
    replies = await asyncio.gather(*map(ask, clients.values()))
    assert {(reply.outcome, len(reply.attempts)) for reply in replies} == {("ok", 2)}
    assert llmock.verdict().faults == len(clients)
    llmock.assert_resilient(strict=True)


async def test_waits_grow_where_the_server_names_none(llmock, client_of):
    llmock.fail(500, times=3)
    reply = await ask(client_of("openai-chat", "m"))
    assert [attempt.http_status for attempt in reply.attempts] == [500, 500, 500, 200]
    llmock.assert_resilient(strict=True)


async def test_what_no_attempt_mends_is_asked_once(llmock, client_of):
    for status in LASTING:
        llmock.add(Fail(status, times=None, match=Match(model=f"*-{status}")))
    for wire in PROVIDERS:
        for status, error in LASTING.items():
            model = f"{wire}-{status}"
            with pytest.raises(error, match=model):
                await ask(client_of(wire, model))
            assert asks(llmock, model) == 1
    llmock.assert_resilient(strict=True)


async def test_an_answer_that_comes_too_late_is_nobodys(llmock, client_of):
    for wire in PROVIDERS:
        llmock.add(Delay(0.6, match=Match(model=wire)), Reply("late", match=Match(model=wire)))
        llmock.add(Reply("in time", times=None, match=Match(model=wire)))
    clients = [client_of(wire, wire, timeout_s=0.3) for wire in PROVIDERS]
    replies = await asyncio.gather(*map(ask, clients))
    later = await asyncio.gather(*(ask(client, decision=1) for client in clients))
    assert {reply.attempts[0].outcome for reply in replies} == {"timeout"}
    assert {reply.text for reply in (*replies, *later)} == {"in time"}


async def test_a_real_quota_costs_few_refusals(llmock, llmock_server, client_of):
    llmock.limits(rpm=240)
    for _ in range(240):
        llmock_server.state.limiter.admit("anthropic", "", 0)  # others used it up
    client = client_of("anthropic", "m")
    replies = await asyncio.gather(*(ask(client, decision) for decision in range(4)))
    assert {reply.outcome for reply in replies} == {"ok"}
    refused = sum(request.status == 429 for request in llmock.requests)
    assert 1 <= refused <= 12
    llmock.assert_resilient(strict=True)


async def test_a_sweep_in_each_format_passes_what_a_foreign_server_breaks(
    llmock, merge_runner, tmp_path
):
    for wire, name in PROVIDERS.items():
        for status in (429, 503):
            llmock.add(Fail(status, retry_after=0.1, match=Match(model=wire)))
        own = {"provider": name, "format": wire, "id": wire, "base_url": llmock.base_url(name)}
        with (tmp_path / "models.toml").open("a") as registry:
            registry.write(a_model(wire, **own))
    llmock.reply(PLAN, times=None)
    one = ("--reps", 1, "--conditions", "R_-4_8", "--json", "--yes", "--trust", *FAST)
    for wire in PROVIDERS:
        places = ("--model", wire, "--db", f"{wire}.duckdb", "--cache", wire)
        run = await merge_runner("sweep", "baseline", *one, *places, code=0, **KEYS)
        assert (run.summary["audit"]["findings"], run.summary["trials"]["failed"]) == ([], 0)
        attempts = run.summary["attempts"]
        assert attempts.keys() == {"ok", "rate_limited", "overloaded"}
        assert (attempts["rate_limited"], attempts["overloaded"]) == (1, 1)
        assert asks(llmock, wire) == sum(attempts.values())
    llmock.assert_resilient(strict=True)
