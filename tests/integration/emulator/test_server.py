from __future__ import annotations

import asyncio
import json
import re
from urllib.parse import urlsplit

import aiohttp
import pytest

from merge_runner.emulator.server import run
from merge_runner.errors import UsageError
from merge_runner.llm.formats import FORMATS, read_error
from merge_runner.llm.http_outcome import server_delay_s
from merge_runner.prompts.parse import parse_reply
from merge_runner.records import ANSWERED_FIELD, SCRIPTED_FIELD, SCRIPTED_HEADER
from tests.support.mock_server import FaultPlan, serve

WIRES = ("openai-chat", "openai-responses", "gemini", "anthropic")
PATHS = {
    "openai-chat": "/v1/chat/completions",
    "openai-responses": "/v1/responses",
    "gemini": "/v1beta/models/some-model:generateContent",
    "anthropic": "/v1/messages",
}
SLOT = {"condition": "N_0_0", "repetition": 1, "side": "left", "decision": 0, "sample_set": 0}
all_wires = pytest.mark.parametrize("wire", WIRES)


def body_for(wire, prompt):
    if wire == "gemini":
        return {"contents": [{"role": "user", "parts": [{"text": prompt}]}]}
    if wire == "openai-responses":
        return {"model": "some-model", "input": prompt}
    return {"model": "some-model", "messages": [{"role": "user", "content": prompt}]}


def headers_for(slot=SLOT, attempt=None):
    headers = {"x-merge-runner-slot": json.dumps(slot)} if slot else {}
    return headers | ({"x-merge-runner-attempt": str(attempt)} if attempt else {})


async def post(url, path, body, headers=None):
    """Status, headers and body bytes; a dict is sent as JSON."""
    data = json.dumps(body) if isinstance(body, dict) else body
    async with (
        aiohttp.ClientSession() as session,
        session.post(url + path, data=data, headers=headers) as reply,
    ):
        return reply.status, reply.headers, await reply.read()


async def ask(url, wire, prompt, headers=None):
    status, reply_headers, body = await post(url, PATHS[wire], body_for(wire, prompt), headers)
    return status, reply_headers, json.loads(body)


def without_ids(body):
    """A reply without what tells it from the same one to another request."""
    alike = {name: value for name, value in body.items() if name != ANSWERED_FIELD}
    return json.loads(re.sub(r'"[a-z_-]*[0-9a-f]{24}"', '"ID"', json.dumps(alike)))


def error_names(wire, body):
    """The words by which a provider's error goes, beside the mark of who sent it."""
    assert body.pop(SCRIPTED_FIELD) is True
    if wire == "anthropic":
        assert body["type"] == "error"
        assert body["request_id"]
        return {body["error"]["type"]}
    assert set(body) == {"error"}
    if wire == "gemini":
        assert set(body["error"]) == {"code", "message", "status", "details"}
        return {body["error"]["status"]}
    assert set(body["error"]) == {"message", "type", "param", "code"}
    return {body["error"]["type"], body["error"]["code"]}


async def bytes_until_closed(url):
    """All that the server sends for a chat request until it closes the connection."""
    where = urlsplit(url)
    reader, writer = await asyncio.open_connection(where.hostname, where.port)
    writer.write(
        b"POST /v1/chat/completions HTTP/1.1\r\nhost: localhost\r\ncontent-length: 2\r\n\r\n{}"
    )
    try:
        async with asyncio.timeout(10):
            return await reader.read()
    finally:
        writer.close()


async def test_all_formats_give_the_same_answer_and_counts(emulator, driving_prompt):
    url = await emulator()
    replies = [await ask(url, wire, driving_prompt, headers_for()) for wire in WIRES]
    readings = [FORMATS[wire].read(body) for wire, (_, _, body) in zip(WIRES, replies, strict=True)]
    assert len({reading.text for reading in readings}) == 1
    counts = {
        (r.usage.input_tokens, r.usage.output_tokens, r.usage.reasoning_tokens) for r in readings
    }
    assert len(counts) == 1


