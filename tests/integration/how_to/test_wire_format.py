"""A wire format that a package adds, and a provider with it, as docs/how-to says."""

from __future__ import annotations

from contextlib import asynccontextmanager
from dataclasses import dataclass, field

import duckdb
import pytest
from aiohttp import web

from merge_runner.emulator.driver import answer
from merge_runner.emulator.server import HOST
from tests.support.harness import Run, how_to, plugin

MODELS = """
[talker-1]
provider = "talker"
format = "say"
id = "talker-1"
parameters = { temperature = 0.7 }
max_output_tokens = 2000
price = { input = 1.0, output = 4.0, source = "contract" }
"""
KEY = "a-key-of-nobody"
ANSWERS = """
SELECT outcome, finish_reason, model_served, input_tokens, output_tokens, cost_usd > 0, count(*) > 1
FROM calls WHERE http_status = 200 GROUP BY ALL
"""


@dataclass
class Talker:
    """A service of the format; what it was asked, and how its first and all other replies are."""

    bodies: list[dict] = field(default_factory=list)
    first: tuple[int, dict] | None = None
    always: tuple[int, dict] | None = None

    async def say(self, request: web.Request) -> web.Response:
        if request.headers.get("x-talker-key") != KEY:
            return web.json_response({"error": {"message": "who are you?"}}, status=401)
        body = await request.json()
        self.bodies.append(body)
        instead = self.always or (self.first if len(self.bodies) == 1 else None)
        if instead:
            return web.json_response(instead[1], status=instead[0])
        return web.json_response(
            {
                "id": "always-the-same",
                "said": answer(body["ask"], None),
                "ended": "done",
                "engine": body["engine"],
                "tokens_in": 300,
                "tokens_out": 100,
            }
        )


@asynccontextmanager
async def listening(talker):
    """The service on loopback; yields its URL."""
    app = web.Application()
    app.add_routes([web.post("/say", talker.say)])
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.1)
    await runner.setup()
    await web.TCPSite(runner, HOST, 0).start()
    yield f"http://{HOST}:{runner.addresses[0][1]}"
    await runner.cleanup()


@pytest.fixture
def run(merge_runner, tmp_path):
    """Runs a command with the module of the page installed."""
    installed = plugin(tmp_path / "installed", how_to("add-a-wire-format"))
    (tmp_path / "experiments").mkdir()
    (tmp_path / "experiments/models.toml").write_text(MODELS)
    (tmp_path / "experiments/short.toml").write_text("[repetitions]\nbaseline = 1\n")

    async def run(*arguments, **changes):
        process = await merge_runner.start(*arguments, cwd=tmp_path, **installed, **changes)
        out, err = await process.communicate()
        return Run(process.returncode, out.decode(), err.decode())

    return run


def sweep(*options):
    return ("sweep", "short", "--model", "talker-1", "--conditions", "N_0_0", "--json", "--yes",
            *options)  # fmt: skip


@pytest.mark.long
async def test_a_format_from_outside_goes_through_the_whole_house(run, tmp_path):
    busy = {"error": {"code": "busy", "message": "Busy.", "details": {"wait_ms": 900}}}
    talker = Talker(first=(503, busy))
    async with listening(talker) as url:
        played = await run(*sweep("--max-cost", 1), TALKER_BASE_URL=url, TALKER_API_KEY=KEY)
    assert played.code == 0, played.err
    assert played.summary["audit"]["findings"] == []
    body = talker.bodies[0]
    assert (body["engine"], body["at_most"]) == ("talker-1", 2000)
    assert body["options"] == {"temperature": 0.7}
    with duckdb.connect(str(tmp_path / "results/merge.duckdb"), read_only=True) as connection:
        assert connection.execute(ANSWERS).fetchall() == [
            ("ok", "done", "talker-1", 300, 100, True, True)
        ]
        assert connection.execute("SELECT bool_and(valid) FROM decisions").fetchone() == (True,)
        assert connection.execute(
            "SELECT outcome, http_status, error FROM calls WHERE http_status <> 200"
        ).fetchall() == [("overloaded", 503, "HTTP 503: Busy.")]
        assert connection.execute(
            "SELECT max(started_at) - min(started_at) >= INTERVAL 0.9 SECONDS FROM calls "
            "WHERE decision = 0"
        ).fetchone() == (True,)

    assert (await run("audit")).code == 0
    for command in (("tables", "attempts"), ("report", "--out", "report.html")):
        done = await run(*command, TALKER_BASE_URL=url)
        assert done.code == 0, f"{command}\n{done.err}"
    sent = "at_most = 2000, engine = talker-1, temperature = 0.7<"
    assert sent in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize(
    ("status", "body", "code", "says"),
    [
        (400, {"error": {"code": "account_empty", "message": "m"}}, 3, "quota is exhausted"),
        (200, {"choices": [{"message": {"content": "M"}}]}, 2, "does not speak say"),
        (200, {"error": {"code": 400, "message": "no such option"}}, 2, "no such option"),
    ],
)
async def test_what_its_errors_mean_stands_in_its_own_file(run, status, body, code, says):
    async with listening(Talker(always=(status, body))) as url:
        stopped = await run(*sweep(), TALKER_BASE_URL=url, TALKER_API_KEY=KEY)
    assert stopped.code == code
    assert says in stopped.err
    assert "Traceback" not in stopped.err


async def test_a_key_goes_into_the_providers_own_header_and_nowhere_else(run, tmp_path):
    talker = Talker()
    async with listening(talker) as url:
        refused = await run(*sweep(), TALKER_BASE_URL=url, TALKER_API_KEY="another")
        assert (refused.code, talker.bodies) == (2, [])
        assert "set TALKER_API_KEY to a valid one" in refused.err
    missing = await run(*sweep())
    assert missing.code == 2
    assert "set TALKER_API_KEY" in missing.err
    (tmp_path / "experiments/models.toml").write_text(MODELS.replace('"say"', '"tell"'))
    unknown = await run("models")
    assert unknown.code == 2
    assert "unknown wire format 'tell'; valid: openai-chat" in unknown.err
    assert "anthropic, say" in unknown.err
