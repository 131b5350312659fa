"""What services make of servers that refuse, break off or say what they should not."""

from __future__ import annotations

import asyncio
import gzip
import json
import socket
from datetime import UTC, datetime

import pytest
from aiohttp import web

from merge_runner.llm.batch.service import BatchFailed
from tests.llm.batch.conftest import KEY
from tests.llm.batch.lines import lines

CREATE = {
    "openai-chat": "POST /v1/files",
    "openai-responses": "POST /v1/files",
    "anthropic": "POST /v1/messages/batches",
    "gemini": "POST /v1beta/models/some-model:batchGenerateContent",
}
RESULTS = "GET /v1/messages/batches/b1/results"


async def failure(service, form):
    with pytest.raises(BatchFailed) as failed:
        await service.submit(lines(form, 1), "mark")
    return failed.value


def error(message="no", **members):
    return {"error": {"message": message, "type": "error", "code": "none", **members}}


@pytest.mark.parametrize(
    ("status", "body", "kind"),
    [
        (401, error(), "refused"),
        (403, error(), "refused"),
        (404, error(), "single"),
        (405, error(), "single"),
        (400, error(), "single"),
        (413, error(), "smaller"),
        (429, error(), "again"),
        (429, error(code="token_limit_exceeded"), "smaller"),
        (429, error("You have reached the limit of enqueued tokens."), "smaller"),
        (429, error(type="insufficient_quota", code="insufficient_quota"), "quota"),
        (402, error(), "quota"),
        (500, error(), "again"),
        (503, error(), "again"),
        (302, {}, "single"),
    ],
)
async def test_each_refusal_of_a_creation_says_what_to_do(
    server, service_at, form, status, body, kind
):
    server.replies[CREATE[form]] = (status, body, {"retry-after": "7"})
    failed = await failure(service_at(server.url, form), form)
    assert failed.kind == kind
    assert f"HTTP {status}" in str(failed)
    # A gateway may say that it waited for too long; OpenAI's file is no batch yet.
    assert failed.sent == (status >= 500 and not form.startswith("openai"))
    assert kind != "again" or failed.delay_s == 7


@pytest.mark.parametrize("told", [{}, {"id": "../../etc", "name": "batches/../x"}])
async def test_a_creation_without_an_id_may_have_created_a_batch(server, service_at, form, told):
    server.replies[CREATE[form]] = (200, told)
    failed = await failure(service_at(server.url, form), form)
    assert failed.kind == "again"
    assert "of a known form" in str(failed)
    # A file is no batch yet.
    assert failed.sent == (not form.startswith("openai"))


async def test_a_creation_that_nobody_takes_was_not_sent(service_at, form):
    with socket.socket() as reserved:
        reserved.bind(("127.0.0.1", 0))
        service = service_at(f"http://127.0.0.1:{reserved.getsockname()[1]}", form)
        failed = await failure(service, form)
    assert (failed.kind, failed.sent) == ("again", False)
    assert "nothing listens" in str(failed)


async def test_no_error_shows_the_key(server, service_at, form):
    server.replies[CREATE[form]] = (401, error(f"Incorrect key: {KEY}"))
    assert KEY not in str(await failure(service_at(server.url, form), form))


def succeeded(key, text="an answer"):
    message = {"content": [{"type": "text", "text": text}], "stop_reason": "end_turn"}
    return {"custom_id": key, "result": {"type": "succeeded", "message": message}}


def jsonl(*parts):
    return b"\n".join(
        part if isinstance(part, bytes) else json.dumps(part).encode() for part in parts
    )


async def read(service):
    """The keys of the results that can be used, and what is said of the others."""
    results = []
    try:
        async for result in service.results("b1"):
            results.append(result)  # noqa: PERF401 # those before the error are kept
    except BatchFailed as exc:
        return [each.key for each in results], exc
    return [each.key for each in results], None


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        (b'{"custom_id": "b", "res', "line 2 is no JSON"),
        (b"[1, 2]", "line 2 is no JSON object"),
        (b'"text"', "line 2 is no JSON object"),
        (b'{"result": {"type": "succeeded"}}', "it has no custom_id"),
        (b'{"custom_id": 7, "result": {}}', "it has no custom_id"),
        (b'{"custom_id": "b", "result": {"type": "strange"}}', "of b is of no known type"),
        (jsonl(succeeded("a", "another")), "there is another result of a"),
        (b"[" * 200 + b"]" * 200, "line 2: the reply is refused: it nests deeper"),
        (
            jsonl(succeeded("b", "x" * 5000)),
            "line 2: the reply is refused: it is longer than 0.004",
        ),
    ],
)
async def test_a_result_that_cannot_be_used_costs_no_other_one(server, service_at, broken, said):
    server.replies[RESULTS] = (200, jsonl(succeeded("a"), broken, succeeded("c"), b""))
    keys, failed = await read(service_at(server.url, "anthropic", most_bytes=4000))
    assert keys == ["a", "c"]
    assert failed.kind == "single"
    assert said in str(failed)


