"""The program as a user runs it, and a server that tests can watch."""

import argparse
import json
import os
import re
import sys
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

from aiohttp import web

from merge_runner.emulator.server import HOST
from merge_runner.records import SCRIPTED_FIELD, SLOT_HEADER
from merge_runner.registry import GROUP
from merge_runner.run.options import Options
from merge_runner.run.plan import Plan
from merge_runner.run.session import open_session
from merge_runner.run.sweep import run
from tests.support.mock_server import application

PROJECT = Path(__file__).parents[2]
PROGRAM = Path(sys.executable).with_name("merge-runner")
RECORDING = PROJECT / "cache/recordings/emulator-baseline.parquet"
# Variables that would change what a run does.
CONFIGURING = ("_API_KEY", "_BASE_URL", "_PROXY", "_proxy", "LOCAL_MODEL")
# No account's limits, which would make a sweep take minutes.
FAST = ("--rpm", 10**6, "--tpm", 10**9)
Middle = Callable[[web.Request, Callable[[web.Request], Awaitable[web.StreamResponse]]], Awaitable]


@dataclass
class Run:
    """What a command did."""

    code: int
    out: str
    err: str

    @property
    def summary(self) -> dict:
        return json.loads(self.out)

    def ending_with(self, code: int | None) -> "Run":
        """Itself, if it has this exit code, or none is asked for."""
        assert code is None or self.code == code, f"exit code {self.code}: {self.out}{self.err}"
        return self


def how_to(part: str) -> str:
    """The code of a section of docs/extend.md."""
    _, _, rest = (PROJECT / "docs/extend.md").read_text().partition(f"\n## {part}\n")
    (code,) = re.findall(r"```python\n(.*?)```", rest.partition("\n## ")[0], re.S)
    return code


def plugin(folder: Path, source: str, module: str = "dummies") -> dict[str, str]:
    """Variables under which a package with this source is installed, its entry point named."""
    described = folder / f"{module}-1.0.dist-info"
    described.mkdir(parents=True)
    (folder / f"{module}.py").write_text(source)
    (described / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    (described / "entry_points.txt").write_text(f"[{GROUP}]\n{module} = {module}\n")
    return {"PYTHONPATH": os.pathsep.join(map(str, (folder, PROJECT)))}


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def a_model(name: str = "emulator", **fields: object) -> str:
    """The emulator's entry of models.toml with these fields."""

    def toml(value: object) -> str:
        if not isinstance(value, dict):
            return json.dumps(value)
        return f"{{ {', '.join(f'{key} = {toml(each)}' for key, each in value.items())} }}"

    named = {"provider": "emulator", "format": "openai-chat", "id": "scripted-driver"}
    told = {**named, "max_output_tokens": 4000, "price": "free", **fields}
    return "\n".join([f"[{name}]", *(f"{key} = {toml(value)}" for key, value in told.items()), ""])


def asked_to_write(arguments: Sequence[str], what: str) -> None:
    """Leave the program unless it is told to ``--write``, for which it says what that would do."""
    parser = argparse.ArgumentParser(allow_abbrev=False)
    parser.add_argument("--write", action="store_true", required=True, help=f"write {what}")
    parser.parse_args(arguments)


def environment(**changes: str) -> dict[str, str]:
    """The environment without keys, base URLs and proxies, and as if no make ran the tests."""
    kept = {k: v for k, v in os.environ.items() if not k.endswith(CONFIGURING)}
    for name in ("MAKELEVEL", "MAKEFLAGS", "MFLAGS"):
        kept.pop(name, None)
    # Compiled modules are kept, or each of the many starts would compile them anew.
    kept.pop("PYTHONDONTWRITEBYTECODE", None)
    return {**kept, **changes}


async def run_sweep(plan: Plan, options: Options, *, say: Callable[[str], None]) -> dict:
    """Play a plan in this process."""
    async with open_session(plan, options, say=say) as session:
        return await run(session)


def each(usd: float) -> Callable[[int], float]:
    """Trials of which each is expected to cost so much."""
    return lambda _: usd


@dataclass
class Watched:
    """An emulator in the test's own process: who asked what, and how often."""

    url: str = ""
    asked: Counter[str] = field(default_factory=Counter)
    headers: list[dict[str, str]] = field(default_factory=list)
    paths: list[str] = field(default_factory=list)

    @property
    def requests(self) -> int:
        return self.asked.total()

    @property
    def env(self) -> dict[str, str]:
        """With which the program asks it for the emulator."""
        return {"EMULATOR_BASE_URL": f"{self.url}/v1"}

    @property
    def account(self) -> dict[str, str]:
        """With which the program asks it for any provider's model, too."""
        keys = {f"{name}_API_KEY": "a-dummy-key" for name in ("OPENAI", "ANTHROPIC", "GEMINI")}
        urls = dict.fromkeys(("ANTHROPIC_BASE_URL", "GOOGLE_GEMINI_BASE_URL"), self.url)
        return keys | urls | self.env | {"OPENAI_BASE_URL": f"{self.url}/v1"}


@asynccontextmanager
async def on_loopback(app: web.Application):
    """Serve an application on a free port of loopback; yields the URL."""
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.1)
    await runner.setup()
    await web.TCPSite(runner, HOST, 0).start()
    try:
        yield f"http://{HOST}:{runner.addresses[0][1]}"
    finally:
        await runner.cleanup()


def listening(handle: Callable[[web.Request], Awaitable[web.StreamResponse]]):
    """Serve one handler for all methods and paths."""
    app = web.Application(client_max_size=2**26)
    app.router.add_route("*", "/{path:.*}", handle)
    return on_loopback(app)


async def as_a_model(request: web.Request, handler) -> web.StreamResponse:
    """Answer without the field that says that a mock model does."""
    body = json.loads((await handler(request)).body)
    del body[SCRIPTED_FIELD]
    return web.json_response(body)


@asynccontextmanager
async def watched(middle: Middle | None = None, faults=None, *, honest: bool = True):
    """Serve the emulator on loopback; ``middle`` may answer in its place.

    Unless it is ``honest``, no header says that a mock model answers.
    """
    seen = Watched()

    @web.middleware
    async def watch(request, handler):
        seen.paths.append(request.path)
        # Of batches, only their handlers know how large a body may be.
        is_batch = "batch" in request.path or "/files" in request.path
        body = "" if is_batch else await request.text()
        seen.asked[request.headers.get(SLOT_HEADER, "") + body] += 1
        seen.headers.append({name.lower(): value for name, value in request.headers.items()})
        return await (middle(request, handler) if middle else handler(request))

    app = application(faults)
    app.middlewares.append(watch)
    if not honest:
        app.on_response_prepare.clear()
    async with on_loopback(app) as seen.url:
        yield seen
