"""Results that a provider shows oddly: every answer of a batch is taken, none is asked again."""

from __future__ import annotations

import json
import re

import pytest
from aiohttp import web

from merge_runner.emulator.faults import BatchPlan, FaultPlan
from tests.harness import watched

FORMATS = {"openai": "openai-chat", "anthropic": "anthropic", "gemini": "gemini"}
REGISTRY = """
[model]
provider = "{provider}"
format = "{format}"
id = "some-model"
max_output_tokens = 4000
price = {{ input = 2.0, output = 8.0, source = "made up" }}
batch = {{ price_factor = 0.5, source = "made up" }}
"""
# One decision of two drivers in 11 conditions: one batch.
STUDY = "[repetitions]\nbaseline = 1\n[scenario]\ntimeout_s = 1\n"
LINES = 22
PLAN = FaultPlan(batch=BatchPlan(delay_s=0.3))
SINGLE = re.compile("/v1/chat/completions|/v1/messages|.*:generateContent")
RESULTS = re.compile(".*(-output/content|/results|:download)")
pytestmark = pytest.mark.slow


@pytest.fixture(params=FORMATS)
def provider(request, tmp_path):
    """A provider of batches; the folder of the test has a study and a model of it."""
    registry = REGISTRY.format(provider=request.param, format=FORMATS[request.param])
    (tmp_path / "models.toml").write_text(registry)
    (tmp_path / "study.toml").write_text(STUDY)
    return request.param


@pytest.fixture
def play(merge_runner, provider):
    """Plays a sweep in batches whose replies pass through a middleware.

    Returns the run, and how many calls it made singly.
    """

    async def run(middle):
        async with watched(middle, PLAN) as server:
            keys = dict.fromkeys(
                ("OPENAI_API_KEY", "ANTHROPIC_API_KEY", "GEMINI_API_KEY"), "a-dummy-key"
            )
            run = await merge_runner(
                "sweep", "study.toml", "--model", "model", "--batch", "--yes",
                **keys,
                OPENAI_BASE_URL=f"{server.url}/v1",
                ANTHROPIC_BASE_URL=server.url,
                GOOGLE_GEMINI_BASE_URL=server.url,
            )  # fmt: skip
        if run.code:
            pytest.fail(run.err)  # which no test expects
        return run, sum(bool(SINGLE.fullmatch(path)) for path in server.paths)

    return run


def with_results(change):
    """A middleware that changes the lines of results."""

    async def middle(request, handler):
        reply = await handler(request)
        if RESULTS.fullmatch(request.path) and reply.status == 200:
            reply.body = b"".join(change(reply.body.splitlines(keepends=True)))
        return reply

    return middle


async def test_results_in_any_order_need_no_single_call(play):
    assert (await play(with_results(lambda lines: lines[::-1])))[1] == 0


async def test_a_result_that_comes_twice_is_one_answer(play):
    assert (await play(with_results(lambda lines: [lines[0], *lines])))[1] == 0


async def test_results_of_another_batch_are_ignored_and_counted(play):
    def with_foreign(lines):
        foreign = [re.sub(rb'("custom_id"|"key"): "..', rb'\1: "zz', line) for line in lines]
        return [*foreign, foreign[0].replace(b'"zz', b'"yy'), *lines]

    run, single = await play(with_results(with_foreign))
    assert single == 0
    assert re.search(rf"\b{LINES + 1}\b", run.err)


async def test_a_batch_that_was_seen_to_end_has_ended(play):
    created, ended = {}, set()

    async def middle(request, handler):
        """Show the state of the creation once more after the end was shown."""
        reply = await handler(request)
        if "json" not in reply.content_type:
            return reply
        body, path = json.loads(reply.body), request.path
        batch = path.rpartition("/")[2]
        if request.method == "POST":
            created[body.get("name", body.get("id", "")).rpartition("/")[2]] = body
        elif batch in ended and batch in created:
            return web.json_response(created.pop(batch))
        elif {body.get("status"), body.get("processing_status"), body.get("done")} & {
            "completed", "ended", True
        }:  # fmt: skip
            ended.add(batch)
        return reply

    assert (await play(middle))[1] == 0
    assert ended
