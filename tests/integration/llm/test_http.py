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

from merge_runner.errors import UsageError
from merge_runner.llm.http import Connections
from merge_runner.llm.http_outcome import TransportFailure
from merge_runner.providers import Endpoint, ModelEntry, resolve_endpoint
from merge_runner.records import Slot, call_key, canonical_json, make_request
from tests.support.harness import listening
from tests.support.mock_server import FaultPlan
from tests.support.raw_server import raw_server, transport_to

SLOT = Slot("N_0_0", 1, "left", 0, 0)
KEY = "sk-dummy-0123456789"


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
    async with listening(kept.handle) as kept.url:
        yield kept


@pytest.fixture
def dead_port():
    """A port of loopback at which nobody listens, reserved so that nobody begins to."""
    with socket.socket() as reserved:
        reserved.bind(("127.0.0.1", 0))
        yield reserved.getsockname()[1]


def request_for(**changes):
    named = {"provider": "openai", "endpoint": "openai", "model": "some-model"}
    said = {"path": "/chat/completions", "headers": {"anthropic-version": "2023-06-01"}}
    body = {"prompt": "Gr\u00fc\u00dfe, \u2212 \U0001f697", "a": 1.0}
    return replace(make_request(**named, **said, body=body, slot=SLOT), **changes)


def endpoint_at(url, provider="openai", identity=None, auth_headers=None):
    return Endpoint(provider, identity or provider, url, auth_headers or {})


def entry(provider, url=None):
    named = {"provider": provider, "format": "openai-chat", "id": "m", "base_url": url}
    return ModelEntry(**named, max_output_tokens=10)


async def send(endpoint, request=None, *, attempt=1, timeout_s=10.0):
    async with transport_to(endpoint) as transport:
        return await transport.send(request or request_for(), attempt=attempt, timeout_s=timeout_s)


@contextlib.asynccontextmanager
async def server_that_says(answer):
    """The URL of a server that answers with these bytes, whatever they are, and hangs up."""

    async def say(talk, request):
        await talk.say(answer)
        talk.close()

    async with raw_server(say) as server:
        yield server.url


async def failed(endpoint, **options):
    with pytest.raises(TransportFailure) as failure:
        await send(endpoint, **options)
    return failure.value


async def test_it_posts_exactly_the_bytes_that_were_hashed(recorder):
    request = request_for()
    await send(endpoint_at(f"{recorder.url}/v1"), request)
    (got,), (body,) = recorder.requests, recorder.bodies
    assert (got.method, got.path) == ("POST", "/v1/chat/completions")
    assert (body, got.headers["content-type"]) == (request.body.encode(), "application/json")
    # The key can be computed from what the server got.
    headers = {"anthropic-version": got.headers["anthropic-version"]}
    parts = {"path": request.path, "headers": headers, "body": body.decode(), "slot": SLOT}
    assert request.key == call_key(endpoint="openai", **parts)


async def test_it_returns_status_lower_case_headers_of_up_to_64_kib_and_the_text_unpacked(recorder):
    text = '{"text": "Gr\u00fc\u00dfe"}'
    headers = {"Retry-After": "7", "X-Policy": "a" * 60_000, "Content-Encoding": "gzip"}
    recorder.reply = lambda request: web.Response(
        status=418, body=gzip.compress(text.encode()), headers=headers
    )
    reply = await send(endpoint_at(recorder.url))
    assert (reply.status, reply.body) == (418, text)
    assert (reply.headers["retry-after"], len(reply.headers["x-policy"])) == ("7", 60_000)
    assert all(name == name.lower() for name in reply.headers)


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
async def test_nobody_else_is_told_the_slot_nor_a_key_where_there_is_none(
    recorder, provider, identity
):
    await send(endpoint_at(recorder.url, provider, identity), attempt=3)
    names = {name.lower() for name in recorder.requests[0].headers}
    assert not [name for name in names if "merge-runner" in name or "-api-" in name]
    assert not names & {"authorization", "api-key", "x-api-key", "x-goog-api-key"}
    assert "N_0_0" not in str(recorder.requests[0].headers) + recorder.bodies[0].decode()


@pytest.mark.parametrize(
    ("provider", "header", "value"),
    [
        *((name, "authorization", f"Bearer {KEY}") for name in ("openai", "local")),
        *(("gemini", "x-goog-api-key", KEY), ("anthropic", "x-api-key", KEY)),
    ],
)
async def test_the_key_is_sent_and_masked_where_the_server_echoes_it(
    recorder, provider, header, value
):
    def echo(request):
        got = {name.lower(): text for name, text in request.headers.items()}
        return web.json_response({"error": {"message": "bad key", "got": got}}, status=401)

    recorder.reply = echo
    key = {f"{provider.upper()}_API_KEY": KEY}
    reply = await send(resolve_endpoint("m", entry(provider, recorder.url), key))
    assert recorder.requests[0].headers[header] == value
    # All the rest of the body is kept.
    error = json.loads(reply.body)["error"]
    assert (reply.status, error["message"]) == (401, "bad key")
    assert error["got"][header] == value.replace(KEY, "[key]")
    assert KEY not in reply.body


async def test_a_redirect_is_not_followed_so_that_the_key_stays(recorder):
    recorder.reply = lambda request: web.Response(status=307, headers={"location": "/elsewhere"})
    reply = await send(endpoint_at(recorder.url, auth_headers={"x-api-key": KEY}))
    assert reply.status == 307
    assert len(recorder.requests) == 1


