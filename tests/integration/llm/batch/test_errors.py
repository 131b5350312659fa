"""What services make of servers that refuse, break off or say what they should not."""

import json
import socket
from datetime import UTC, datetime, timedelta

import pytest
from aiohttp import web
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from merge_runner.llm.batch.service import BatchFailed
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.http_outcome import judge
from tests.support.batch_fixtures import KEY, lines
from tests.support.cases import by_format, cases, table
from tests.support.json_values import paths, replaced

ADDRESSES, ENDED = table("batches", "addresses"), table("batches", "ended")
CREATE, BATCH, LISTS, RESULTS = ADDRESSES.values()


async def failure(service, form):
    with pytest.raises(BatchFailed) as failed:
        await service.create(lines(form, 2), "mark")
    return failed.value


def results_at(server, reply, form="anthropic", **counts):
    """Let a batch have ended with these results."""
    server.replies[BATCH[form]] = (200, ENDED[form] | {"request_counts": counts})
    server.replies[RESULTS[form]] = reply


def error(message="no", **members):
    return {"error": {"message": message, "type": "error", "code": "none", **members}}


@pytest.mark.parametrize("case", cases("batches", "creation"))
async def test_each_refusal_of_a_creation_says_what_to_do(server, service_at, form, case):
    status, kind = case["status"], case["kind"]
    server.replies[CREATE[form]] = (status, error(**case.get("error", {})), {"retry-after": "7"})
    failed = await failure(service_at(server.url, form), form)
    assert failed.kind == kind
    assert f"HTTP {status}" in str(failed)
    # A gateway may have waited for too long; no file is a batch, nor an error of the provider's.
    assert failed.sent == (status == 504 and form == "anthropic")
    assert kind != "again" or failed.delay_s == 7


URLS = ["", "x", "@127.0.0.1:1/x", "http://[::1", "http://h/\u00e9", "/" + "x" * 8050]


@pytest.mark.parametrize("url", URLS)
async def test_an_upload_goes_to_no_other_host_and_to_no_odd_place(server, service_at, url):
    server.replies[CREATE["gemini"]] = (200, {}, {"x-goog-upload-url": url})
    failed = await failure(service_at(server.url, "gemini"), "gemini")
    assert (failed.kind, failed.sent) == ("again", False)
    assert "names no URL" in str(failed)


@pytest.mark.parametrize("told", [{}, {"id": "../../etc", "name": "batches/../x"}])
async def test_a_creation_without_an_id_may_have_created_a_batch(server, service_at, form, told):
    server.replies["POST /up"] = (200, {"file": {"name": "files/f1"}})
    server.replies["POST /v1beta/models/some-model:batchGenerateContent"] = (200, told)
    headers = {"x-goog-upload-url": f"{server.url}/up"}
    server.replies[CREATE[form]] = (200, {}, headers) if form == "gemini" else (200, told)
    failed = await failure(service_at(server.url, form), form)
    # A file is no batch yet.
    assert (failed.kind, failed.sent) == ("again", not form.startswith("openai"))
    assert "of a known form" in str(failed)


async def test_a_creation_that_nobody_takes_was_not_sent(service_at, form):
    with socket.socket() as reserved:
        reserved.bind(("127.0.0.1", 0))
        service = service_at(f"http://127.0.0.1:{reserved.getsockname()[1]}", form)
        failed = await failure(service, form)
    assert (failed.kind, failed.sent) == ("again", False)
    assert "nothing listens" in str(failed)


def succeeded(key, text="an answer"):
    message = {"content": [{"type": "text", "text": text}], "stop_reason": "end_turn"}
    return {"custom_id": key, "result": {"type": "succeeded", "message": message}}


def jsonl(*parts):
    return b"\n".join(
        part if isinstance(part, bytes) else json.dumps(part).encode() for part in parts
    )


async def read(service):
    """The results by key, which is empty for broken ones, and how the reading failed."""
    results = []
    try:
        status = await service.status("b1")
        async for result in service.results(status.paths or []):
            results.append(result)  # noqa: PERF401 # those before a failure count
    except BatchFailed as exc:
        return results, exc
    return results, None


async def keys(service):
    results, failed = await read(service)
    return [key for key, _ in results], failed


@pytest.mark.parametrize("broken", cases("batches", "broken"))
async def test_a_result_that_cannot_be_used_costs_no_other_one(server, service_at, broken):
    parts = [b"\r", jsonl(succeeded("a")), b"", broken.encode(), jsonl(succeeded("c")) + b"\r", b""]
    results_at(server, (200, b"\n".join(parts)))
    service = service_at(server.url, "anthropic", most_bytes=4000)
    assert await keys(service) == (["a", "", "c"], None)