@pytest.mark.parametrize(
    ("wire", "body"),
    [
        ("openai-chat", {"messages": [{"content": "no"}, {"content": [{"text": "PROMPT"}]}]}),
        ("openai-responses", {"input": [{"content": "no"}, {"content": [{"text": "PROMPT"}]}]}),
        ("gemini", {"contents": [{"parts": []}, {"parts": [{"text": "PRO"}, {"text": "MPT"}]}]}),
        ("anthropic", {"messages": [{"content": "no"}, {"content": [{"text": "PROMPT"}]}]}),
    ],
)
async def test_the_prompt_is_the_text_of_the_last_message(emulator, driving_prompt, wire, body):
    url = await emulator()
    filled = json.dumps(body).replace("PRO", driving_prompt.replace("\n", "\\n")).replace("MPT", "")
    _, _, listed = await post(url, PATHS[wire], filled)
    _, _, plain = await ask(url, wire, driving_prompt)
    model = {} if wire == "gemini" else {"model": "scripted-driver"}
    assert without_ids(json.loads(listed)) == without_ids(plain | model)


@all_wires
async def test_the_slot_changes_nothing_but_what_is_chosen(emulator, driving_prompt, wire):
    url = await emulator()
    texts, envelopes = set(), set()
    for slot in (None, *({**SLOT, "repetition": n} for n in range(1, 6))):
        status, headers, body = await ask(url, wire, driving_prompt, headers_for(slot))
        reading = FORMATS[wire].read(body)
        usage = reading.usage
        texts.add(reading.text)
        # The visible tokens follow from the text; the others must not move.
        assert usage.output_tokens == usage.reasoning_tokens + len(reading.text.encode()) // 4
        body.pop("usageMetadata" if wire == "gemini" else "usage")
        envelope = json.dumps(without_ids(body)).replace(json.dumps(reading.text), "TEXT")
        envelopes.add(
            (status, *headers.keys(), usage.input_tokens, usage.reasoning_tokens, envelope)
        )
    assert len(texts) > 2
    assert len(envelopes) == 1


@all_wires
async def test_a_reply_is_the_same_each_time_it_is_asked_for(emulator, driving_prompt, wire):
    url = await emulator()
    once, again = [await ask(url, wire, driving_prompt, headers_for(attempt=1)) for _ in range(2)]
    assert once[2] == again[2]


@all_wires
async def test_each_reply_has_an_id_of_its_own(emulator, driving_prompt, wire):
    url = await emulator()
    asked = [
        (driving_prompt, headers_for(attempt=1)),
        (driving_prompt, headers_for(attempt=2)),
        (driving_prompt, headers_for({**SLOT, "repetition": 2}, attempt=1)),
        ("another prompt", headers_for(attempt=1)),
        (driving_prompt, headers_for(None)),
        (driving_prompt, headers_for(None)),  # the second time it was asked
    ]
    replies = [(await ask(url, wire, *each))[2] for each in asked]
    assert len({reply["responseId" if wire == "gemini" else "id"] for reply in replies}) == 6
    # No other member tells one from another.
    assert without_ids(replies[0]) == without_ids(replies[1])


@pytest.mark.parametrize(
    "body",
    ["", "{", "[]", "null", '"text"', "17", b"\xff\xfe{}", "[" * 100_000],
    ids=["empty", "cut", "list", "null", "string", "number", "no UTF-8", "too deep"],
)
async def test_a_body_that_is_no_json_object_gives_400_in_every_format(emulator, body):
    url = await emulator()
    for wire in WIRES:
        status, _, reply = await post(url, PATHS[wire], body)
        assert status == 400
        assert json.loads(reply)["error"]["message"]


@pytest.mark.parametrize("slot", ["{", "[]", "null", "5", "{}"])
async def test_a_slot_that_is_no_slot_gives_400(emulator, driving_prompt, slot):
    headers = {"x-merge-runner-slot": slot}
    status, _, _ = await ask(await emulator(), "openai-chat", driving_prompt, headers)
    assert status == 400