@pytest.mark.parametrize("path", ["/v1beta/models/a\nb:generateContent", "@localhost:1/x", "0/x"])
async def test_a_path_that_no_url_can_have_is_told_and_nothing_is_sent(recorder, path):
    request = request_for(path=path)
    with pytest.raises(UsageError, match=r"can be no path: correct models.toml"):
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


@pytest.mark.filterwarnings("ignore::DeprecationWarning:httpx_aiohttp")
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


async def test_no_reply_in_time_is_a_timeout_also_where_it_stalls_in_its_body(emulator):
    hanging = await emulator(FaultPlan(rates={"hang": 1.0}))
    async with raw_server(b'HTTP/1.1 200 OK\r\ncontent-length: 99\r\n\r\n{"id": ') as stalling:
        for url in (f"{hanging}/v1", stalling.url):
            assert (await failed(endpoint_at(url), timeout_s=0.1)).outcome.name == "timeout"


async def test_a_timeout_gives_its_connection_back(recorder):
    async def hang(request):
        await asyncio.Event().wait()

    async with transport_to(endpoint_at(recorder.url), connections=1) as transport:
        recorder.reply = hang
        for attempt in (1, 2):
            with pytest.raises(TransportFailure):
                await transport.send(request_for(), attempt=attempt, timeout_s=0.1)
        recorder.reply = lambda request: web.json_response({})
        assert (await transport.send(request_for(), attempt=3, timeout_s=10)).status == 200


async def test_a_refused_connection_cannot_be_charged(dead_port):
    failure = await failed(endpoint_at(f"http://127.0.0.1:{dead_port}"))
    assert (failure.outcome.name, failure.outcome.charged) == ("no_connection", False)


OK = b"HTTP/1.1 200 OK\r\n"
# What is no reply, and what is said of it. Whatever comes, it is an attempt that failed.
UNREADABLE = {
    "nothing": (b"", ""),
    "no HTTP": (b"garbage\r\n\r\n", ""),
    "cut status": (b"HTTP/1.1 20", ""),
    "short body": (OK + b'content-length: 9\r\n\r\n{"a"', ""),
    "cut chunk": (OK + b'transfer-encoding: chunked\r\n\r\n9\r\n{"a"', ""),
    "no chunk": (OK + b'transfer-encoding: chunked\r\n\r\nzz\r\n{"a"', ""),
    "huge header": (OK + b"x: " + b"a" * 70_000 + b"\r\n\r\n", "Got more than 65536 bytes"),
    "no gzip": (
        OK + b"content-encoding: gzip\r\ncontent-length: 4\r\n\r\nabcd",
        "not in the Content-Encoding that it names",
    ),
}


@pytest.mark.parametrize(("raw", "why"), UNREADABLE.values(), ids=UNREADABLE)
async def test_a_reply_that_cannot_be_read_is_a_transport_failure(raw, why):
    async with server_that_says(raw) as url:
        failure = await failed(endpoint_at(url))
    assert why in str(failure)
    if why:
        assert (failure.outcome.reason, failure.outcome.charged) == ("unreadable_reply", True)


async def test_connections_are_kept_alive_while_a_model_thinks(recorder, monkeypatch):
    options = []

    class Watched(Connections):
        async def connect(self, *args, **changes):
            connection = await super().connect(*args, **changes)
            channel = connection.transport.get_extra_info("socket")
            names = (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT)
            options.append(channel.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE))
            options.extend(channel.getsockopt(socket.IPPROTO_TCP, name) for name in names)
            return connection

    monkeypatch.setattr("merge_runner.llm.http.Connections", Watched)
    await send(endpoint_at(recorder.url))
    assert options == [1, 60, 60, 5]


@pytest.mark.parametrize(
    ("answer_of_the_proxy", "outcome", "action", "words"),
    [
        (b"HTTP/1.1 403 Forbidden\r\n\r\n", "proxy_refused", "rejected", "HTTP 403: Forbidden"),
        (b"HTTP/1.1 407 Needs X\r\n\r\n", "proxy_refused", "rejected", "HTTP 407: Needs X"),
        (b"HTTP/1.1 503 No\r\n\r\n", "proxy_refused", "retry", "llm.invalid (HTTP 503: No)"),
        (b"", "connection_lost", "retry", "disconnected"),
    ],
)
async def test_a_proxy_that_does_not_connect_has_sent_nothing(
    monkeypatch, answer_of_the_proxy, outcome, action, words
):
    async with server_that_says(answer_of_the_proxy) as url:
        monkeypatch.setenv("HTTPS_PROXY", url)
        told = await failed(endpoint_at("https://llm.invalid/v1"))
    assert told.outcome[:2] == (action, outcome)
    assert not told.outcome.charged
    assert words in str(told)


async def test_no_more_connections_are_open_than_allowed(recorder):
    open_now, most, full = 0, 0, asyncio.Event()

    async def busy(request):
        nonlocal open_now, most
        open_now += 1
        most = max(most, open_now)
        if open_now == 3:
            full.set()
        await full.wait()
        for _ in range(20):  # turns for a connection too many
            await asyncio.sleep(0)
        open_now -= 1
        return web.json_response({})

    recorder.reply = busy
    async with transport_to(endpoint_at(recorder.url), connections=3) as transport:
        calls = [transport.send(request_for(), attempt=1, timeout_s=10) for _ in range(9)]
        await asyncio.gather(*calls)
    assert most == 3
