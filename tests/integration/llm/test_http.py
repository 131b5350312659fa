from __future__ import annotations

import asyncio
import contextlib
import gzip
import json
import socket
from base64 import b64encode
from dataclasses import replace
from urllib.parse import unquote

import pytest
from aiohttp import web

from merge_runner.config import Endpoint, ModelEntry, ScenarioConfig, resolve_endpoint
from merge_runner.emulator.driver import answer
from merge_runner.errors import UsageError
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.client import LlmClient
from merge_runner.llm.http import Connections, HttpTransport
from merge_runner.llm.http_outcome import TransportFailure
from merge_runner.llm.limiter import Limiter
from merge_runner.prompts.blocks import prompt_of, render_prompt
from merge_runner.prompts.parse import parse_reply
from merge_runner.records import Slot, call_key, canonical_json, make_request
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from tests.support.mock_server import FaultPlan, serve

SLOT = Slot("N_0_0", 1, "left", 0, 0)
KEY = "sk-dummy-0123456789"
PROXIES = ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "NO_PROXY")


@pytest.fixture(autouse=True)
def _no_settings_of_the_user(monkeypatch, tmp_path):
    for name in PROXIES:
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.lower(), raising=False)
    # Nothing here speaks TLS, and to load the certificates takes longer than most of the tests.
    monkeypatch.delenv("SSL_CERT_FILE", raising=False)
    monkeypatch.setenv("SSL_CERT_DIR", str(tmp_path))


class Recorder:
    """A server that keeps what it is sent and answers with ``reply``, made from the request."""

    def __init__(self):
        self.requests = []
        self.bodies = []
        self.url = ""
        self.reply = lambda request: web.json_response({"ok": True})

    async def handle(self, request):
        self.requests.append(request)
        self.bodies.append(await request.read())
        reply = self.reply(request)
        return await reply if asyncio.iscoroutine(reply) else reply


@pytest.fixture
async def recorder():
    kept = Recorder()
    app = web.Application()
    app.router.add_route("*", "/{path:.*}", kept.handle)
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.1)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", 0).start()
    kept.url = f"http://127.0.0.1:{runner.addresses[0][1]}"
    yield kept
    await runner.cleanup()


@pytest.fixture
async def emulator():
    runners = []

    async def start(faults=None):
        runner, url = await serve(0, faults)
        runners.append(runner)
        return url

    yield start
    for runner in runners:
        await runner.cleanup()


@pytest.fixture
def dead_port():
    """A port of loopback at which nobody listens, reserved so that nobody begins to."""
    with socket.socket() as reserved:
        reserved.bind(("127.0.0.1", 0))
        yield reserved.getsockname()[1]


def request_for(body=None, slot=SLOT, **changes):
    request = make_request(
        provider="openai",
        endpoint="openai",
        model="some-model",
        path="/chat/completions",
        headers={"anthropic-version": "2023-06-01"},
        body=body or {"prompt": "Gr\u00fc\u00dfe, \u2212 \U0001f697", "a": 1.0},
        slot=slot,
    )
    return replace(request, **changes)


def endpoint_at(url, provider="openai", identity=None, auth_headers=None):
    return Endpoint(provider, identity or provider, url, auth_headers or {})


@contextlib.asynccontextmanager
async def transport_to(endpoint, connections=2):
    transport = HttpTransport(endpoint, connections=connections)
    try:
        yield transport
    finally:
        await transport.close()


async def send(endpoint, request=None, *, attempt=1, timeout_s=10.0):
    async with transport_to(endpoint) as transport:
        return await transport.send(request or request_for(), attempt=attempt, timeout_s=timeout_s)


@contextlib.asynccontextmanager
async def server_that_says(raw):
    """The URL of a server that answers with these bytes, whatever they are, and hangs up."""

    async def talk(reader, writer):
        await reader.readuntil(b"\r\n\r\n")
        writer.write(raw)
        await writer.drain()
        writer.close()

    server = await asyncio.start_server(talk, "127.0.0.1", 0)
    async with server:
        yield f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}"


