"""A server may send what it likes: memory, time and the sweep stay within their bounds."""

import asyncio
import contextlib
import gzip
import ssl
import subprocess
import time
import tracemalloc
import zlib

import pytest

from merge_runner.llm.http import HttpTransport
from merge_runner.llm.http_outcome import TransportFailure
from merge_runner.providers import Endpoint
from tests.support.harness import FAST
from tests.support.raw_server import CHAT, a_request, head, ok, raw_server

KEY = "sk-dummy-Zx81/Qp55"
ONE = ("baseline", "--reps", 1, "--conditions", "N_0_0", "--yes", *FAST)
O3 = ("sweep", *ONE, "--model", "o3")
MB = 10**6
MEMORY = 64 * MB
NO_PROXY_URL = "HTTPS_PROXY or ALL_PROXY is no URL of an HTTP proxy"


async def answered(answer, *, most_bytes=16 * MB, timeout_s=5.0, auth=None):
    """The reply to a request to a server with this answer; raises TransportFailure."""
    async with raw_server(answer) as server:
        endpoint = Endpoint("openai", "openai", server.url, auth or {})
        transport = HttpTransport(endpoint, connections=1, most_bytes=most_bytes)
        try:
            return await transport.send(a_request(), attempt=1, timeout_s=timeout_s)
        finally:
            await transport.close()


async def refused(answer, **options):
    """The failure, which must be one that is not tried again, and what it took."""
    with pytest.raises(TransportFailure) as failure, watched_memory() as watched:
        await answered(answer, **options)
    outcome = failure.value.outcome
    assert (outcome.name, outcome.action) == ("reply_refused", "fail")
    assert outcome.charged, "it may be"
    assert watched["peak"] < MEMORY
    return str(failure.value)


@contextlib.contextmanager
def watched_memory():
    watched = {}
    tracemalloc.start()
    try:
        yield watched
    finally:
        watched["peak"] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()


async def longest_stall():
    """What the loop computed at a stretch at worst, in s, until this is cancelled."""
    worst = 0.0
    try:
        while True:
            before = time.thread_time()
            await asyncio.sleep(0.001)
            worst = max(worst, time.thread_time() - before)
    except asyncio.CancelledError:
        return worst


