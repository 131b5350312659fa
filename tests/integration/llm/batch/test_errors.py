"""What services make of servers that refuse, break off or say what they should not."""

from __future__ import annotations

import asyncio
import json
import socket
from datetime import UTC, datetime, timedelta

import pytest
from aiohttp import web

from merge_runner.errors import UsageError
from merge_runner.llm.batch.providers import BatchFailed
from tests.support.batch_fixtures import KEY, endpoint_at
from tests.support.batch_lines import lines

CREATE = {
    "openai-chat": "POST /v1/files",
    "openai-responses": "POST /v1/files",
    "anthropic": "POST /v1/messages/batches",
    "gemini": "POST /upload/v1beta/files",
}
BATCH = {
    "openai-chat": "GET /v1/batches/b1",
    "anthropic": "GET /v1/messages/batches/b1",
    "gemini": "GET /v1beta/batches/b1",
}
LISTS = {
    "openai-chat": "GET /v1/batches",
    "gemini": "GET /v1beta/batches",
}
RESULTS = "GET /v1/messages/batches/b1/results"
OUTPUT, ERRORS = "GET /v1/files/f1/content", "GET /v1/files/f2/content"


async def failure(service, form, count=2):
    with pytest.raises(BatchFailed) as failed:
        await service.create(lines(form, count), "mark")
    return failed.value


def results_at(server, reply, **counts):
    """Let a batch of Anthropic have these results."""
    ended = {"id": "b1", "processing_status": "ended", "request_counts": counts}
    server.replies[BATCH["anthropic"]] = (200, ended)
    server.replies[RESULTS] = reply


def error(message="no", **members):
    return {"error": {"message": message, "type": "error", "code": "none", **members}}


@pytest.mark.parametrize(
    ("status", "body", "kind"),
    [
        (401, error(), "refused"),
        (403, error(), "refused"),
        (404, error(), "refused"),
        (405, error(), "refused"),
        (400, error(), "refused"),
        (413, error(), "smaller"),
        (429, error(), "again"),
        (429, error(code="token_limit_exceeded"), "smaller"),
        (429, error("You have reached the limit of enqueued tokens."), "smaller"),
        (429, error(type="insufficient_quota", code="insufficient_quota"), "quota"),
        (402, error(), "quota"),
        (500, error(), "again"),
        (503, error(), "again"),
        (504, {}, "again"),
        (302, {}, "refused"),
    ],
)
async def test_each_refusal_of_a_creation_says_what_to_do(
    server, service_at, form, status, body, kind
):
    server.replies[CREATE[form]] = (status, body, {"retry-after": "7"})
    failed = await failure(service_at(server.url, form), form)
    assert failed.kind == kind
    assert f"HTTP {status}" in str(failed)
    # A gateway may have waited for too long; no file is a batch, nor an error of the provider's.
    assert failed.sent == (status == 504 and form == "anthropic")
    assert kind != "again" or failed.delay_s == 7


@pytest.mark.parametrize(
    "url", ["", "x", "@127.0.0.1:1/x", "http://[::1", "http://h/\u00e9", "/" + "x" * 8050]
)
async def test_an_upload_goes_to_no_other_host_and_to_no_odd_place(server, service_at, url):
    begun = (200, {}, {"x-goog-upload-url": url})
    server.replies[CREATE["gemini"]] = begun
    failed = await failure(service_at(server.url, "gemini"), "gemini")
    assert (failed.kind, failed.sent) == ("again", False)
    assert "names no URL" in str(failed)


async def test_no_path_leads_to_another_host(server, transport_to):
    transport = transport_to(endpoint_at(server.url, "anthropic"))
    with pytest.raises(UsageError, match="can be no path"):
        await transport.ask("GET", "@localhost:1/x", {}, timeout_s=5)
    with pytest.raises(UsageError, match="can be no path"):
        await transport.ask("GET", "0/x", {}, timeout_s=5)
    assert not server.asked


@pytest.mark.parametrize("told", [{}, {"id": "../../etc", "name": "batches/../x"}])
async def test_a_creation_without_an_id_may_have_created_a_batch(server, service_at, form, told):
    server.replies["POST /up"] = (200, {"file": {"name": "files/f1"}})
    server.replies["POST /v1beta/models/some-model:batchGenerateContent"] = (200, told)
    if form == "gemini":
        server.replies[CREATE[form]] = (200, {}, {"x-goog-upload-url": f"{server.url}/up"})
    else:
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


