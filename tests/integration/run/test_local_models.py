"""A server of one's own: what it serves, and what is said where nobody listens."""

import json
import re

import pytest
from aiohttp import web

from merge_runner.errors import UsageError
from merge_runner.llm.models import load_models
from merge_runner.results.store import query
from tests.support.harness import watched

ONE = ("sweep", "baseline", "--reps", 1, "--conditions", "N_0_0", "--json")
LOCAL = (*ONE, "--model", "local")
NAMED = (*ONE, "--model", "named")
REGISTRY = """
[local]
provider = "local"
format = "openai-chat"
max_output_tokens = 4000
price = "free"

[named]
provider = "local"
format = "openai-chat"
id = "qwen3"
max_output_tokens = 4000
deadline_s = 1
price = "free"
"""
# Nothing listens at this port, which is one of the system's.
DEAD = "http://127.0.0.1:9/v1"


def serving(*names, status=200):
    """A middleware: the server lists these models."""
    body = {"object": "list", "data": [{"id": name, "object": "model"} for name in names]}

    async def middle(request, handler):
        if request.path == "/v1/models":
            return web.json_response(body, status=status)
        return await handler(request)

    return middle


async def test_a_server_s_one_model_is_asked_of_several_one_must_be_chosen_and_a_replay_finds_both(
    merge_runner, tmp_path, monkeypatch
):
    monkeypatch.setattr("merge_runner.run.served_names.LONG_WAIT_S", 0)
    async with watched(serving("qwen3-8b")) as server:
        told = await merge_runner(*LOCAL, "--dry-run", LOCAL_BASE_URL=f"{server.url}/v1")
        assert (told.summary["trials"], server.requests) == (1, 0)
        run = await merge_runner(*LOCAL, LOCAL_BASE_URL=f"{server.url}/v1", code=0)
        lists = " has not listed its models yet: .* serves qwen3-8b, which is asked\n"
        assert re.search(lists, run.err, re.DOTALL)
        assert {json.loads(body)["model"] for body in server.asked if body} == {"qwen3-8b"}
    one = await merge_runner("digest")
    assert (await merge_runner("recording", "export", "local.parquet")).code == 0
    async with watched(serving("qwen3-8b", "llama3.2:latest")) as server:
        at = {"LOCAL_BASE_URL": f"{server.url}/v1"}
        unnamed = await merge_runner(*LOCAL, code=2, **at)
        assert "serves qwen3-8b, llama3.2:latest: name one with LOCAL_MODEL, or" in unnamed.err
        assert not any(server.asked), "no prompt was sent"
        # Ollama knows a model by its name without the usual tag, too.
        await merge_runner(*LOCAL, "--db", "llama", code=0, **at, LOCAL_MODEL="llama3.2")
    asked = query(tmp_path / "llama", "SELECT DISTINCT model_requested FROM calls")[1]
    assert asked == [("llama3.2",)]
    replay = ("replay", *LOCAL[1:], "--db")
    recorded = ("recorded.duckdb", "--recording", "local.parquet", "--cache", "empty")
    assert (await merge_runner(*replay, "cached.duckdb")).code == 4
    assert (await merge_runner(*replay, "cached.duckdb", LOCAL_MODEL="qwen3-8b")).code == 0
    assert (await merge_runner(*replay, *recorded)).code == 0
    for db in ("cached.duckdb", "recorded.duckdb"):
        assert (await merge_runner("digest", "--db", db)).out == one.out


async def test_where_nobody_answers_the_run_ends_within_seconds_with_what_to_start(merge_runner):
    for url, said in (
        (DEAD, f"nothing listens at {DEAD}: start a server (docs/models.md#local-models)"),
        ("http://gpu.invalid:8000/v1", "http://gpu.invalid:8000/v1 cannot be reached ("),
    ):
        run = await merge_runner(*LOCAL, LOCAL_BASE_URL=url)
        (line,) = run.err.splitlines()
        told = [each in line for each in (said, "start a server", "or set LOCAL_BASE_URL")]
        assert (run.code, all(told)) == (1, True), line


async def test_no_trial_has_failed_where_nothing_was_ever_answered(merge_runner, tmp_path):
    (tmp_path / "experiments").mkdir()
    (tmp_path / "experiments/models.toml").write_text(REGISTRY)
    (tmp_path / "experiments/baseline.toml").write_text("[repetitions]\nbaseline = 1\n")
    run = await merge_runner(*NAMED, LOCAL_BASE_URL=DEAD)
    assert (run.code, run.err.count(f"nothing listens at {DEAD}")) == (1, 1)
    assert run.summary["trials"]["failed"] == 0
    async with watched(serving(status=404)) as server:
        at = {"LOCAL_BASE_URL": f"{server.url}/v1"}
        await merge_runner(*NAMED, code=0, **at)
        run = await merge_runner(*LOCAL, code=2, **at)
        assert re.search("models that it does not list .HTTP 404.*one with LOCAL_MODEL", run.err)
    stored = await merge_runner(*NAMED, **at)  # where all has been played, no server is needed
    assert (stored.code, stored.summary["trials"]["stored_before"]) == (0, 1), stored.err


def test_only_a_server_of_ones_own_can_be_asked_for_a_name(tmp_path):
    text = REGISTRY.replace('id = "qwen3"\n', "")
    (tmp_path / "models.toml").write_text(text)
    assert load_models(tmp_path)["named"].id == "default"
    (tmp_path / "models.toml").write_text(text.replace('"local"', '"openai"'))
    with pytest.raises(UsageError, match="`id` is missing"):
        load_models(tmp_path)
