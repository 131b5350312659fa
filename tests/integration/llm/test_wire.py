"""What a server says on the wire beyond one whole answer to one request."""

import asyncio
import contextlib
import json
import socket
import threading
from uuid import UUID

import pytest

from merge_runner.llm.delays import server_delay_s
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.http_outcome import TransportFailure
from tests.support.cases import cases
from tests.support.raw_server import a_request, head, ok, raw_server, transport_to


def chat(text):
    return json.dumps({"choices": [{"message": {"content": text}}]}).encode()


async def ask(transport, number=0, timeout_s=5.0):
    """The text that answers, or the outcome of the failure."""
    try:
        reply = await transport.send(a_request(number), attempt=1, timeout_s=timeout_s)
    except TransportFailure as exc:
        return exc.outcome.name
    return json.loads(reply.body)["choices"][0]["message"]["content"]


async def said_to(count, *answers, **timeouts_s):
    """The outcomes of so many requests in a row, and the requests as the server saw them.

    ``timeouts_s`` names the request that has another timeout: ``at_2=0.05``.
    """
    async with raw_server(*answers) as server, transport_to(server.url) as transport:
        said = [
            await ask(transport, timeout_s=timeouts_s.get(f"at_{number}", 5.0))
            for number in range(1, count + 1)
        ]
    return said, server.requests


async def test_a_silent_connection_is_used_again_also_after_a_word_in_between():
    for answer in (ok(chat("a")), head(103, link="</>") + ok(chat("a"))):
        said, requests = await said_to(3, answer)
        assert (said, [request.talk for request in requests]) == (["a"] * 3, [1, 1, 1])
        assert requests[-1].headers["connection"] == "keep-alive"


SURPLUS = {
    "a letter": b"x",
    "an empty line": b"\r\n",
    "a line end": b"\n",
    "the beginning of a head": b"H",
    "a cut head": b"HTTP/1.1 200 OK\r\nx: y",
    "a whole head": head(content_length=5),
    "an answer": ok(chat("late")),
    "an answer that refuses": ok(b"{}", 401),
    "zeros": bytes(70_000),
}


@pytest.mark.parametrize("surplus", SURPLUS.values(), ids=SURPLUS)
async def test_bytes_beyond_an_answer_never_answer_the_next_request(surplus):
    async def late(talk, request):
        await talk.say(ok(chat("a")))
        await taken.wait()
        await talk.say(surplus)
        said.set()

    taken, said = asyncio.Event(), asyncio.Event()
    async with raw_server(late, ok(chat("b"))) as server, transport_to(server.url) as transport:
        assert await ask(transport) == "a"
        taken.set()
        await said.wait()
        assert [await ask(transport), await ask(transport)] == ["b", "b"]
    (first, *others), _ = await said_to(3, ok(chat("a")) + surplus, ok(chat("b")))
    # What is no HTTP may take the answer with it that it came with.
    assert first in ("a", "connection_lost")
    assert others == ["b", "b"]


async def test_bytes_that_the_loop_had_no_time_to_read_never_answer_the_next_request():
    taken, come = threading.Event(), threading.Event()

    def serve():
        first, _ = listening.accept()
        with first:
            first.recv(65536)
            first.sendall(ok(chat("a")))
            taken.wait()
            first.sendall(ok(chat("late")))
            come.set()
            second, _ = listening.accept()
            with second:
                second.recv(65536)
                second.sendall(ok(chat("b")))

    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(5)
        server = threading.Thread(target=serve, daemon=True)
        server.start()
        async with transport_to(f"http://127.0.0.1:{listening.getsockname()[1]}") as transport:
            assert await ask(transport) == "a"
            taken.set()
            come.wait()  # the loop does nothing meanwhile
            assert await ask(transport) == "b"
            server.join()