@pytest.mark.parametrize(("said", "kept"), [(r"\ud83d", r"\ud83d"), (KEY, "[key]")])
async def test_a_result_can_be_kept_and_echoes_no_key(server, service_at, said, kept):
    """A lone surrogate can be kept."""
    message = f'{{"type": "succeeded", "message": {{"x": "{said}"}}}}'
    results_at(server, (200, f'{{"custom_id": "a", "result": {message}}}'.encode()))
    (((_, result),), _) = await read(service_at(server.url, "anthropic"))
    assert result.body == f'{{"x": "{kept}"}}'


async def test_results_that_break_off_can_be_read_again(server, service_at):
    async def cut(request):
        whole = jsonl(succeeded("a"), succeeded("b"), b"")
        response = web.StreamResponse()
        response.content_length = len(whole)
        await response.prepare(request)
        await response.write(whole[: len(whole) // 2 + 10])
        request.transport.close()
        return response

    results_at(server, cut)
    service = service_at(server.url, "anthropic")
    told, failed = await keys(service)
    assert (told, failed.kind) == ([], "again")
    results_at(server, (200, jsonl(succeeded("a"), succeeded("b"))))
    assert await keys(service) == (["a", "b"], None)


async def test_a_key_goes_to_no_other_host_than_the_configured_one(server, service_at):
    results_at(server, (200, jsonl(succeeded("a"))))
    elsewhere = {"results_url": "http://127.0.0.1:1/elsewhere"}
    server.replies[BATCH["anthropic"]] = (200, ENDED["anthropic"] | elsewhere)
    service = service_at(server.url, "anthropic")
    assert (await service.status("b1")).paths == ["/v1/messages/batches/b1/results"]
    assert await keys(service) == (["a"], None)


@pytest.mark.parametrize(("form", "case"), by_format("batches", "lines"), indirect=["form"])
async def test_a_line_is_a_reply_or_was_not_asked(server, service_at, form, case):
    results_at(server, (200, case["line"].encode()), form)
    (((_, result),), _) = await read(service_at(server.url, form))
    assert (result.status if result else 0) == case["status"]
    if form == "anthropic":
        assert result.payload == json.loads(case["line"])["result"]["error"]


@pytest.mark.parametrize(("form", "case"), by_format("batches", "states"), indirect=["form"])
async def test_each_word_of_a_provider_is_a_state_or_says_why_it_failed(
    server, service_at, form, case
):
    server.replies[BATCH[form]] = (200, json.loads(case["body"]))
    status = await service_at(server.url, form).status("b1")
    assert (status.paths is not None) == (case["is"] == "ended")
    if case["is"] in ("waiting", "ended"):
        assert status.failure is None
    else:
        assert case["is"] in ("failed", status.failure.kind)
        assert case.get("says", "") in str(status.failure)


async def test_results_that_a_provider_has_and_does_not_show_yet_are_waited_for(server, service_at):
    done = {"status": "completed", "request_counts": {"total": 2, "completed": 2, "failed": 0}}
    server.replies[BATCH["openai-chat"]] = (200, done)
    assert (await service_at(server.url, "openai-chat").status("b1")).results == 2
    succeeded = {"done": True, "metadata": {"state": "BATCH_STATE_SUCCEEDED"}}
    server.replies[BATCH["gemini"]] = (200, succeeded)
    assert (await read(service_at(server.url, "gemini")))[1].kind == "again"


async def test_a_list_that_turns_in_a_circle_ends(server, service_at):
    page = {"data": [{"id": "b1"}], "has_more": True, "last_id": "b1"}
    server.replies["GET /v1/batches"] = (200, page)
    assert await service_at(server.url, "openai-chat").find("mark") is None
    assert len(server.asked) == 2


@pytest.mark.parametrize(
    ("form", "where"),
    [*BATCH.items(), *((form, at) for form, (at, _) in LISTS.items())],
    indirect=["form"],
)
@pytest.mark.parametrize(
    ("kind", "statuses"),
    {"lost": (404, 410), "again": (405, 413, 429, 500), "rejected": (401,)}.items(),
)
async def test_a_batch_that_may_exist_is_never_asked_singly(
    server, service_at, form, where, kind, statuses
):
    service = service_at(server.url, form)
    for status in statuses:
        server.replies[where] = (status, error("m" * 10_000))
        with pytest.raises(BatchFailed) as failed:
            await (service.status("b1") if where == BATCH[form] else service.find("b1"))
        assert failed.value.kind == kind
        assert len(str(failed.value)) < 600, "no more than a reader takes"


@pytest.mark.parametrize(("status", "kind"), [(404, "again"), (410, "lost"), (500, "again")])
async def test_a_file_of_answers_that_is_not_there_yet_is_asked_for_again(
    server, service_at, status, kind
):
    results_at(server, (status, error()), "openai-chat")
    server.replies[BATCH["openai-chat"]][1]["error_file_id"] = "f2"
    line = {"custom_id": "b", "response": {"status_code": 429, "body": error()}}
    server.replies["GET /v1/files/f2/content"] = (200, jsonl(line))
    told, failed = await keys(service_at(server.url, "openai-chat"))
    assert (told, failed.kind) == ([], kind)


def listed(form, mark, created, batch_id="b1"):
    """A batch of one request as a list shows it."""
    if form == "openai-chat":
        metadata = {"merge_runner_mark": mark}
        return {"id": batch_id, "created_at": created.timestamp(), "metadata": metadata}
    metadata = {"displayName": mark, "createTime": created.isoformat()}
    return {"name": f"batches/{batch_id}", "metadata": metadata}


def paged(member, *pages):
    """A list in pages, the last of which alone has none after it."""

    async def reply(request):
        number = int(next((v for k, v in request.query.items() if "after" in k or "Token" in k), 0))
        page = {member: pages[number]}
        if number + 1 < len(pages):
            following = str(number + 1)
            page |= {"has_more": True, "last_id": following, "nextPageToken": following}
        return web.json_response(page)

    return reply


@pytest.mark.parametrize("form", LISTS, indirect=True)
async def test_a_batch_is_found_in_a_list_that_begins_with_the_oldest(server, service_at, form):
    where, member = LISTS[form]
    now = datetime(2026, 11, 22, 12, tzinfo=UTC)
    old = [listed(form, "old", now - timedelta(days=n), f"old{n}") for n in (9, 8, 7)]
    new = [listed(form, mark, now, mark * 240) for mark in ("other", "mark")]
    server.replies[where] = paged(member, old[:2], [], [old[2]], new)
    assert await service_at(server.url, form).find("mark") == "mark" * 240


@pytest.mark.parametrize("form", BATCH, indirect=True)
async def test_every_request_has_the_headers_of_its_format(server, service_at, form):
    service = service_at(server.url, form)
    await failure(service, form)
    results_at(server, (404, b""), form)
    await read(service)
    if form in LISTS:
        with pytest.raises(BatchFailed):
            await service.find("mark")
    expected = "2023-06-01" if form == "anthropic" else None
    assert {headers.get("anthropic-version") for _, headers in server.asked} == {expected}


values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.just(10**30)
    | st.floats()
    | st.text()
    | st.sampled_from(["9" * 5000, "\ud83d", "0001-01-01T00:00:00+23:59"]),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(), inner, max_size=2),
    max_leaves=4,
)


