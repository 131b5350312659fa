"""An emulator that plays what providers are known to send, of tests/cases/scenarios.toml."""

import asyncio
import json
import tomllib
from contextvars import ContextVar
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta

from aiohttp import web

from merge_runner.chance import draw
from merge_runner.llm.formats import FORMATS
from merge_runner.records import SCRIPTED_FIELD
from tests.support.harness import PROJECT, on_loopback
from tests.support.mock_server import FaultPlan, application

ENDINGS = {
    "/chat/completions": "openai-chat",
    "/responses": "openai-responses",
    ":generateContent": "gemini",
    "/messages": "anthropic",
}
OPENAI, GEMINI = ("openai-chat", "openai-responses"), "gemini"
MODELS = dict.fromkeys(OPENAI, "o3-2025-04-16")
MODELS |= {GEMINI: "gemini-2.5-pro", "anthropic": "claude-sonnet-4-6"}


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A reply, and what the client makes of it: see scenarios.toml."""

    name: str
    formats: list[str]
    status: int = 200
    headers: dict[str, str | int] = field(default_factory=dict)
    body: str = ""
    answer: str = "{}"
    after_s: float = 0.0
    breaks: str = ""
    outcome: str
    says: str = ""
    attempts: int = 1
    error: str = ""
    wait_s: float = 0.0
    takes_s: float = 0.0

    def reply(self, usual: dict, wire: str) -> web.Response:
        """The reply, which may be made of the ordinary answer."""
        now = datetime.now(UTC)
        headers = {
            name: f"{now + timedelta(seconds=told):%Y-%m-%dT%H:%M:%SZ}"
            if type(told) is int
            else told
            for name, told in self.headers.items()
        }
        try:
            body = json.loads(self.body or self.answer)
        except ValueError:
            return web.Response(status=self.status, headers=headers, text=self.body)
        if not self.body:
            text = json.dumps(FORMATS[wire].read(usual).text)
            changed = json.loads(self.answer.replace('"ANSWER"', text))
            body = {k: v for k, v in (usual | changed).items() if v is not None or k not in changed}
        for part in body if isinstance(body, list) else [body]:
            part[SCRIPTED_FIELD] = True
        return web.json_response(body, status=self.status, headers=headers)


CASES = {
    kind: [Scenario(**told) for told in cases]
    for kind, cases in tomllib.loads((PROJECT / "tests/cases/scenarios.toml").read_text()).items()
}
SCENARIOS: dict[str, dict[str, Scenario]] = {}
for _case in (case for cases in CASES.values() for case in cases):
    SCENARIOS.setdefault(_case.name, {}).update(dict.fromkeys(_case.formats, _case))
# Of the request that is being answered: its format, and what is played to it.
FORMAT: ContextVar[str] = ContextVar("format")
PLAYED: ContextVar[Scenario | None] = ContextVar("played")


@dataclass(frozen=True, kw_only=True)
class ScenarioPlan(FaultPlan):
    """Plays a scenario with a probability, or on the first attempt alone.

    It is played in the formats that it concerns; requests in others get their ordinary answer.
    """

    scenario: str
    rate: float = 1.0
    first_alone: bool = False

    def fault(self, where, attempt):
        """How the connection breaks, where the scenario says so."""
        played = draw("scenario", self.seed, where, attempt) < self.rate
        if not played or (self.first_alone and attempt > 1):
            return None
        scenario = SCENARIOS[self.scenario].get(FORMAT.get())
        PLAYED.set(scenario)
        return scenario.breaks or None if scenario else None


@web.middleware
async def _play(request, handler):
    """Put the scenario in the place of the ordinary answer."""
    wire = next(name for ending, name in ENDINGS.items() if request.path.endswith(ending))
    FORMAT.set(wire)
    PLAYED.set(None)
    usual = await handler(request)
    scenario = PLAYED.get()
    if scenario is None or scenario.breaks:
        return usual
    await asyncio.sleep(scenario.after_s)
    return scenario.reply(json.loads(usual.body), wire)


def playing(plan, *middlewares):
    """Serve an emulator that plays a plan; yields its URL."""
    app = application(plan)
    app.middlewares.extend((*middlewares, _play))
    return on_loopback(app)