async def test_it_posts_exactly_the_bytes_that_were_hashed(recorder):
    request = request_for()
    await send(endpoint_at(f"{recorder.url}/v1"), request)
    (got,), (body,) = recorder.requests, recorder.bodies
    assert got.method == "POST"
    assert got.path == "/v1/chat/completions"
    assert body == request.body.encode()
    assert got.headers["content-type"] == "application/json"
    # The key can be computed from what the server got.
    assert request.key == call_key(
        endpoint="openai",
        path=request.path,
        headers={"anthropic-version": got.headers["anthropic-version"]},
        body=body.decode(),
        slot=SLOT,
    )


async def test_it_returns_status_lower_case_headers_and_text(recorder):
    recorder.reply = lambda request: web.Response(
        status=418,
        body='{"text": "Gr\u00fc\u00dfe"}'.encode(),
        headers={"Retry-After": "7", "X-Should-Retry": "true"},
        content_type="application/json",
    )
    reply = await send(endpoint_at(recorder.url))
    assert reply.status == 418
    assert reply.body == '{"text": "Gr\u00fc\u00dfe"}'
    assert (reply.headers["retry-after"], reply.headers["x-should-retry"]) == ("7", "true")
    assert all(name == name.lower() for name in reply.headers)


async def test_it_reads_a_compressed_reply(recorder):
    recorder.reply = lambda request: web.Response(
        body=gzip.compress(b'{"ok": true}'), headers={"content-encoding": "gzip"}
    )
    assert (await send(endpoint_at(recorder.url))).body == '{"ok": true}'


async def test_the_emulator_is_told_slot_and_attempt(recorder):
    await send(endpoint_at(recorder.url, "emulator"), attempt=3)
    (got,) = recorder.requests
    assert got.headers["x-merge-runner-slot"] == canonical_json(SLOT.as_dict())
    assert got.headers["x-merge-runner-attempt"] == "3"


@pytest.mark.parametrize(
    ("provider", "identity"),
    [
        *((name, None) for name in ("openai", "gemini", "anthropic", "openrouter", "local")),
        ("local", "http://127.0.0.1/v1"),
    ],
)
async def test_nobody_else_is_told_the_slot(recorder, provider, identity):
    await send(endpoint_at(recorder.url, provider, identity), attempt=3)
    (got,) = recorder.requests
    assert not [name for name in got.headers if "merge-runner" in name.lower()]
    assert "N_0_0" not in str(got.headers) + recorder.bodies[0].decode()


@pytest.mark.parametrize(
    ("provider", "variable", "header", "value"),
    [
        ("openai", "OPENAI_API_KEY", "authorization", f"Bearer {KEY}"),
        ("gemini", "GEMINI_API_KEY", "x-goog-api-key", KEY),
        ("anthropic", "ANTHROPIC_API_KEY", "x-api-key", KEY),
        ("local", "LOCAL_API_KEY", "authorization", f"Bearer {KEY}"),
    ],
)
async def test_the_key_is_sent_and_masked_where_the_server_echoes_it(
    recorder, provider, variable, header, value
):
    def echo(request):
        headers = dict(request.headers)
        return web.json_response({"error": {"message": "bad key", "got": headers}}, status=401)

    recorder.reply = echo
    entry = ModelEntry(
        provider=provider,
        format="openai-chat",
        id="m",
        max_output_tokens=10,
        base_url=recorder.url,
    )
    reply = await send(resolve_endpoint("m", entry, {variable: KEY}))
    assert recorder.requests[0].headers[header] == value
    assert reply.status == 401
    assert KEY not in reply.body
    # All the rest of the body is kept.
    got = {name.lower(): text for name, text in json.loads(reply.body)["error"]["got"].items()}
    assert got[header] == value.replace(KEY, "[key]")
    assert json.loads(reply.body)["error"]["message"] == "bad key"