# The words of the providers' documentation.
@pytest.mark.parametrize(
    ("wire", "fault", "status", "name"),
    [
        ("openai-chat", "rate_limit", 429, "rate_limit_exceeded"),
        ("openai-responses", "rate_limit", 429, "rate_limit_exceeded"),
        ("gemini", "rate_limit", 429, "RESOURCE_EXHAUSTED"),
        ("anthropic", "rate_limit", 429, "rate_limit_error"),
        ("openai-chat", "server_error", 500, "server_error"),
        ("openai-responses", "server_error", 500, "server_error"),
        ("gemini", "server_error", 500, "INTERNAL"),
        ("anthropic", "server_error", 500, "api_error"),
        ("gemini", "conflict", 409, "ABORTED"),
        ("anthropic", "conflict", 409, "conflict_error"),
        ("gemini", "overloaded", 503, "UNAVAILABLE"),
        ("anthropic", "overloaded", 503, "overloaded_error"),
    ],
)
async def test_an_error_goes_by_its_providers_name(emulator, wire, fault, status, name):
    url = await emulator(FaultPlan(rates={fault: 1.0}))
    got, _, body = await post(url, PATHS[wire], body_for(wire, "x"))
    assert got == status
    assert name in error_names(wire, json.loads(body))


@all_wires
@pytest.mark.parametrize(
    ("fault", "status"),
    [("request_timeout", 408), ("conflict", 409), ("server_error", 500), ("overloaded", 503)],
)
async def test_a_status_fault_is_an_error_in_the_providers_envelope(
    emulator, driving_prompt, wire, fault, status
):
    url = await emulator(FaultPlan(rates={fault: 1.0}))
    got, headers, body = await ask(url, wire, driving_prompt)
    assert got == status
    assert headers["content-type"].startswith("application/json")
    assert error_names(wire, body)
    assert body["error"]["message"]
    assert server_delay_s(read_error(429, headers, "", body), FORMATS["openai-chat"]) is None
    if wire == "gemini":
        assert body["error"]["code"] == status


@all_wires
async def test_a_rate_limit_says_in_the_providers_way_how_long_to_wait(
    emulator, driving_prompt, wire
):
    plan = FaultPlan(seed=5, rates={"rate_limit": 1.0}, delay_s=2.0)
    headers = headers_for(attempt=3)
    status, got, body = await ask(await emulator(plan), wire, driving_prompt, headers)
    assert status == 429
    wait_s = plan.delay_s
    error = body["error"]
    if wire == "gemini":
        details = {detail["@type"].rpartition(".")[2]: detail for detail in error["details"]}
        assert details["RetryInfo"]["retryDelay"] == f"{wait_s:.9f}s"
        assert f"retry in {wait_s:.9f}s" in error["message"]
    elif wire == "anthropic":
        assert float(got["retry-after"]) == wait_s
    else:
        assert f"Please try again in {wait_s * 1000:.0f}ms." in error["message"]
        assert got["x-ratelimit-remaining-requests"] == "0"
    if wire != "anthropic":
        assert "retry-after" not in got
    lower = {name.lower(): value for name, value in got.items()}
    error = read_error(429, lower, "", body)
    assert server_delay_s(error, FORMATS["openai-chat"]) == pytest.approx(wait_s, abs=0.0005)


@all_wires
async def test_a_bad_gateway_is_html(emulator, driving_prompt, wire):
    url = await emulator(FaultPlan(rates={"bad_gateway": 1.0}))
    status, _, body = await post(url, PATHS[wire], body_for(wire, driving_prompt))
    assert status == 502
    assert body.startswith(b"<html>")


@all_wires
async def test_truncated_json_is_the_whole_reply_but_its_end(emulator, driving_prompt, wire):
    url, whole_url = await emulator(FaultPlan(rates={"truncated_json": 1.0})), await emulator()
    body = body_for(wire, driving_prompt)
    status, headers, cut = await post(url, PATHS[wire], body)
    _, _, whole = await post(whole_url, PATHS[wire], body)
    assert status == 200
    assert headers["content-type"].startswith("application/json")
    assert len(cut) > 100
    assert len(cut) < len(whole)
    assert whole.startswith(cut)