async def results_of(service):
    status = await service.status("b1")
    return [raw async for _, raw in service.results(status.paths)]


async def read(service):
    """The keys of the results, which are empty for broken ones, and how the reading failed."""
    keys = []
    try:
        status = await service.status("b1")
        async for key, _ in service.results(status.paths):
            keys.append(key)
    except BatchFailed as exc:
        return keys, exc
    return keys, None


@pytest.mark.parametrize(
    "broken",
    [
        b'{"custom_id": "b", "res',
        b"[1, 2]",
        b'"text"',
        b'{"result": {"type": "succeeded"}}',
        b'{"custom_id": 7, "result": {}}',
        b'{"custom_id": "b", "result": {"type": "strange"}}',
    ],
)
async def test_a_result_that_cannot_be_used_costs_no_other_one(server, service_at, broken):
    results_at(server, (200, jsonl(succeeded("a"), broken, succeeded("c"), b"")))
    keys, failed = await read(service_at(server.url, "anthropic", most_bytes=4000))
    assert (keys, failed) == (["a", "", "c"], None)


async def test_a_lone_surrogate_in_a_result_can_be_kept(server, service_at):
    line = rb'{"custom_id": "a", "result": {"type": "succeeded", "message": {"x": "\ud83d"}}}'
    results_at(server, (200, line))
    (result,) = await results_of(service_at(server.url, "anthropic"))
    assert result.body.encode() == rb'{"x": "\ud83d"}'


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

    results_at(server, cut)
    service = service_at(server.url, "anthropic")
    keys, failed = await read(service)
    assert (keys, failed.kind) == ([], "again")
    results_at(server, (200, jsonl(succeeded("a"), succeeded("b"))))
    assert await read(service) == (["a", "b"], None)


async def test_a_key_goes_to_no_other_host_than_the_configured_one(server, service_at):
    batch = {
        "id": "b1",
        "processing_status": "ended",
        "results_url": "http://127.0.0.1:1/elsewhere",
    }
    server.replies["GET /v1/messages/batches/b1"] = (200, batch)
    server.replies[RESULTS] = (200, jsonl(succeeded("a")))
    service = service_at(server.url, "anthropic")
    assert (await service.status("b1")).paths == ["/v1/messages/batches/b1/results"]
    assert await read(service) == (["a"], None)


async def test_a_reply_echoes_no_key(server, service_at):
    results_at(server, (200, jsonl(succeeded("a", f"your key is {KEY}"))))
    (result,) = await results_of(service_at(server.url, "anthropic"))
    assert KEY not in result.body
    assert "[key]" in result.body


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
    server.replies[BATCH["openai-chat"]] = (200, {"status": "completed", "error_file_id": "f1"})
    server.replies[OUTPUT] = (200, jsonl({"custom_id": "a", **line}))
    (result,) = await results_of(service_at(server.url, "openai-chat"))
    assert (result and result.status) == status


@pytest.mark.parametrize(
    ("code", "status"), [(3, 400), (8, 429), (13, 500), (14, 503), (99, 500), (429, 429), (1, None)]
)
async def test_an_error_of_gemini_has_the_status_of_its_code(server, service_at, code, status):
    server.replies[BATCH["gemini"]] = (200, {"done": True, "response": {"responsesFile": "f1"}})
    line = {"key": "a", "error": {"code": code, "message": "m"}}
    server.replies["GET /v1beta/f1:download"] = (200, jsonl(line))
    (result,) = await results_of(service_at(server.url, "gemini"))
    assert (result and result.status) == status


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
    results_at(server, (200, jsonl(line)))
    (result,) = await results_of(service_at(server.url, "anthropic"))
    assert (result.status, result.payload) == (status, told)