def bomb(packed_mb):
    """Gzip of so many megabytes that unpacks to a thousand times as much."""
    packing = zlib.compressobj(9, wbits=31)
    start = packing.compress(b"[") + packing.flush(zlib.Z_FULL_FLUSH)
    block = packing.compress(bytes(8 * MB)) + packing.flush(zlib.Z_FULL_FLUSH)
    return start + block * (packed_mb * MB // len(block))


async def test_three_megabytes_of_gzip_are_refused_in_little_memory_and_the_loop_goes_on():
    packed = bomb(3)
    assert len(packed) > 2.9 * MB
    stall = asyncio.create_task(longest_stall())
    started = time.process_time()
    said = await refused(ok(packed, content_encoding="gzip"))
    assert "longer than 16 MB (max_reply_mb)" in said
    assert time.process_time() - started < 2
    stall.cancel()
    assert await stall < 0.5


@pytest.mark.parametrize("encoding", ["gzip", "GZIP", "deflate", "identity", ""])
async def test_a_reply_of_exactly_the_bound_is_taken_and_one_byte_more_is_not(encoding):
    text = b"\xc3\xbc" * 500

    def reply(body):
        pack = {"deflate": zlib.compress, "identity": bytes, "": bytes}.get(encoding, gzip.compress)
        return ok(pack(body), content_encoding=encoding)

    taken = await answered(reply(text), most_bytes=1000)
    assert taken.body == text.decode()
    assert "longer than" in await refused(reply(text + b"x"), most_bytes=1000)


@pytest.mark.parametrize(
    ("raw", "status", "body"),
    [
        (ok(b"", 502, content_encoding="gzip"), 502, ""),  # which is none that is cut
        (ok(b"\xef\xbb\xbf" + CHAT), 200, CHAT.decode()),  # a byte order mark before JSON
    ],
)
async def test_an_odd_reply_is_read_as_what_it_means(raw, status, body):
    reply = await answered(raw)
    assert (reply.status, reply.body) == (status, body)


def endless(beginning, unit):
    async def say(talk, _):
        await talk.say(beginning)
        with contextlib.suppress(ConnectionError):
            while not talk.writer.is_closing():
                await talk.say(unit)
                await asyncio.sleep(0)

    return say


CHUNKED = head(transfer_encoding="chunked")


def in_chunks(body):
    return b"%x\r\n%s\r\n" % (len(body), body)


ENDLESS = {
    "headers": endless(b"HTTP/1.1 200 X\r\n", b"x: y\r\n" * 1000),
    "status line": endless(b"HTTP/1.1 200 ", b"y" * 65536),
    "interim responses": endless(b"", head(103) * 1000),
    "a chunk's extension": endless(CHUNKED + b"5;", b"y" * 65536),
    "a body": endless(head(), b"y" * 65536),
    "chunks of one byte": endless(CHUNKED, b"1\r\ny\r\n" * 10_000),
    "more after a gzip": endless(
        head(transfer_encoding="chunked", content_encoding="gzip") + in_chunks(gzip.compress(CHAT)),
        b"10000\r\n" + b"y" * 65536 + b"\r\n",
    ),
    "gzip of nothing": endless(
        head(transfer_encoding="chunked", content_encoding="gzip")
        + b"a\r\n\x1f\x8b\x08\0\0\0\0\0\0\3\r\n",
        b"5\r\n\0\0\0\xff\xff\r\n" * 10_000,
    ),
}


@pytest.mark.parametrize("answer", ENDLESS.values(), ids=ENDLESS)
async def test_what_never_ends_is_ended_in_little_memory(answer):
    with pytest.raises(TransportFailure) as failure, watched_memory() as watched:
        await answered(answer, most_bytes=MB, timeout_s=0.5)
    assert failure.value.outcome.name in ("connection_lost", "reply_refused", "timeout")
    assert watched["peak"] < MEMORY


async def test_a_drip_of_single_bytes_runs_into_the_timeout():
    async def drip(talk, _):
        await talk.drip(ok(), every_s=0.02)

    with pytest.raises(TransportFailure, match="no reply within") as failure:
        await answered(drip, timeout_s=0.2)
    assert failure.value.outcome.name == "timeout"


@pytest.mark.parametrize(("begin", "unit", "end"), [(b"", b"[", b""), (b"[", b"[],", b"1]")])
async def test_sixteen_megabytes_hold_the_loop_for_a_moment_only(begin, unit, end):
    body = begin + unit * ((16 * MB - 10) // len(unit)) + end
    stall = asyncio.create_task(longest_stall())
    assert (await answered(ok(body))).payload is not None or not end
    stall.cancel()
    assert await stall < 1.5


@pytest.fixture(scope="module")
def self_signed(tmp_path_factory):
    """A server's side of TLS that nobody trusts."""
    folder = tmp_path_factory.mktemp("tls")
    made = "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2"
    names = ["-subj", "/CN=localhost", "-keyout", "key", "-out", "cert"]
    subprocess.run([*made.split(), *names], cwd=folder, check=True, capture_output=True)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(folder / "cert", folder / "key")
    return context


async def test_a_bad_certificate_ends_a_sweep_at_once_and_nothing_is_sent(
    merge_runner, self_signed
):
    async with raw_server(ok(), tls=self_signed) as server:
        run = await merge_runner(*O3, OPENAI_API_KEY=KEY, OPENAI_BASE_URL=server.url)
    assert (run.code, server.requests) == (2, [])
    last = run.err.splitlines()[-1]
    assert "the endpoint's certificate cannot be trusted, and nothing was sent" in last
    assert "Traceback" not in run.err


@pytest.mark.parametrize(
    ("variables", "says"),
    [
        ({"SSL_CERT_FILE": "/nowhere.pem"}, "SSL_CERT_FILE names cannot be read (No such file"),
        ({"https_proxy": "http://[::1"}, NO_PROXY_URL),
        ({"ALL_PROXY": f"socks5://u:{KEY}@proxy.invalid"}, "a SOCKS proxy needs an HTTP proxy"),
        ({"OPENAI_BASE_URL": f"https://{'a' * 300}/v1"}, "OPENAI_BASE_URL is no base URL"),
    ],
    ids=lambda value: str(value)[:40],
)
async def test_an_environment_that_cannot_be_used_is_told_before_anything_is_asked(
    merge_runner, variables, says
):
    run = await merge_runner(*O3, OPENAI_API_KEY=KEY, code=2, **variables)
    line = run.err.splitlines()[-1]
    assert says in line
    assert KEY not in run.err
    assert "Traceback" not in run.err


async def test_a_proxy_that_cannot_be_used_does_not_matter_on_loopback(monkeypatch):
    monkeypatch.setenv("ALL_PROXY", "socks5://a:1")
    assert (await answered(ok())).status == 200


async def test_a_refused_reply_fails_its_call_and_is_not_asked_again(merge_runner, tmp_path):
    (tmp_path / "models.toml").write_text(
        '[m]\nprovider = "openai"\nformat = "openai-chat"\nid = "m"\nmax_output_tokens = 10\n'
        'max_reply_mb = 0.001\nprice = { input = 1, output = 2, source = "s" }\n'
    )
    async with raw_server(ok(CHAT + b" " * 2000)) as server:
        run = await merge_runner(
            *("sweep", *ONE, "--model", "m"), OPENAI_API_KEY=KEY, OPENAI_BASE_URL=server.url
        )
    assert run.code == 1
    calls = await merge_runner("sql", "SELECT outcome, error FROM calls", "--format", "csv")
    assert "reply_refused,the reply is longer than 0.001 MB (max_reply" in calls.out
    assert len(server.requests) == 2, "once for each driver"
