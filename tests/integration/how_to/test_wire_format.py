"""A wire format that a study adds, and a provider with it, as docs/extend.md says."""

from contextlib import asynccontextmanager
from dataclasses import dataclass, field

import pytest
from aiohttp import web

from merge_runner.emulator.driver import answer
from merge_runner.results.store import query
from tests.support.harness import how_to, listening

MODELS = """
[talker-1]
provider = "talker"
format = "say"
id = "talker-1"
parameters = { temperature = 0.7 }
max_output_tokens = 2000
price = { input = 1.0, output = 4.0, source = "contract" }
"""
STUDY = """
models = ["talker-1"]
repetitions = 1
conditions = ["N_0_0"]
[plugins]
files = ["say.py"]
"""
KEY = "a-key-of-nobody"
SWEEP = ("sweep", "study.toml", "--trust", "--json", "--yes")


@dataclass
class Talker:
    """A service of the format; what it was asked, and how its first and all other replies are."""

    bodies: list[dict] = field(default_factory=list)
    first: tuple[int, dict] | None = None
    always: tuple[int, dict] | None = None

    async def say(self, request: web.Request) -> web.Response:
        if (request.path, request.headers.get("x-talker-key")) != ("/say", KEY):
            return web.json_response({"error": {"message": "who are you?"}}, status=401)
        body = await request.json()
        self.bodies.append(body)
        instead = self.always or (self.first if len(self.bodies) == 1 else None)
        if instead:
            return web.json_response(instead[1], status=instead[0])
        said = {"said": answer(body["ask"], None), "ended": "done", "engine": body["engine"]}
        return web.json_response({"id": "same", **said, "tokens_in": 300, "tokens_out": 100})


@asynccontextmanager
async def asked(talker):
    """The service on loopback; yields what to set in the environment."""
    async with listening(talker.say) as url:
        yield {"TALKER_BASE_URL": url, "TALKER_API_KEY": KEY}


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "models.toml").write_text(MODELS)
    (tmp_path / "study.toml").write_text(STUDY)
    (tmp_path / "say.py").write_text(how_to("Wire format"))
    return tmp_path


async def test_a_format_from_outside_is_sent_waited_for_read_and_paid(merge_runner, folder):
    busy = {"error": {"code": "busy", "message": "Busy.", "details": {"wait_ms": 900}}}
    talker = Talker(first=(503, busy))
    async with asked(talker) as there:
        played = await merge_runner(*SWEEP, "--max-cost", 1, **there)
    assert played.code == 0, played.err
    assert played.summary["audit"]["findings"] == []
    body = talker.bodies[0]
    assert (body["engine"], body["at_most"]) == ("talker-1", 2000)
    assert body["options"] == {"temperature": 0.7}

    def rows(sql):
        return query(folder / "results/merge.duckdb", sql)[1]

    ok = "outcome, finish_reason, model_served, input_tokens, output_tokens, cost_usd > 0"
    assert rows(f"SELECT DISTINCT {ok} FROM calls WHERE http_status = 200") == [
        ("ok", "done", "talker-1", 300, 100, True)
    ]
    assert rows("SELECT outcome, error FROM calls WHERE http_status <> 200") == [
        ("overloaded", "HTTP 503: Busy.")
    ]
    waited = "max(started_at) - min(started_at) >= INTERVAL 0.9 SECONDS"
    assert rows(f"SELECT {waited} FROM calls WHERE decision = 0") == [(True,)]
    assert rows("SELECT bool_and(valid) FROM decisions") == [(True,)]


@pytest.mark.parametrize(
    ("status", "body", "code", "says"),
    [
        (400, {"error": {"code": "account_empty", "message": "m"}}, 3, "quota is exhausted"),
        (200, {"choices": [{"message": {"content": "M"}}]}, 2, "does not speak say"),
        (200, {"error": {"code": 400, "message": "no such option"}}, 2, "no such option"),
    ],
)
async def test_what_its_errors_mean_stands_in_its_own_file(
    merge_runner, folder, status, body, code, says
):
    async with asked(Talker(always=(status, body))) as there:
        stopped = await merge_runner(*SWEEP, **there)
    assert stopped.code == code
    assert says in stopped.err
    assert "Traceback" not in stopped.err


async def test_a_key_goes_into_the_providers_own_header_and_nowhere_else(merge_runner, folder):
    talker = Talker()
    async with asked(talker) as there:
        refused = await merge_runner(*SWEEP, **{**there, "TALKER_API_KEY": "another"})
    assert (refused.code, talker.bodies) == (2, [])
    assert "set TALKER_API_KEY to a valid one" in refused.err
    missing = await merge_runner(*SWEEP, code=2)
    assert "set TALKER_API_KEY" in missing.err
    (folder / "models.toml").write_text(MODELS.replace('"say"', '"tell"'))
    unknown = await merge_runner(*SWEEP, code=2)
    assert "unknown wire format 'tell'; valid: openai-chat" in unknown.err
    assert "anthropic, say" in unknown.err
