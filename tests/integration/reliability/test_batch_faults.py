"""A batch server fails in many ways: the digest is the plain run's, no answer is paid twice."""

import asyncio
import json
import re
from collections import Counter

import pytest
from aiohttp import web

from merge_runner.results.store import results_digest
from merge_runner.run.options import Options
from merge_runner.run.plan import make_plan
from tests.support.harness import a_model, run_sweep, watched
from tests.support.mock_server import BatchPlan, FaultPlan
from tests.support.priced import PRICE, answered

FORMATS = {"openai": "openai-chat", "anthropic": "anthropic", "gemini": "gemini"}
BATCH = {"price_factor": 0.5, "source": "made up"}
# One decision of two drivers in 3 conditions: one batch.
STUDY = 'repetitions = 1\nconditions = ["L_4_0", "N_0_0", "R_-4_8"]\n[scenario]\ntimeout_s = 1\n'
LINES = 6
KINDS = {
    "upload": re.compile("POST .*/files"),
    "create": re.compile("POST (/v1/batches|/v1/messages/batches|.*:batchGenerateContent)"),
    "state": re.compile("GET .*/batches/[^/]+"),
    "results": re.compile("GET .*(-output/content|/results|:download)"),
}


def chain(middles):
    """One middleware of several, the last of which asks the emulator."""

    def ask(rest, request, handler):
        if not rest:
            return handler(request)
        return rest[0](request, lambda request: ask(rest[1:], request, handler))

    return lambda request, handler: ask(middles, request, handler)


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


def status(code, **headers):
    """Refuse a request before anything is done."""

    async def answer(request, handler):
        return web.json_response({"error": {"message": "no"}}, status=code, headers=headers)

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


def changed(kind, members):
    """A middleware that changes members of what is said."""

    async def answer(request, handler):
        body = json.loads((await handler(request)).body)
        return web.json_response({**body, **members})

    return first(kind, answer)


def odd(these):
    """Lines in another order, twice, of no key, blank, and of requests that nobody sent."""
    foreign = [re.sub(rb'("custom_id"|"key"): "..', rb'\1: "zz', line) for line in these]
    foreign = [*foreign, foreign[0].replace(b'"zz', b'"yy')]
    return [b"\r\n", *foreign, b"{}\n", *these[::-1], *these, b"\n"]


def with_another_answer(these):
    key = re.search(rb'("custom_id"|"key"): "[^"]+', these[1])[0]
    return [*these, re.sub(rb'("custom_id"|"key"): "[^"]+', key, these[0])]


CANCELLED = {"status": "cancelled"}
FAILED = {"status": "failed", "errors": {"data": [{"code": "server_error", "message": "no"}]}}
# The provider, what stands between, what the emulator does, and how many answers are asked again.
CASES = {
    "500 before an upload and after a creation, a web page at a state, cut results": (
        "openai",
        lambda: (first("upload", status(500)), first("create", failed_after),
                 first("state", no_json), first("results", cut_after), lines(odd)),
        {"failed": 0.4, "late_results": 2}, 0,
    ),
    "500 after an upload, before a creation and at results, expired lines, few tokens": (
        "gemini",
        lambda: (first("upload", failed_after), first("create", status(500)),
                 first("results", status(500)), lines(odd)),
        {"expired": 0.4, "enqueued_tokens": 4_000}, 0,
    ),
    "429 at a creation, 503 at a state, short results that are cut": (
        "anthropic",
        lambda: (first("create", status(429, **{"retry-after": "0"})),
                 first("state", status(503), 2), first("results", cut_after, 2), lines(odd)),
        {"short_results": 1}, 0,
    ),
    "a second answer, a broken line": (
        "openai",
        lambda: (lines(with_another_answer), lines(lambda these: [b"{\n", *these[1:]])), {}, 1,
    ),
    "a missing line": ("anthropic", lambda: (lines(lambda these: these[1:]),), {}, 1),
    "a failed batch": ("openai", lambda: (changed("state", FAILED),), {}, LINES),
    "a cancelled batch": (
        "openai", lambda: (changed("state", CANCELLED),), {"expired": 0.4}, LINES
    ),
    "500 where no mark is": ("anthropic", lambda: (first("create", failed_after),), {}, LINES),
    "a cut upload, no id": (
        "gemini", lambda: (first("upload", cut_before), changed("create", {"name": 7})), {}, 0
    ),
    "a cut creation": ("openai", lambda: (first("create", cut_after),), {}, 0),
    "no answer to creations": ("gemini", tuple, {"lost": 1.0}, 0),
}  # fmt: skip
PLAIN = {}


@pytest.fixture
def play(tmp_path, monkeypatch):
    """Plays a sweep of a provider; returns its digest and the server's counts."""
    brief = {"ENDING_S": 1.0, "ARRIVAL_S": (0.5, 0.5), "SHORTEST_POLL_S": 0.05}
    for name, value in (brief | {"backoff_s": lambda *_: 0.05}).items():
        monkeypatch.setattr(f"merge_runner.llm.batch.lifecycle.{name}", value)

    async def run(provider, middles=(), plan=None, **options):
        fields = {"provider": provider, "format": FORMATS[provider], "price": PRICE, "batch": BATCH}
        (tmp_path / "models.toml").write_text(a_model("model", **fields))
        (tmp_path / "study.toml").write_text(STUDY)
        async with watched(chain(middles), plan) as server:
            for name, value in server.account.items():
                monkeypatch.setenv(name, value)
            plan = make_plan(str(tmp_path / "study.toml"), "model", trust=True)
            db = tmp_path / f"{len([*tmp_path.iterdir()])}.duckdb"
            settings = Options(db, db.with_suffix(""), quiet=True, **options)
            outcome = await run_sweep(plan, settings, say=[].append)
            counts = await answered(server)
        assert outcome["exit_code"] == 0, outcome["messages"]
        return results_digest(db), sum(counts, Counter()).total()

    return run


@pytest.mark.parametrize("case", CASES)
async def test_no_fault_of_a_batch_server_changes_a_result(play, case):
    provider, middles, plan, again = CASES[case]
    if provider not in PLAIN:
        PLAIN[provider], *_ = await play(provider)
    faults = FaultPlan(seed=1, batch=BatchPlan(**{"delay_s": 0.2, **plan}))
    digest, count = await play(provider, middles(), faults, batch=True, max_cost_usd=5)
    assert digest == PLAIN[provider]
    assert count <= LINES + again


async def test_a_trial_begins_where_one_ends_if_no_more_may_be_under_way(play, monkeypatch):
    monkeypatch.setattr("merge_runner.run.players.MOST_IN_ROUNDS", 1)
    digest, count = await play("openai", batch=True)
    assert (digest, count) == await play("openai")