@all_wires
@pytest.mark.parametrize(("fault", "outcome"), [("empty", "empty"), ("refused", "refusal")])
async def test_an_answer_without_a_plan_keeps_its_envelope(
    emulator, driving_prompt, wire, fault, outcome
):
    url = await emulator(FaultPlan(rates={fault: 1.0}))
    status, _, body = await ask(url, wire, driving_prompt)
    assert status == 200
    reading = FORMATS[wire].read(body)
    assert reading.outcome == outcome
    assert "[" not in reading.text
    assert reading.model_served == "some-model"
    assert reading.usage.input_tokens > 0
    assert reading.usage.output_tokens > 0


@all_wires
async def test_a_malformed_answer_is_prose_without_a_plan(emulator, driving_prompt, wire):
    url = await emulator(FaultPlan(rates={"malformed": 1.0}))
    status, _, body = await ask(url, wire, driving_prompt)
    reading = FORMATS[wire].read(body)
    assert (status, reading.outcome) == (200, "ok")
    parsed = parse_reply(reading.text, 20)
    assert (parsed.failure, parsed.tactical) == ("no_array", "M")


async def test_a_reset_is_one(emulator):
    url = await emulator(FaultPlan(rates={"reset": 1.0}))
    with pytest.raises(ConnectionResetError):
        await bytes_until_closed(url)


async def test_a_truncated_body_is_shorter_than_announced(emulator):
    url = await emulator(FaultPlan(rates={"truncated_body": 1.0}))
    head, _, body = (await bytes_until_closed(url)).partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 200 OK\r\n")
    assert b"content-length: 5000" in head
    assert 0 < len(body) < 5000


async def test_a_hang_is_silent_and_then_closes_without_a_byte(emulator):
    short = await emulator(FaultPlan(rates={"hang": 1.0}, hang_s=0.05))
    assert await bytes_until_closed(short) == b""
    long = await emulator(FaultPlan(rates={"hang": 1.0}, hang_s=30))
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.2):
            await bytes_until_closed(long)


async def test_latency_delays_every_answer(emulator, driving_prompt):
    for faults in (FaultPlan(latency_s=30), FaultPlan(latency_s=30, rates={"reset": 1.0})):
        url = await emulator(faults)
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.2):
                await ask(url, "openai-chat", driving_prompt)


async def test_a_hanging_request_does_not_hold_up_another(emulator, driving_prompt):
    plan = FaultPlan(rates={"hang": 0.5}, hang_s=30)
    url = await emulator(plan)
    asked = {}
    for repetition in range(1, 9):
        headers = headers_for({**SLOT, "repetition": repetition}, attempt=1)
        call = asyncio.create_task(ask(url, "openai-chat", driving_prompt, headers))
        asked[call] = plan.fault(headers["x-merge-runner-slot"], 1)
    assert set(asked.values()) == {"hang", None}
    async with asyncio.timeout(10):
        await asyncio.gather(*(call for call, fault in asked.items() if fault is None))
    for call in asked:
        call.cancel()


async def test_the_faults_of_a_slot_follow_the_clients_count_of_attempts(emulator, driving_prompt):
    plan = FaultPlan(seed=2, rates={"server_error": 0.5})
    url = await emulator(plan)
    told = [3, 1, 2, 2, 1, 4, 5]
    statuses = [
        (await ask(url, "openai-chat", driving_prompt, headers_for(attempt=number)))[0]
        for number in told
    ]
    where = headers_for()["x-merge-runner-slot"]
    assert statuses == [500 if plan.fault(where, number) else 200 for number in told]
    assert set(statuses) == {200, 500}


@pytest.mark.parametrize("slot", [SLOT, None], ids=["slot", "no slot"])
async def test_without_a_count_the_emulator_counts_the_attempts_itself(
    emulator, driving_prompt, slot
):
    url = await emulator(FaultPlan(seed=1, rates={"server_error": 0.5}))

    statuses = [
        (await ask(url, "openai-chat", driving_prompt, headers_for(slot)))[0] for _ in range(8)
    ]
    # A client that knows nothing of attempts gets through in the end.
    assert set(statuses) == {200, 500}