async def test_without_a_key_no_auth_header_is_sent(recorder):
    entry = ModelEntry(provider="local", format="openai-chat", id="m", max_output_tokens=10)
    await send(resolve_endpoint("m", entry, {"LOCAL_BASE_URL": recorder.url}))
    names = {name.lower() for name in recorder.requests[0].headers}
    assert not names & {"authorization", "api-key", "x-api-key", "x-goog-api-key"}


async def test_a_redirect_is_not_followed_so_that_the_key_stays(recorder):
    recorder.reply = lambda request: web.Response(status=307, headers={"location": "/elsewhere"})
    reply = await send(endpoint_at(recorder.url, auth_headers={"x-api-key": KEY}))
    assert reply.status == 307
    assert len(recorder.requests) == 1


async def test_a_path_that_no_url_can_have_is_told_and_nothing_is_sent(recorder):
    request = request_for(path="/v1beta/models/a\nb:generateContent")
    with pytest.raises(UsageError, match=r"can be no path: correct the entry"):
        await send(endpoint_at(recorder.url), request)
    assert recorder.requests == []


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
async def test_loopback_never_goes_through_a_proxy(recorder, monkeypatch, dead_port, host):
    for name in ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"):
        monkeypatch.setenv(name, f"http://127.0.0.1:{dead_port}")
        monkeypatch.setenv(name.lower(), f"http://127.0.0.1:{dead_port}")
    reply = await send(endpoint_at(recorder.url.replace("127.0.0.1", host)))
    assert reply.status == 200


@pytest.mark.parametrize("name", ["HTTP_PROXY", "ALL_PROXY"])
async def test_other_hosts_go_through_the_proxy_of_the_environment(recorder, monkeypatch, name):
    # The proxy is the recorder: nothing leaves loopback, not even a look-up of the name.
    monkeypatch.setenv(name, recorder.url)
    reply = await send(endpoint_at("http://model.invalid/v1"))
    assert reply.status == 200
    assert recorder.requests[0].headers["host"] == "model.invalid"


@pytest.mark.parametrize("user", ["fleet:s3cret-word", "fleet%40work:s3cret%2Fword", "me:pw"])
async def test_nothing_of_a_proxys_user_info_is_left_of_what_it_answers(
    recorder, monkeypatch, user
):
    decoded = unquote(user)
    monkeypatch.setenv("http_proxy", recorder.url.replace("//", f"//{user}@"))

    def refuse(request):
        got = request.headers["proxy-authorization"]
        assert got == f"Basic {b64encode(decoded.encode()).decode()}"
        text = f"{got} {user} {decoded}" if len(user) >= 8 else got
        return web.json_response({"error": {"message": text}}, status=407)

    recorder.reply = refuse
    reply = await send(endpoint_at("http://model.invalid/v1"))
    message = json.loads(reply.body)["error"]["message"]
    assert set(message.removeprefix("Basic ").split()) == {"[key]"}


async def test_no_reply_in_time_is_a_timeout(emulator):
    url = await emulator(FaultPlan(rates={"hang": 1.0}))
    with pytest.raises(TransportFailure) as failure:
        await send(endpoint_at(f"{url}/v1"), timeout_s=0.1)
    assert failure.value.outcome == "timeout"


async def test_a_reply_that_stalls_in_its_body_is_a_timeout(recorder):
    async def stall(request):
        reply = web.StreamResponse()
        await reply.prepare(request)
        await reply.write(b'{"id": ')
        await asyncio.sleep(30)

    recorder.reply = stall
    with pytest.raises(TransportFailure) as failure:
        await send(endpoint_at(recorder.url), timeout_s=0.1)
    assert failure.value.outcome == "timeout"