@pytest.mark.parametrize(
    ("form", "path", "batch", "state"),
    [
        ("openai-chat", "/v1/batches/b1", {"status": "validating"}, "waiting"),
        ("openai-chat", "/v1/batches/b1", {"status": "finalizing"}, "waiting"),
        ("openai-chat", "/v1/batches/b1", {"status": "some new one"}, "waiting"),
        ("openai-chat", "/v1/batches/b1", {"status": "failed"}, "failed"),
        ("openai-chat", "/v1/batches/b1", {"status": "expired"}, "ended"),
        ("anthropic", "/v1/messages/batches/b1", {"processing_status": "canceling"}, "waiting"),
        (
            "anthropic",
            "/v1/messages/batches/b1",
            {"id": "b1", "processing_status": "ended"},
            "ended",
        ),
        ("gemini", "/v1beta/batches/b1", {"metadata": {"state": "BATCH_STATE_RUNNING"}}, "waiting"),
        ("gemini", "/v1beta/batches/b1", {"metadata": {"state": "JOB_STATE_PAUSED"}}, "waiting"),
        ("gemini", "/v1beta/batches/b1", {"metadata": {"state": "JOB_STATE_EXPIRED"}}, "ended"),
        ("gemini", "/v1beta/batches/b1", {"metadata": {"state": "BATCH_STATE_FAILED"}}, "failed"),
        ("gemini", "/v1beta/batches/b1", {"metadata": {"state": "batch_state_failed"}}, "failed"),
        ("gemini", "/v1beta/batches/b1", {"done": True, "response": {}}, "ended"),
        ("gemini", "/v1beta/batches/b1", {"done": True, "error": {"code": 13}}, "failed"),
        ("gemini", "/v1beta/batches/b1", {"done": "no"}, "waiting"),
        ("openai-chat", "/v1/batches/b1", {"status": "Completed"}, "ended"),
        (
            "anthropic",
            "/v1/messages/batches/b1",
            {"id": "b1", "processing_status": "ENDED"},
            "ended",
        ),
    ],
)
async def test_each_word_of_a_provider_is_one_of_three_states(
    server, service_at, form, path, batch, state
):
    server.replies[f"GET {path}"] = (200, batch)
    status = await service_at(server.url, form).status("b1")
    assert (status.paths is not None, status.failure is not None) == (
        state == "ended",
        state == "failed",
    )


async def test_results_that_a_provider_has_and_does_not_show_yet_are_waited_for(server, service_at):
    done = {"status": "completed", "request_counts": {"total": 2, "completed": 2, "failed": 0}}
    server.replies[BATCH["openai-chat"]] = (200, done)
    assert (await service_at(server.url, "openai-chat").status("b1")).results == 2
    server.replies[BATCH["gemini"]] = (
        200,
        {"done": True, "metadata": {"state": "BATCH_STATE_SUCCEEDED"}},
    )
    assert (await read(service_at(server.url, "gemini")))[1].kind == "again"


async def test_a_list_that_turns_in_a_circle_ends(server, service_at):
    page = {"data": [{"id": "b1"}], "has_more": True, "last_id": "b1"}
    server.replies[LISTS["openai-chat"]] = (200, page)
    service = service_at(server.url, "openai-chat")
    assert await service.find("mark") is None
    assert len(server.asked) == 2


async def used(service, what):
    """What an operation on a batch that exists raises."""
    asked = {
        "status": lambda: service.status("b1"),
        "find": lambda: service.find("mark"),
    }
    with pytest.raises(BatchFailed) as failed:
        await asked[what]()
    return failed.value


@pytest.mark.parametrize(
    ("form", "what"),
    [
        (form, what)
        for form in BATCH
        for what in ("status", "find")
        if form in LISTS or what != "find"
    ],
)
@pytest.mark.parametrize(
    ("status", "kind"),
    [
        (404, "lost"),
        (410, "lost"),
        (405, "again"),
        (413, "again"),
        (429, "again"),
        (500, "again"),
        (401, "refused"),
    ],
)
async def test_a_batch_that_may_exist_is_never_asked_singly(
    server, service_at, form, what, status, kind
):
    where = {"status": BATCH, "find": LISTS}[what][form]
    server.replies[where] = (status, error())
    assert (await used(service_at(server.url, form), what)).kind == kind


@pytest.mark.parametrize(("status", "kind"), [(404, "again"), (410, "lost"), (500, "again")])
async def test_a_file_of_answers_that_is_not_there_yet_is_asked_for_again(
    server, service_at, status, kind
):
    ended = {"status": "completed", "output_file_id": "f1", "error_file_id": "f2"}
    server.replies[BATCH["openai-chat"]] = (200, ended)
    server.replies[OUTPUT] = (status, error())
    line = {"custom_id": "b", "response": {"status_code": 429, "body": error()}}
    server.replies[ERRORS] = (200, jsonl(line))
    keys, failed = await read(service_at(server.url, "openai-chat"))
    assert (keys, failed.kind) == ([], kind)


async def test_blank_lines_and_those_of_windows_are_results_of_nothing(server, service_at):
    body = b"\r\n".join([b"", *jsonl(succeeded("a"), b"", succeeded("b")).split(b"\n"), b"", b""])
    results_at(server, (200, body), succeeded=2)
    assert await read(service_at(server.url, "anthropic")) == (["a", "b"], None)


