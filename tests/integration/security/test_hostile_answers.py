"""What a model or a server writes is stored as it is, and speaks to no terminal."""

import io
import json

from aiohttp import web
from rich.console import Console

from merge_runner.llm.attempts import Meter
from merge_runner.llm.call import Wait
from merge_runner.run.progress import terminal_text
from tests.support.harness import watched
from tests.support.snapshots import progress, runner

ESCAPE = "\x1b]0;owned\x07\x1b[2J\u202e"
ONE = ("sweep", "baseline", "--reps", 1, "--conditions", "L_4_0")


async def test_strange_characters_and_counts_are_stored_and_shown_harmlessly(merge_runner):
    async def middle(request, handler):
        body = json.loads((await handler(request)).body)
        body["usage"] |= {"prompt_tokens": 10**30, "completion_tokens": -5}
        body["model"] = "scripted-driver"
        body["choices"][0]["message"]["content"] = f"M {ESCAPE} {chr(0xD800)} no plan"
        body["choices"][0]["finish_reason"] = f"stop{chr(0xDFFF)}"
        return web.Response(text=json.dumps(body), content_type="application/json")

    async with watched(middle) as server:
        run = await merge_runner(*ONE, "--keep-going", EMULATOR_BASE_URL=f"{server.url}/v1")
    assert run.code == 0, run.err
    told = await merge_runner(
        "sql",
        "select count(*), count(input_tokens), count(reply), any_value(rationale) from calls "
        "join decisions using (trial_id, spec_hash, side, decision)",
    )
    assert "\x1b" not in told.out
    assert "\u202e" not in told.out
    assert told.out.splitlines()[1].split()[:3] == [str(server.requests), "0", str(server.requests)]


async def test_an_error_in_a_servers_words_speaks_to_no_terminal(merge_runner):
    async def middle(request, handler):
        if server.requests == answered_first:
            return await handler(request)
        error = {"error": {"message": f"no {ESCAPE} [/red] [link=x]", "code": "bad"}}
        return web.json_response(error, status=400)

    async with watched(middle) as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        answered_first = 0
        ended = await merge_runner(*ONE, **env)
        answered_first = server.requests + 1
        run = await merge_runner(*ONE, **env)
    assert (ended.code, run.code) == (2, 1)
    assert "\x1b" not in ended.out + ended.err + run.out + run.err
    assert "[/red] [link=x]" in ended.err
    assert "[/red] [link=x]" in run.out


def test_a_servers_words_are_no_markup_in_the_display():
    wait = Wait(f"after HTTP 503: [/nope] {ESCAPE}")
    shown = io.StringIO()
    waiting = progress(runner(Meter(), running_trials=1, waits=[wait]))
    Console(file=shown, width=200).print(terminal_text(waiting))
    assert "[/nope]" in shown.getvalue()
    assert "\x1b" not in shown.getvalue()
