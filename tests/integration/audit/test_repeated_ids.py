"""Two replies with one id are an answer given twice only where ids are known to be unique."""

from __future__ import annotations

import itertools
import json

import pytest
from aiohttp import web

from tests.support.harness import watched

PLAN = f"M\n\nI keep my speed.\n\n{[0] * 20}"
pytestmark = pytest.mark.slow


async def test_equal_answers_under_one_id_of_a_local_server_are_a_note(merge_runner):
    numbers = itertools.count()

    async def terse(request, handler):
        """Say the same each time, under an id of a few that return."""
        reply = await handler(request)
        if request.method == "GET":
            return reply
        body = json.loads(reply.body)
        body |= {"id": f"chatcmpl-{next(numbers) % 7}", "object": "chat.completion"}
        body["choices"][0]["message"] = {"role": "assistant", "content": PLAN}
        return web.json_response(body)

    async with watched(terse, honest=False) as server:
        run = await merge_runner(
            "sweep", "baseline", "--model", "local", "--reps", 1, "--json",
            LOCAL_BASE_URL=f"{server.url}/v1",
        )  # fmt: skip
    audit = run.summary["audit"]
    if audit["counts"]["calls"] < 50 or run.summary["trials"]["failed"]:
        pytest.fail(run.err)
    assert audit["findings"] == []
    assert run.code == 0
    assert any(" id " in note or " ids " in note for note in audit["notes"])