async def test_a_message_shows_no_more_than_a_reader_takes(server, service_at):
    server.replies[BATCH["anthropic"]] = (500, error("m" * 10_000))
    assert len(str(await used(service_at(server.url, "anthropic"), "status"))) < 600


LIST_MEMBERS = {"openai-chat": "data", "gemini": "operations"}


def listed(form, mark, created, batch_id="b1"):
    """A batch of one request as a list shows it."""
    if form == "openai-chat":
        metadata = {"merge_runner_mark": mark}
        return {"id": batch_id, "created_at": created.timestamp(), "metadata": metadata}
    metadata = {"displayName": mark, "createTime": created.isoformat()}
    return {"name": f"batches/{batch_id}", "metadata": metadata}


def paged(form, *pages):
    """A list in pages, the last of which alone has none after it."""

    async def reply(request):
        number = int(next((v for k, v in request.query.items() if "after" in k or "Token" in k), 0))
        page = {LIST_MEMBERS[form]: pages[number]}
        if number + 1 < len(pages):
            following = str(number + 1)
            page |= {"has_more": True, "last_id": following, "nextPageToken": following}
        return web.json_response(page)

    return reply


NOW = datetime(2026, 11, 22, 12, tzinfo=UTC)


@pytest.mark.parametrize("form", LISTS)
async def test_a_batch_is_found_in_a_list_that_begins_with_the_oldest(server, service_at, form):
    old = [listed(form, "old", NOW - timedelta(days=n), f"old{n}") for n in (9, 8, 7)]
    new = [listed(form, mark, NOW, mark * 240) for mark in ("other", "mark")]
    server.replies[LISTS[form]] = paged(form, old[:2], [], [old[2]], new)
    assert await service_at(server.url, form).find("mark") == "mark" * 240


@pytest.mark.parametrize("form", BATCH)
async def test_every_request_has_the_headers_of_its_format(server, service_at, form):
    service = service_at(server.url, form)
    await failure(service, form)
    for what in ("status", *(["find"] if form in LISTS else [])):
        await used(service, what)
    server.replies[BATCH[form]] = (
        200,
        {"id": "b1", "status": "completed", "processing_status": "ended", "done": True},
    )
    await read(service)
    expected = "2023-06-01" if form == "anthropic" else None
    assert {headers.get("anthropic-version") for _, headers in server.asked} == {expected}


@pytest.mark.parametrize(
    ("form", "batch", "kind"),
    [
        ("openai-chat", {"code": "server_error"}, "again"),
        ("openai-chat", {"code": "rate_limit_exceeded"}, "again"),
        ("openai-chat", {"code": "token_limit_exceeded"}, "smaller"),
        ("openai-chat", {"code": "invalid_json_line"}, "refused"),
        ("openai-chat", {"code": "model_not_found"}, "refused"),
        ("gemini", {"code": 8}, "again"),
        ("gemini", {"code": 8, "message": "Enqueued token limit reached"}, "smaller"),
        ("gemini", {"code": 13}, "again"),
        ("gemini", {"code": 14}, "again"),
        ("gemini", {"code": 503}, "again"),
        ("gemini", {"code": 3}, "refused"),
        ("gemini", {"code": 12}, "refused"),
        ("gemini", {"code": 7}, "refused"),
    ],
)
async def test_a_failed_batch_says_why_and_what_to_do(server, service_at, form, batch, kind):
    told = {
        "openai-chat": {"status": "failed", "errors": {"data": [batch]}},
        "gemini": {"metadata": {"state": "BATCH_STATE_FAILED"}, "error": batch},
    }
    batch.setdefault("message", "odd")
    server.replies[BATCH[form]] = (200, told[form])
    status = await service_at(server.url, form).status("b1")
    assert (status.paths, status.failure.kind) == (None, kind)
    assert batch["message"] in str(status.failure)


@pytest.mark.parametrize("told", [{}, {"errors": None}, {"errors": {"data": []}}])
async def test_a_batch_that_fails_without_a_word_is_told_as_such(server, service_at, told):
    server.replies[BATCH["openai-chat"]] = (200, {"status": "failed", **told})
    failure = (await service_at(server.url, "openai-chat").status("b1")).failure
    assert str(failure) in ("HTTP 400: no reason is given", 'HTTP 400: {"data": []}')