async def test_a_timeout_gives_its_connection_back(recorder):
    async def hang(request):
        await asyncio.sleep(30)

    async with transport_to(endpoint_at(recorder.url), connections=1) as transport:
        recorder.reply = hang
        for attempt in (1, 2):
            with pytest.raises(TransportFailure):
                await transport.send(request_for(), attempt=attempt, timeout_s=0.1)
        recorder.reply = lambda request: web.json_response({})
        reply = await transport.send(request_for(), attempt=3, timeout_s=10)
    assert reply.status == 200


@pytest.mark.parametrize("fault", ["reset", "truncated_body"])
async def test_a_broken_connection_is_a_lost_one(emulator, fault):
    url = await emulator(FaultPlan(rates={fault: 1.0}))
    with pytest.raises(TransportFailure) as failure:
        await send(endpoint_at(f"{url}/v1"))
    assert (failure.value.outcome, failure.value.sent) == ("connection_lost", True)
    assert str(failure.value)


async def test_a_refused_connection_cannot_be_charged(dead_port):
    with pytest.raises(TransportFailure) as failure:
        await send(endpoint_at(f"http://127.0.0.1:{dead_port}"))
    assert (failure.value.outcome, failure.value.sent) == ("no_connection", False)


@pytest.mark.parametrize(
    "raw",
    [
        b"",
        b"garbage\r\n\r\n",
        b"HTTP/1.1 20",
        b'HTTP/1.1 200 OK\r\ncontent-length: 9\r\n\r\n{"a"',
        b'HTTP/1.1 200 OK\r\ntransfer-encoding: chunked\r\n\r\n9\r\n{"a"',
        b'HTTP/1.1 200 OK\r\ntransfer-encoding: chunked\r\n\r\nzz\r\n{"a"',
        b"HTTP/1.1 200 OK\r\nx: " + b"a" * 70_000 + b"\r\n\r\n",
        b"HTTP/1.1 200 OK\r\ncontent-encoding: gzip\r\ncontent-length: 4\r\n\r\nabcd",
    ],
    ids=[
        "nothing",
        "no HTTP",
        "cut status",
        "short body",
        "cut chunk",
        "no chunk",
        "huge header",
        "no gzip",
    ],
)
async def test_a_reply_that_cannot_be_read_is_a_transport_failure(raw):
    # Whatever an endpoint sends, it is an attempt that failed and no end of the sweep.
    async with server_that_says(raw) as url:
        with pytest.raises(TransportFailure):
            await send(endpoint_at(url))


async def test_headers_up_to_64_kib_are_read_and_what_cannot_be_read_is_told(recorder):
    recorder.reply = lambda request: web.json_response({}, headers={"x-policy": "a" * 60_000})
    assert (await send(endpoint_at(recorder.url))).status == 200
    for raw, why in (
        (b"HTTP/1.1 200 OK\r\nx: " + b"a" * 70_000 + b"\r\n\r\n", "Got more than 65536 bytes"),
        (
            b"HTTP/1.1 200 OK\r\ncontent-encoding: gzip\r\ncontent-length: 4\r\n\r\nabcd",
            "not in the Content-Encoding that it names",
        ),
    ):
        async with server_that_says(raw) as url:
            with pytest.raises(TransportFailure, match=why) as failure:
                await send(endpoint_at(url))
        assert (failure.value.reason, failure.value.sent) == ("unreadable_reply", True)


async def test_connections_are_kept_alive_while_a_model_thinks(recorder):
    options = []

    class Watched(Connections):
        async def connect(self, *args, **changes):
            connection = await super().connect(*args, **changes)
            channel = connection.transport.get_extra_info("socket")
            options.append(
                (
                    channel.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE),
                    channel.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE),
                    channel.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL),
                    channel.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT),
                )
            )
            return connection

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("merge_runner.llm.http.Connections", Watched)
        await send(endpoint_at(recorder.url))
    assert options == [(1, 60, 60, 5)]