async def test_one_error_speaks_for_all_results_that_cannot_be_used(server, service_at):
    server.replies[RESULTS] = (200, jsonl(b"?", succeeded("a"), b"?", succeeded("a")))
    keys, failed = await read(service_at(server.url, "anthropic"))
    assert keys == ["a"]
    assert str(failed) == "3 results of the batch cannot be used: line 1 is no JSON"


async def test_a_lone_surrogate_in_a_result_can_be_kept(server, service_at):
    server.replies[RESULTS] = (
        200,
        rb'{"custom_id": "a", "result": {"type": "succeeded", "message": {"x": "\ud83d"}}}',
    )
    (result,) = [each async for each in service_at(server.url, "anthropic").results("b1")]
    assert result.raw.body.encode() == rb'{"x": "\ud83d"}'


async def test_results_that_break_off_can_be_read_again(server, service_at):
    async def cut(request):
        whole = jsonl(succeeded("a"), succeeded("b"), b"")
        response = web.StreamResponse()
        response.content_length = len(whole)
        await response.prepare(request)
        await response.write(whole[: len(whole) // 2 + 10])
        await asyncio.sleep(0.05)
        request.transport.abort()
        return response

    server.replies[RESULTS] = cut
    service = service_at(server.url, "anthropic")
    keys, failed = await read(service)
    assert (keys, failed.kind) == (["a"], "again")
    server.replies[RESULTS] = (200, jsonl(succeeded("a"), succeeded("b")))
    assert await read(service) == (["a", "b"], None)


async def test_packed_results_are_read(server, service_at):
    async def packed(request):
        body = gzip.compress(jsonl(succeeded("a"), succeeded("b")))
        return web.Response(body=body, headers={"content-encoding": "gzip"})

    server.replies[RESULTS] = packed
    assert await read(service_at(server.url, "anthropic")) == (["a", "b"], None)


async def test_results_that_are_refused_say_what_to_do(server, service_at):
    server.replies[RESULTS] = (503, error("busy"))
    _, failed = await read(service_at(server.url, "anthropic"))
    assert (failed.kind, str(failed)) == ("again", "HTTP 503: busy")


async def test_a_key_goes_to_no_other_host_than_the_configured_one(server, service_at):
    batch = {"processing_status": "ended", "results_url": "http://127.0.0.1:1/elsewhere"}
    server.replies["GET /v1/messages/batches/b1"] = (200, batch)
    server.replies[RESULTS] = (200, jsonl(succeeded("a")))
    service = service_at(server.url, "anthropic")
    assert (await service.status("b1")).state == "ended"
    assert await read(service) == (["a"], None)


async def test_a_reply_echoes_no_key(server, service_at):
    server.replies[RESULTS] = (200, jsonl(succeeded("a", f"your key is {KEY}")))
    (result,) = [each async for each in service_at(server.url, "anthropic").results("b1")]
    assert KEY not in result.raw.body
    assert "[key]" in result.raw.body


@pytest.mark.parametrize(
    ("line", "status"),
    [
        ({"response": {"status_code": 200, "body": {"x": 1}}, "error": None}, 200),
        ({"response": {"status_code": 400, "body": {"error": {}}}, "error": None}, 400),
        ({"response": None, "error": {"code": "server_error", "message": "m"}}, 500),
        ({"response": None, "error": {"code": "batch_expired", "message": "m"}}, None),
        ({"response": None, "error": {"code": "batch_cancelled", "message": "m"}}, None),
    ],
)
async def test_a_line_of_openai_is_a_reply_or_was_not_asked(server, service_at, line, status):
    server.replies["GET /v1/batches/b1"] = (200, {"status": "completed", "error_file_id": "f1"})
    server.replies["GET /v1/files/f1/content"] = (200, jsonl({"custom_id": "a", **line}))
    (result,) = [each async for each in service_at(server.url, "openai-chat").results("b1")]
    assert (result.raw and result.raw.status) == status


@pytest.mark.parametrize(
    ("code", "status"), [(3, 400), (8, 429), (13, 500), (14, 503), (99, 500), (429, 429), (1, None)]
)
async def test_an_error_of_gemini_has_the_status_of_its_code(server, service_at, code, status):
    responses = [{"metadata": {"key": "a"}, "error": {"code": code, "message": "m"}}]
    output = {"inlinedResponses": {"inlinedResponses": responses}}
    server.replies["GET /v1beta/batches/b1"] = (200, {"done": True, "response": output})
    (result,) = [each async for each in service_at(server.url, "gemini").results("b1")]
    assert (result.raw and result.raw.status) == status


@pytest.mark.parametrize(
    ("kind", "status"),
    [
        ("invalid_request_error", 400),
        ("rate_limit_error", 429),
        ("overloaded_error", 529),
        ("new", 500),
    ],
)
async def test_an_error_of_anthropic_has_the_status_of_its_type(server, service_at, kind, status):
    told = {"type": "error", "error": {"type": kind, "message": "m"}}
    line = {"custom_id": "a", "result": {"type": "errored", "error": told}}
    server.replies[RESULTS] = (200, jsonl(line))
    (result,) = [each async for each in service_at(server.url, "anthropic").results("b1")]
    assert (result.raw.status, result.raw.payload) == (status, told)


@pytest.mark.parametrize(
    ("form", "path", "batch", "state"),
    [
        ("openai-chat", "/v1/batches/b1", {"status": "validating"}, "waiting"),
        ("openai-chat", "/v1/batches/b1", {"status": "finalizing"}, "waiting"),
        ("openai-chat", "/v1/batches/b1", {"status": "some new one"}, "waiting"),
        ("openai-chat", "/v1/batches/b1", {"status": "failed"}, "failed"),
        ("openai-chat", "/v1/batches/b1", {"status": "expired"}, "ended"),
        ("anthropic", "/v1/messages/batches/b1", {"processing_status": "canceling"}, "waiting"),
        ("anthropic", "/v1/messages/batches/b1", {"processing_status": "ended"}, "ended"),
        ("gemini", "/v1beta/batches/b1", {"metadata": {"state": "BATCH_STATE_RUNNING"}}, "waiting"),
        ("gemini", "/v1beta/batches/b1", {"metadata": {"state": "JOB_STATE_PAUSED"}}, "waiting"),
        ("gemini", "/v1beta/batches/b1", {"metadata": {"state": "JOB_STATE_EXPIRED"}}, "ended"),
        ("gemini", "/v1beta/batches/b1", {"metadata": {"state": "BATCH_STATE_FAILED"}}, "failed"),
    ],
)
async def test_each_word_of_a_provider_is_one_of_three_states(
    server, service_at, form, path, batch, state
):
    server.replies[f"GET {path}"] = (200, batch)
    assert (await service_at(server.url, form).status("b1")).state == state


async def test_results_that_a_provider_has_and_does_not_show_yet_are_waited_for(server, service_at):
    done = {"status": "completed", "request_counts": {"total": 2, "completed": 2, "failed": 0}}
    server.replies["GET /v1/batches/b1"] = (200, done)
    assert (await read(service_at(server.url, "openai-chat")))[1].kind == "again"
    server.replies["GET /v1beta/batches/b1"] = (
        200,
        {"done": True, "metadata": {"state": "BATCH_STATE_SUCCEEDED"}},
    )
    assert (await read(service_at(server.url, "gemini")))[1].kind == "again"


async def test_a_list_that_turns_in_a_circle_ends(server, service_at):
    page = {"data": [{"id": "b1"}], "has_more": True}
    server.replies["GET /v1/batches"] = (200, page)
    service = service_at(server.url, "openai-chat")
    assert await service.find("mark", [], since=datetime.now(UTC)) is None
    assert len(server.asked) == 2


async def test_a_failed_batch_says_why_and_what_to_do(server, service_at):
    errors = {"data": [{"code": "model_not_found", "message": "no such model", "line": 1}]}
    server.replies["GET /v1/batches/b1"] = (200, {"status": "failed", "errors": errors})
    status = await service_at(server.url, "openai-chat").status("b1")
    assert (status.failure, status.message) == ("refused", "no such model")
    server.replies["GET /v1beta/batches/b1"] = (
        200,
        {"metadata": {"state": "BATCH_STATE_FAILED"}, "error": {"code": 3, "message": "odd"}},
    )
    status = await service_at(server.url, "gemini").status("b1")
    assert (status.failure, status.message) == ("single", "odd")