async def test_requests_without_a_slot_have_faults_of_their_own(emulator):
    url = await emulator(FaultPlan(rates={"server_error": 0.5}))
    first = headers_for(None, attempt=1)
    statuses = {(await ask(url, "openai-chat", f"prompt {n}", first))[0] for n in range(12)}
    assert statuses == {200, 500}


async def test_the_emulator_is_bound_to_loopback_alone():
    runner, url = await serve(0)
    try:
        assert [host for host, _ in runner.addresses] == ["127.0.0.1"]
        assert url == f"http://127.0.0.1:{runner.addresses[0][1]}"
    finally:
        await runner.cleanup()


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1:PORT", 200),
        ("localhost:PORT", 200),
        ("LocalHost:PORT", 200),
        ("[::1]:PORT", 200),
        ("localhost", 200),
        ("evil.example:PORT", 403),
        ("localhost.evil.example:PORT", 403),
        ("evil.example", 403),
        ("127.0.0.1:1", 403),
        ("127.0.0.2:PORT", 403),
        ("", 403),
    ],
)
async def test_a_request_in_another_name_is_refused(emulator, host, status):
    """A page of the web can have its own name resolved to loopback, but not forge the header."""
    url = await emulator()
    headers = {"host": host.replace("PORT", str(urlsplit(url).port))}
    async with aiohttp.ClientSession() as session:
        async with session.get(f"{url}/v1/models", headers=headers) as listed:
            assert listed.status == status
        async with session.post(f"{url}/v1/chat/completions", headers=headers, json={}) as reply:
            assert reply.status == status


async def test_a_port_in_use_is_a_usage_error(emulator):
    port = urlsplit(await emulator()).port
    with pytest.raises(UsageError, match=str(port)):
        await serve(port)


async def test_the_models_are_listed(emulator):
    url = await emulator()
    async with aiohttp.ClientSession() as session, session.get(f"{url}/v1/models") as reply:
        assert reply.status == 200
        body = await reply.json()
    assert body["object"] == "list"
    assert [(model["id"], model["object"]) for model in body["data"]] == [
        ("scripted-driver", "model")
    ]


async def test_it_announces_its_url_serves_and_closes_its_port_when_cancelled(driving_prompt):
    announced = asyncio.get_running_loop().create_future()
    serving = asyncio.create_task(run(0, announce=announced.set_result))
    async with asyncio.timeout(10):
        url = await announced
        status, _, _ = await ask(url, "openai-chat", driving_prompt)
        assert status == 200
        serving.cancel()
        with pytest.raises(asyncio.CancelledError):
            await serving
    with pytest.raises(aiohttp.ClientConnectorError):
        await ask(url, "openai-chat", driving_prompt)


FAULTY = ("rate_limit", "server_error", "bad_gateway", "empty", "refused", "malformed")


@all_wires
@pytest.mark.parametrize("fault", [None, *FAULTY])
async def test_every_reply_says_that_a_stand_in_made_it(emulator, driving_prompt, wire, fault):
    url = await emulator(FaultPlan(rates={fault: 1.0} if fault else {}))
    _, headers, body = await post(url, PATHS[wire], body_for(wire, driving_prompt))
    assert headers[SCRIPTED_HEADER] == "true"
    if fault != "bad_gateway":  # an HTML page
        assert json.loads(body)[SCRIPTED_FIELD] is True


async def test_a_reply_that_is_cut_off_says_it_too(emulator):
    said = await bytes_until_closed(await emulator(FaultPlan(rates={"truncated_body": 1.0})))
    assert f"{SCRIPTED_HEADER}: true".encode() in said


@pytest.mark.parametrize("path", ["/v1/models", "/nothing", "/v1/chat/completions"])
async def test_so_does_whatever_else_it_answers(emulator, path):
    async with aiohttp.ClientSession() as session, session.get(await emulator() + path) as reply:
        assert reply.headers[SCRIPTED_HEADER] == "true"
