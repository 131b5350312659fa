"""Whatever a server sends in place of what it should, services end with a result or BatchFailed."""

from __future__ import annotations

import copy
import json

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from merge_runner.llm.batch.providers import BatchFailed
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.http_outcome import judge

MARK, NOW = "mark", "2026-11-22T12:00:00Z"
LINES = {
    "openai-chat": [
        {"custom_id": "a", "response": {"status_code": 200, "body": {"id": "x"}}, "error": None},
        {"custom_id": "b", "error": {"code": "batch_expired", "message": "m"}},
    ],
    "anthropic": [
        {"custom_id": "a", "result": {"type": "succeeded", "message": {"content": []}}},
        {"custom_id": "b", "result": {"type": "errored", "error": {"error": {"type": "t"}}}},
    ],
    "gemini": [
        {"key": "a", "response": {"candidates": []}},
        {"key": "b", "error": {"code": 13, "message": "m", "status": "INTERNAL", "details": []}},
    ],
}
BATCHES = {
    "openai-chat": {
        "id": "b1",
        "status": "failed",
        "errors": {"data": [{"code": "server_error", "message": "m", "line": 1}]},
        "request_counts": {"total": 2, "completed": 1, "failed": 1},
        "output_file_id": "f1",
        "error_file_id": "f1",
        "metadata": {"merge_runner_mark": MARK},
        "created_at": 1795348800,
    },
    "anthropic": {
        "id": "b1",
        "processing_status": "ended",
        "request_counts": {"succeeded": 1, "errored": 1, "processing": 0},
        "results_url": "http://127.0.0.1/x",
        "created_at": NOW,
        "archived_at": None,
    },
    "gemini": {
        "name": "batches/b1",
        "done": True,
        "error": {"code": 13, "message": "m", "details": []},
        "response": {"responsesFile": "files/f1"},
        "metadata": {
            "state": "BATCH_STATE_FAILED",
            "displayName": MARK,
            "createTime": NOW,
            "batchStats": {"requestCount": "2", "successfulRequestCount": "1"},
            "output": {"responsesFile": "files/f1"},
        },
    },
}
PATHS = {
    "openai-chat": ("/v1/batches", "/v1/batches/b1", "/v1/files/f1/content", "data"),
    "anthropic": (
        "/v1/messages/batches",
        "/v1/messages/batches/b1",
        "/v1/messages/batches/b1/results",
        "data",
    ),
    "gemini": ("/v1beta/batches", "/v1beta/batches/b1", "/v1beta/files/f1:download", "operations"),
}
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


def places(value, at=()):
    """The path of every value within a value."""
    inner = value.items() if isinstance(value, dict) else enumerate(value)
    for key, each in inner:
        yield (*at, key)
        if isinstance(each, dict | list):
            yield from places(each, (*at, key))


def replaced(value, place, by):
    value = copy.deepcopy(value)
    *above, last = place
    inner = value
    for key in above:
        inner = inner[key]
    inner[last] = by
    return value


async def uses(service):
    """Everything that reads what a server says; results are judged like any reply."""

    async def results():
        return [
            judge(raw, FORMATS["gemini"])
            async for _, raw in service.results((await service.status("b1")).paths or [])
            if raw
        ]

    finds = [lambda: service.find(MARK)] if service.takes_mark else []
    for use in (lambda: service.status("b1"), results, *finds):
        try:
            await use()
        except BatchFailed as exc:
            assert str(exc)  # noqa: PT017 # it may come or not


@pytest.mark.parametrize("form", LINES)
@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
async def test_no_value_of_a_wrong_type_is_a_traceback(server, service_at, form, data):
    batches, batch, results, member = PATHS[form]
    page = {member: [BATCHES[form]], "has_more": False, "last_id": "b1", "nextPageToken": ""}
    told = {"page": page, "batch": BATCHES[form], "lines": LINES[form]}
    place = data.draw(st.sampled_from(sorted(places(told), key=str)))
    told = replaced(told, place, data.draw(values))

    def reply(value):
        return (200, json.dumps(value).encode())

    lines = told["lines"] if isinstance(told["lines"], list) else [told["lines"]]
    server.replies[f"GET {batches}"] = reply(told["page"])
    server.replies[f"GET {batch}"] = reply(told["batch"])
    server.replies[f"GET {results}"] = (200, b"\n".join(reply(line)[1] for line in lines))
    await uses(service_at(server.url, form))
