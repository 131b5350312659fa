"""A batch server fails in over 30 ways: the digest is the plain run's, no answer is paid twice.

Each fault is played in this process, at a provider's own addresses.
"""

from __future__ import annotations

import asyncio
import json
import re
from collections import Counter

import httpx
import pytest
from aiohttp import web

from merge_runner.results.store import results_digest
from merge_runner.run.plan import Options, make_plan
from tests.support.harness import run_sweep, watched
from tests.support.mock_server import BatchPlan, FaultPlan

FORMATS = {"openai": "openai-chat", "anthropic": "anthropic", "gemini": "gemini"}
REGISTRY = """
[model]
provider = "{provider}"
format = "{format}"
id = "some-model"
max_output_tokens = 4000
price = {{ input = 2.0, output = 8.0, source = "made up" }}
batch = {{ price_factor = 0.5, source = "made up" }}
"""
# One decision of two drivers in 11 conditions: one batch.
STUDY = "[repetitions]\nbaseline = 1\n[scenario]\ntimeout_s = 1\n"
LINES = 22
KINDS = {
    "upload": re.compile("POST .*/files"),
    "create": re.compile("POST (/v1/batches|/v1/messages/batches|.*:batchGenerateContent)"),
    "state": re.compile("GET .*/batches/[^/]+"),
    "results": re.compile("GET .*(-output/content|/results|:download)"),
}
pytestmark = pytest.mark.slow


def lines(change):
    """A middleware that changes the lines of results."""

    async def middle(request, handler):
        reply = await handler(request)
        if KINDS["results"].fullmatch(f"GET {request.path}") and reply.status == 200:
            reply.body = b"".join(change(reply.body.splitlines(keepends=True)))
        return reply

    return middle


def first(kind, answer, times=1):
    """A middleware that lets ``answer`` reply to the first requests of a kind."""
    count = Counter()

    async def middle(request, handler):
        if KINDS[kind].fullmatch(f"{request.method} {request.path}"):
            count[kind] += 1
            if count[kind] <= times:
                return await answer(request, handler)
        return await handler(request)

    return middle


def status(code, body=None, **headers):
    """Refuse a request before anything is done."""

    async def answer(request, handler):
        return web.json_response(body or {"error": {"message": "no"}}, status=code, headers=headers)

    return answer


async def failed_after(request, handler):
    """Do what is asked, and say that it failed."""
    await handler(request)
    return web.json_response({"error": {"message": "no"}}, status=500)


async def cut_before(request, handler):
    request.transport.abort()
    return web.Response()