@pytest.mark.parametrize(
    ("answer_of_the_proxy", "outcome", "action", "words"),
    [
        (b"HTTP/1.1 403 Forbidden\r\n\r\n", "proxy_refused", "refused", "HTTP 403: Forbidden"),
        (b"HTTP/1.1 407 Needs X\r\n\r\n", "proxy_refused", "refused", "HTTP 407: Needs X"),
        (b"HTTP/1.1 503 No\r\n\r\n", "proxy_refused", "retry", "llm.invalid (HTTP 503: No)"),
        (b"", "connection_lost", "retry", "disconnected"),
    ],
)
async def test_a_proxy_that_does_not_connect_has_sent_nothing(
    monkeypatch, answer_of_the_proxy, outcome, action, words
):
    async with server_that_says(answer_of_the_proxy) as url:
        monkeypatch.setenv("HTTPS_PROXY", url)
        with pytest.raises(TransportFailure) as failure:
            await send(endpoint_at("https://llm.invalid/v1"))
    told = failure.value
    assert (told.outcome, told.action, told.sent) == (outcome, action, False)
    assert words in str(told)


async def test_no_more_connections_are_open_than_allowed(recorder):
    open_now, most = 0, 0
    full = asyncio.Event()

    async def busy(request):
        nonlocal open_now, most
        open_now += 1
        most = max(most, open_now)
        if open_now == 3:
            full.set()
        await full.wait()
        await asyncio.sleep(0.02)  # time for a connection too many
        open_now -= 1
        return web.json_response({})

    recorder.reply = busy
    async with transport_to(endpoint_at(recorder.url), connections=3) as transport:
        calls = [transport.send(request_for(), attempt=1, timeout_s=10) for _ in range(9)]
        await asyncio.gather(*calls)
    assert most == 3


FORMATS = ("openai-chat", "openai-responses", "gemini", "anthropic")
SLOTS = [Slot("L_4_8", repetition, "left", 0, 0) for repetition in range(1, 5)]


def driving_prompt():
    scenario = ScenarioConfig()
    seen = World(scenario, CONDITIONS["L_4_8"], TRACK).observe("left")
    return render_prompt(seen, None, prompt=prompt_of("baseline"), scenario=scenario)


@contextlib.asynccontextmanager
async def client_for(wire, url, folder):
    """A whole client of the emulator, wired as a sweep does it."""
    entry = ModelEntry(
        provider="emulator",
        format=wire,
        id="scripted-driver",
        max_output_tokens=4000,
        price="free",
        base_url=f"{url}/v1" if wire.startswith("openai") else url,
        timeout_s=0.5,
        deadline_s=60,
    )
    endpoint = resolve_endpoint("m", entry, {})
    cache = ResponseCache(folder)
    async with transport_to(endpoint, connections=16) as transport:
        yield LlmClient(
            name="m",
            entry=entry,
            endpoint=endpoint.identity,
            cache=cache,
            transport=transport,
            limiter=Limiter(),
        )
    cache.close()


@pytest.mark.parametrize("wire", FORMATS)
async def test_a_client_gets_its_answers_from_the_emulator(emulator, tmp_path, wire):
    async with client_for(wire, await emulator(), tmp_path) as client:
        replies = await asyncio.gather(*(client.ask(driving_prompt(), slot) for slot in SLOTS))
    for slot, reply in zip(SLOTS, replies, strict=True):
        # The slot arrived: the answer is the one of this slot, as by a call without HTTP.
        assert reply.text == answer(driving_prompt(), slot)
        assert parse_reply(reply.text, 20).plan
        assert reply.outcome == "ok"
        last = reply.attempts[-1]
        assert last.http_status == 200
        assert last.model_served == "scripted-driver"
        assert last.finish_reason
        assert last.usage.input_tokens == len(driving_prompt().encode()) // 4
        visible = len(reply.text.encode()) // 4
        assert last.usage.output_tokens == last.usage.reasoning_tokens + visible