SAMPLES = {
    form: {name: json.loads(text) for name, text in sample.items()}
    for form, sample in table("batches", "samples").items()
}


@pytest.mark.parametrize("form", SAMPLES, indirect=True)
@settings(max_examples=40, suppress_health_check=list(HealthCheck))
@given(data=st.data())
async def test_no_value_of_a_wrong_type_is_a_traceback(server, service_at, form, data):
    """Whatever a server sends in place of what it should, a service ends in BatchFailed."""
    more = {"has_more": False, "last_id": "b1", "nextPageToken": ""}
    where, member = LISTS.get(form, ("GET /none", "data"))
    told = SAMPLES[form] | {"page": {member: [SAMPLES[form]["batch"]], **more}}
    path = data.draw(st.sampled_from(sorted(paths(told), key=str)))
    told = replaced(told, path, data.draw(values))
    lines = told["lines"] if isinstance(told["lines"], list) else [told["lines"]]
    server.replies[where] = (200, jsonl(told["page"]))
    server.replies[BATCH[form]] = (200, jsonl(told["batch"]))
    server.replies[RESULTS[form]] = (200, jsonl(*lines))
    service = service_at(server.url, form)
    try:
        for _, raw in (await read(service))[0]:
            raw and judge(raw, FORMATS[form])
        if service.takes_mark:
            await service.find("mark")
    except BatchFailed as exc:
        assert str(exc)  # noqa: PT017 # it may come or not