async def cut_after(request, handler):
    """Send half of the reply."""
    whole = (await handler(request)).body
    response = web.StreamResponse()
    response.content_length = len(whole)
    await response.prepare(request)
    await response.write(whole[: len(whole) // 2])
    await asyncio.sleep(0.05)
    request.transport.abort()
    return response


async def no_json(request, handler):
    return web.Response(text="<html>welcome</html>", content_type="text/html")


def goes_back():
    """A middleware that shows the state of the creation once more after the end was shown."""
    created, ended = {}, set()

    async def middle(request, handler):
        reply = await handler(request)
        if "json" not in reply.content_type or request.path.startswith("/emulator"):
            return reply
        body, batch = json.loads(reply.body), request.path.rpartition("/")[2]
        if request.method == "POST":
            created[body.get("name", body.get("id", "")).rpartition("/")[2]] = body
        elif batch in ended and batch in created:
            return web.json_response(created.pop(batch))
        elif {body.get("status"), body.get("processing_status"), body.get("done")} & {
            "completed", "ended", True
        }:  # fmt: skip
            ended.add(batch)
        return reply

    return middle


def changed(kind, members, times=1):
    """A middleware that changes members of what is said."""

    async def answer(request, handler):
        body = json.loads((await handler(request)).body)
        return web.json_response({**body, **members})

    return first(kind, answer, times)


async def cancelled(request, handler):
    """Let somebody else cancel the batch, half of which is answered."""
    await handler(request)
    async with httpx.AsyncClient() as client:
        await client.post(f"http://{request.host}{request.path}/cancel")
    return await handler(request)


def with_foreign(these):
    foreign = [re.sub(rb'("custom_id"|"key"): "..', rb'\1: "zz', line) for line in these]
    return [*foreign, foreign[0].replace(b'"zz', b'"yy'), *these]


def with_another_answer(these):
    another = re.sub(rb'("custom_id"|"key"): "[^"]+', these_key(these[1]), these[0])
    return [*these, another]


def these_key(line):
    return re.search(rb'("custom_id"|"key"): "[^"]+', line)[0]


FAILED = {"status": "failed", "errors": {"data": [{"code": "server_error", "message": "no"}]}}
EVERYWHERE = {
    "any order": (lambda: lines(lambda these: these[::-1]), {}, 0),
    "a line twice": (lambda: lines(lambda these: [these[0], *these]), {}, 0),
    "foreign lines": (lambda: lines(with_foreign), {}, 0),
    "a state that goes back": (goes_back, {}, 0),
}
# The provider, what stands between, what the emulator does, and how many answers are asked again.
FAULTS = {
    "all lines twice": ("gemini", lambda: lines(lambda these: these + these), {}, 0),
    "a second answer": ("openai", lambda: lines(with_another_answer), {}, 0),
    "a missing line": ("anthropic", lambda: lines(lambda these: these[1:]), {}, 1),
    "a broken line": ("openai", lambda: lines(lambda these: [b"{\n", *these[1:]]), {}, 1),
    "a line of no key": ("gemini", lambda: lines(lambda these: [*these, b"{}\n"]), {}, 0),
    "blank lines": ("anthropic", lambda: lines(lambda these: [b"\r\n", *these, b"\n"]), {}, 0),
    "failed lines": ("openai", None, {"failed": 0.4}, 0),
    "expired lines": ("gemini", None, {"expired": 0.4}, 0),
    "all expired": ("anthropic", None, {"expired": 1.0}, 0),
    "a failed batch": ("openai", lambda: changed("state", FAILED), {}, LINES),
    "a cancelled batch": ("openai", lambda: first("state", cancelled), {"polls": 2}, 0),
    "500 before an upload": ("openai", lambda: first("upload", status(500)), {}, 0),
    "500 after an upload": ("gemini", lambda: first("upload", failed_after), {}, 0),
    "500 before a creation": ("gemini", lambda: first("create", status(500)), {}, 0),
    "500 after a creation": ("openai", lambda: first("create", failed_after), {}, 0),
    "500 where no mark is": ("anthropic", lambda: first("create", failed_after), {}, LINES),
    "429 at a creation": (
        "anthropic", lambda: first("create", status(429, **{"retry-after": "1"})), {}, 0
    ),
    "a cut upload": ("gemini", lambda: first("upload", cut_before), {}, 0),
    "a cut creation": ("openai", lambda: first("create", cut_after), {}, 0),
    "no id": ("gemini", lambda: changed("create", {"name": 7}), {}, 0),
    "no answer to creations": ("gemini", None, {"lost": 1.0}, 0),
    "503 at a state": ("anthropic", lambda: first("state", status(503), 2), {}, 0),
    "a web page at a state": ("openai", lambda: first("state", no_json), {}, 0),
    "cut results": ("openai", lambda: first("results", cut_after), {}, 0),
    "cut results twice": ("anthropic", lambda: first("results", cut_after, 2), {}, 0),
    "500 at results": ("gemini", lambda: first("results", status(500)), {}, 0),
    "late results": ("openai", None, {"late_results": 2}, 0),
    "short results": ("anthropic", None, {"short_results": 1}, 0),
    "few tokens": ("gemini", None, {"enqueued_tokens": 14_000}, 0),
}  # fmt: skip
CASES = [
    *(pytest.param(name, provider, *fault, id=f"{provider}: {name}")
      for name, fault in EVERYWHERE.items() for provider in FORMATS),
    *(pytest.param(name, provider, *fault, id=f"{provider}: {name}")
      for name, (provider, *fault) in FAULTS.items()),
]  # fmt: skip
PLAIN = {}


@pytest.fixture
def play(tmp_path, monkeypatch):
    """Plays a sweep of a provider; returns its digest and the server's counts."""
    monkeypatch.setattr("merge_runner.llm.batch.rounds.ENDING_S", 2.0)
    monkeypatch.setattr("merge_runner.llm.batch.rounds.ARRIVAL_S", (1.0, 1.0))

    async def run(provider, middle=None, plan=None, **options):
        registry = REGISTRY.format(provider=provider, format=FORMATS[provider])
        (tmp_path / "models.toml").write_text(registry)
        (tmp_path / "study.toml").write_text(STUDY)
        async with watched(middle, plan) as server:
            for name in ("OPENAI", "ANTHROPIC", "GEMINI"):
                monkeypatch.setenv(f"{name}_API_KEY", "a-dummy-key")
            monkeypatch.setenv("OPENAI_BASE_URL", f"{server.url}/v1")
            monkeypatch.setenv("ANTHROPIC_BASE_URL", server.url)
            monkeypatch.setenv("GOOGLE_GEMINI_BASE_URL", server.url)
            plan = make_plan(str(tmp_path / "study.toml"), "model", trust=True)
            db = tmp_path / f"{len([*tmp_path.iterdir()])}.duckdb"
            settings = Options(db, db.with_suffix(""), quiet=True, **options)
            outcome = await run_sweep(plan, settings, say=[].append)
            async with httpx.AsyncClient() as client:
                counts = (await client.get(f"{server.url}/emulator/answered")).json()
        assert outcome["exit_code"] == 0, outcome["messages"]
        return results_digest(db), counts

    return run


@pytest.mark.parametrize(("name", "provider", "middle", "plan", "again"), CASES)
async def test_no_fault_of_a_batch_server_changes_a_result(
    play, name, provider, middle, plan, again
):
    if provider not in PLAIN:
        PLAIN[provider], *_ = await play(provider)
    faults = FaultPlan(seed=1, batch=BatchPlan(**{"delay_s": 0.2, **plan}))
    digest, counts = await play(provider, middle and middle(), faults, batch=True, max_cost_usd=5)
    assert digest == PLAIN[provider]
    assert sum(each["answered"] for each in counts) <= LINES + again
