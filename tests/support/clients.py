"""A client whose server answers as a test says, in the test's process."""

import asyncio
import json
import sqlite3

import pytest

from merge_runner.drivers.language_model import Question
from merge_runner.llm.budget import Budget
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.call import Calls
from merge_runner.llm.client import LlmClient
from merge_runner.llm.endpoint_state import EndpointState
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.http_outcome import RawReply
from merge_runner.llm.ledger import Cap, Ledger
from merge_runner.llm.limiter import Limiter
from merge_runner.llm.sender import DirectSender
from merge_runner.providers import ModelEntry, Price
from merge_runner.records import Slot
from tests.support.virtual_time import now_s

PRICE = Price(input=2.0, output=8.0, source="contract")


class Server:
    """Stands in for the network: gives its replies in order, the last one for ever."""

    def __init__(self, *replies):
        self.replies = list(replies)
        self.sent, self.times, self.timeouts = [], [], []
        self.answered = 0
        self.open = asyncio.Event()
        self.open.set()

    async def send(self, request, *, attempt, timeout_s):
        self.sent.append(request)
        self.times.append(now_s())
        self.timeouts.append(timeout_s)
        reply = self.replies.pop(0) if len(self.replies) > 1 else self.replies[0]
        await self.open.wait()
        self.answered += 1
        if isinstance(reply, Exception):
            raise reply
        return reply


def raw(body, status=200, **headers):
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return RawReply(status, named, body if isinstance(body, str) else json.dumps(body))


def answer(text="M", finish="stop", model="m-1", usage=(10, 5), **message):
    choice = {"message": {"content": text, **message}, "finish_reason": finish}
    told = {"usage": {"prompt_tokens": usage[0], "completion_tokens": usage[1]}} if usage else {}
    return raw({"model": model, "choices": [choice]} | told)


def error(status, message="m", code=None, **headers):
    return raw({"error": {"message": message, "type": code, "code": code}}, status, **headers)


def slot(repetition=1, side="left", decision=0):
    return Slot("A1", repetition, side, decision, 0)


async def reply_to(client, prompt, slot, *, order=0):
    """The reply by which a question would be decided."""
    question = Question(client.endpoint.name, slot, prompt, None, lambda _, reply: reply)
    return await client.answer(question, order=order)


async def ticks(count=20):
    """Let everybody run who can without time passing."""
    for _ in range(count):
        await asyncio.sleep(0)


async def begun(job):
    """A job under way, after everybody could run."""
    task = asyncio.create_task(job)
    await ticks()
    return task


@pytest.fixture(scope="session")
def opened(tmp_path_factory):
    """One folder for all tests: to make a durable one takes a while."""
    cache = ResponseCache(tmp_path_factory.mktemp("responses"))
    yield cache
    cache.close()


@pytest.fixture
def cache(opened):
    with sqlite3.connect(opened.folder / "cache.db") as database:
        for table in ("Cache", "open", "spent"):
            database.execute(f"DELETE FROM {table}")
    return opened


def budget_of(ledger, cap_usd=None, *trial_usd):
    """The budget of a ledger under a cap in USD."""
    ledger.cap = None if cap_usd is None else Cap(cap_usd)
    return Budget(ledger, *trial_usd)


def client_of(
    name, entry, identity, cache, transport, *, limiter=None, budget=None, batch=None, calls=None,
    verified=True, has_answered=False,
):  # fmt: skip
    """A client of a model at an endpoint; without a budget it costs nothing."""
    wire = FORMATS[entry.format]
    return LlmClient(
        EndpointState(name, entry, identity, wire, verified, has_answered),
        cache,
        DirectSender(entry, wire, transport, limiter or Limiter()),
        budget or Budget(Ledger(cache, "")),
        batch,
        calls=calls or Calls(),
    )


@pytest.fixture
def make(cache):
    """A client whose server gives these replies."""

    def make(*replies, limiter=None, cap=None, cache=cache, calls=None, **changes):
        seen = {name: changes.pop(name) for name in ("verified", "has_answered") if name in changes}
        fields = {"provider": "openai", "format": "openai-chat", "id": "m-1", "price": "free"}
        entry = ModelEntry(**{**fields, "max_output_tokens": 100, **changes})
        entry = entry.with_place("[my-model] in models.toml")
        paid = None if entry.price == "free" else budget_of(Ledger(cache, "test"), cap)
        return client_of(
            "my-model", entry, "openai", cache, Server(*replies),
            limiter=limiter, budget=paid, calls=calls, **seen,
        )  # fmt: skip

    return make
