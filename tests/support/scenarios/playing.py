"""An emulator that plays scenarios in place of its ordinary answers."""

from __future__ import annotations

import asyncio
import json
from contextlib import asynccontextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from aiohttp import web

from merge_runner.chance import draw
from merge_runner.emulator.server import HOST
from merge_runner.records import SCRIPTED_FIELD
from tests.support.mock_server import FaultPlan, application
from tests.support.scenarios import SCENARIOS
from tests.support.scenarios.base import Scene

# Of the request that is being answered: its format, and what is played to it.
FORMAT: ContextVar[str] = ContextVar("format")
SCENE: ContextVar[Scene | None] = ContextVar("scene")
ENDINGS = {
    "/chat/completions": "openai-chat",
    "/responses": "openai-responses",
    ":generateContent": "gemini",
    "/messages": "anthropic",
}


@dataclass(frozen=True, kw_only=True)
class ScenarioPlan(FaultPlan):
    """Plays a scenario with a probability, or on the first attempt alone.

    It is played in the formats that it concerns; requests in others get their ordinary answer.
    """

    scenario: str
    rate: float = 1.0
    first_alone: bool = False

    def fault(self, where, attempt):
        """How the connection breaks, where the scene says so."""
        played = draw("scenario", self.seed, where, attempt) < self.rate
        if not played or (self.first_alone and attempt > 1):
            return None
        scene = SCENARIOS[self.scenario].get(FORMAT.get())
        SCENE.set(scene)
        return scene.breaks if scene else None


@web.middleware
async def play(request, handler):
    """Put the scene in the place of the ordinary answer, of which it may be made."""
    FORMAT.set(next(name for ending, name in ENDINGS.items() if request.path.endswith(ending)))
    SCENE.set(None)
    usual = await handler(request)
    scene = SCENE.get()
    if scene is None or scene.breaks:
        return usual
    await asyncio.sleep(scene.after_s)
    members = json.loads(usual.body)
    del members[SCRIPTED_FIELD]
    body, headers = scene.body(members), _told_now(scene)
    if isinstance(body, str):
        return web.Response(status=scene.status, headers=headers, text=body)
    return web.Response(
        body=_marked(body), status=scene.status, headers=headers, content_type="application/json"
    )


def _marked(body):
    """JSON, which may be a list of objects, with the field that says that no model made it."""
    marked = [
        {**part, SCRIPTED_FIELD: True} for part in (body if isinstance(body, list) else [body])
    ]
    return json.dumps(marked if isinstance(body, list) else marked[0], ensure_ascii=False).encode()


def _told_now(scene):
    now = datetime.now(UTC)
    return {
        name: f"{now + told:%Y-%m-%dT%H:%M:%SZ}" if isinstance(told, timedelta) else told
        for name, told in scene.headers.items()
    }


@asynccontextmanager
async def playing(plan, *middlewares):
    """Serve an emulator on loopback that plays a plan; yields its URL."""
    app = application(plan)
    app.middlewares.extend((*middlewares, play))
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.01)
    await runner.setup()
    await web.TCPSite(runner, HOST, 0).start()
    try:
        yield f"http://{HOST}:{runner.addresses[0][1]}"
    finally:
        await runner.cleanup()