async def test_after_a_timeout_each_connection_is_for_one_request():
    async def late(talk, request):
        await given_up.wait()
        await talk.say(ok(chat("late")))

    given_up = asyncio.Event()
    async with (
        raw_server(ok(chat("a")), late, ok(chat("b"))) as server,
        transport_to(server.url, connections=2) as transport,
    ):
        assert await ask(transport) == "a"
        assert await ask(transport, timeout_s=0.05) == "timeout"
        given_up.set()
        assert [await ask(transport) for _ in range(2)] == ["b", "b"]
    assert [request.talk for request in server.requests] == [1, 1, 2, 3]


async def test_after_a_cut_no_waiting_connection_is_used_either():
    together = asyncio.Event()

    async def both(talk, request):
        if len(server.requests) == 2:
            together.set()
        await together.wait()
        await talk.say(ok(chat("a")))

    async def cut(talk, request):
        await talk.say(ok(chat("b"))[:-5])
        talk.close()

    async with (
        raw_server(both, both, cut, ok(chat("c"))) as server,
        transport_to(server.url, connections=2) as transport,
    ):
        assert await asyncio.gather(ask(transport), ask(transport)) == ["a", "a"]
        assert [await ask(transport) for _ in range(2)] == ["connection_lost", "c"]
    first, second, third, last = (request.talk for request in server.requests)
    assert (third in (first, second), last) == (True, 3)


def echoing(text, name="x-request-id", said=None):
    """An answer that names its request, or whatever ``said`` makes of it."""

    async def say(talk, request):
        own = request.headers[name]
        await talk.say(ok(chat(text), **{name: said(own) if said else own}))

    return say


@pytest.mark.parametrize("name", ["x-request-id", "x-client-request-id"])
async def test_an_answer_that_names_another_request_is_none(name):
    first = []

    def swapped(own):
        first.append(own)
        return own if len(first) == 1 else first[0]

    answers = (echoing("a", name, swapped), echoing("late", name, swapped), echoing("b", name))
    assert (await said_to(3, *answers))[0] == ["a", "wrong_answer", "b"]


async def test_where_answers_name_their_requests_connections_are_kept_also_after_a_timeout():
    async def hang(talk, request):
        await talk.left()

    said, requests = await said_to(4, echoing("a"), hang, echoing("b"), at_2=0.05)
    assert said == ["a", "timeout", "b", "b"]
    assert [request.talk for request in requests] == [1, 1, 2, 2]


async def test_an_id_that_the_server_gives_itself_says_nothing():
    said, requests = await said_to(2, ok(chat("a"), x_request_id="req_011CSHoEeqs5C35K2UUqR7Fy"))
    assert said == ["a", "a"]
    ids = [request.headers["x-request-id"] for request in requests]
    assert len(set(ids)) == 2
    # llama-cpp-python's server refuses any other.
    assert [str(UUID(one, version=4)) for one in ids] == ids


async def test_a_connection_that_is_half_closed_is_not_used_again():
    async def half(talk, request):
        await talk.say(ok(chat("a")))
        talk.half_close()

    said, requests = await said_to(2, half)
    assert (said, [request.talk for request in requests]) == (["a", "a"], [1, 2])


@pytest.mark.parametrize("wrong", cases("wrong_lengths"))
async def test_a_wrong_length_ends_its_attempt_and_no_other(wrong):
    answers = wrong.encode("latin-1"), ok(chat("b"))
    async with raw_server(*answers) as server, transport_to(server.url) as transport:
        with contextlib.suppress(json.JSONDecodeError):  # what such a length leaves of a body
            assert await ask(transport, timeout_s=0.2) in ("connection_lost", "timeout")
        assert await ask(transport) == "b"


async def test_of_a_header_that_is_sent_several_times_no_value_is_lost():
    twice = head(503, retry_after=7, Retry_After=3600, content_length=0)
    async with raw_server(twice) as server, transport_to(server.url) as transport:
        reply = await transport.send(a_request(), attempt=1, timeout_s=5)
    assert server_delay_s(reply.error, FORMATS["openai-chat"]) == 3600
