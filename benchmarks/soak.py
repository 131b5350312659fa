"""A long sweep against a server full of faults, killed without a word again and again.

The server runs in this process, counts what it is asked by slot and attempt, and bills every answer
that it makes. The sweep's ledger is compared with that, and its digest with that of a quiet run.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import os
import re
import shutil
import sqlite3
import subprocess
import time
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

from aiohttp import web

from benchmarks.cases import Bench, Figures
from benchmarks.processes import PROJECT, RUNNER
from merge_runner.emulator.server import HOST
from merge_runner.records import ATTEMPT_HEADER, SLOT_HEADER, Slot, call_key
from merge_runner.results.store import results_digest
from tests.support.mock_server import TRANSIENT, FaultPlan, application

# Each equally often, 0.2 in all.
FAULTS = FaultPlan(seed=15, rates=dict.fromkeys(TRANSIENT, 0.2 / len(TRANSIENT)))
LOOK_S = 0.2
INPUT_USD, OUTPUT_USD = 2, 8  # per million tokens
MODELS = f"""
[soak]
provider = "emulator"
format = "openai-chat"
id = "scripted-driver"
max_output_tokens = 4000
timeout_s = 5
deadline_s = 300
price = {{ input = {INPUT_USD}, output = {OUTPUT_USD}, source = "made up" }}
"""
_USAGE = re.compile(r'"prompt_tokens": (\d+), "completion_tokens": (\d+)')


@dataclass
class Watch:
    """Requests at the server, and which calls had a durable reply when a run was killed."""

    asked: Counter[tuple[str, str]] = field(default_factory=Counter)
    durable: set[str] = field(default_factory=set)
    asked_again: int = 0
    billed_usd: float = 0.0

    @web.middleware
    async def middle(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        """Count a request, and bill its answer."""
        slot, body = request.headers[SLOT_HEADER], await request.text()
        key = call_key(
            endpoint="emulator",
            path="/chat/completions",
            headers={},
            body=body,
            slot=Slot(**json.loads(slot)),
        )
        self.asked[key, request.headers[ATTEMPT_HEADER]] += 1
        self.asked_again += key in self.durable
        reply = await handler(request)
        assert isinstance(reply, web.Response)
        usage = _USAGE.search(reply.text or "")
        if usage:
            tokens_in, tokens_out = map(int, usage.groups())
            self.billed_usd += (INPUT_USD * tokens_in + OUTPUT_USD * tokens_out) / 1e6
        return reply


@dataclass
class Process:
    """The most that a run had at any look: memory in MB, and open file handles."""

    peak_mb: float = 0.0
    handles: int = 0

    def look(self, pid: int) -> None:
        """Look at it, where the system shows it."""
        with contextlib.suppress(OSError):
            status = Path(f"/proc/{pid}/status").read_text()
            peak = re.search(r"VmHWM:\s+(\d+) kB", status)
            self.peak_mb = max(self.peak_mb, int(peak[1]) / 1024 if peak else 0.0)
            self.handles = max(self.handles, len(os.listdir(f"/proc/{pid}/fd")))


@asynccontextmanager
async def serving(watch: Watch, faults: FaultPlan) -> AsyncIterator[str]:
    """The emulator, watched; gives its base URL."""
    app = application(faults)
    app.middlewares.append(watch.middle)
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.1)
    await runner.setup()
    await web.TCPSite(runner, HOST, 0, backlog=4096).start()
    try:
        yield f"http://{HOST}:{runner.addresses[0][1]}/v1"
    finally:
        await runner.cleanup()


@dataclass(frozen=True)
class Sweep:
    """One sweep in a folder of its own, to be run until it ends."""

    folder: Path
    trials: int
    url: str

    @property
    def db(self) -> Path:
        """Its database."""
        return self.folder / "soak.duckdb"

    def start(self) -> subprocess.Popen[bytes]:
        """Begin it, or go on with it."""
        experiments = self.folder / "experiments"
        if not experiments.exists():
            shutil.copytree(PROJECT / "experiments", experiments)
            (experiments / "models.toml").write_text(MODELS, encoding="utf-8")
        choice = ["--model", "soak", "--conditions", "R_-4_8", "--reps", str(self.trials)]
        places = ["--db", str(self.db), "--cache", str(self.folder / "responses")]
        with (self.folder / "out").open("wb") as out, (self.folder / "err").open("ab") as err:
            return subprocess.Popen(
                [*RUNNER, "sweep", "baseline", *choice, *places, "--yes", "--json"],
                cwd=self.folder,
                env={**os.environ, "PYTHONPATH": str(PROJECT), "EMULATOR_BASE_URL": self.url},
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
            )

    def durable(self) -> set[str]:
        """The calls whose reply lies in the cache."""
        file = f"file:{self.folder}/responses/cache.db?mode=ro"
        with contextlib.closing(sqlite3.connect(file, uri=True)) as cache:
            rows = cache.execute("SELECT key FROM Cache WHERE length(key) = 64").fetchall()
        return {key for (key,) in rows}

    def summary(self) -> dict[str, float]:
        """Return the summary of its last run."""
        summary: dict[str, float] = json.loads((self.folder / "out").read_text(encoding="utf-8"))
        return summary


async def to_its_end(
    sweep: Sweep, watch: Watch, process: Process, lives_s: float = math.inf
) -> int:
    """Run a sweep again and again until it ends by itself; returns how often it was killed.

    A run lives so long from its first request on.
    """
    kills = 0
    while True:
        before, ends_s = watch.asked.total(), math.inf
        run = sweep.start()
        while run.poll() is None and time.monotonic() < ends_s:
            process.look(run.pid)
            await asyncio.sleep(LOOK_S)
            if ends_s == math.inf and watch.asked.total() > before:
                ends_s = time.monotonic() + lives_s
        run.kill()
        if await asyncio.to_thread(run.wait) == 0:
            return kills
        if run.returncode > 0:
            raise RuntimeError(f"it ended with {run.returncode}: {sweep.folder}/err says why")
        kills += 1
        watch.durable = await asyncio.to_thread(sweep.durable)


async def measure(folder: Path, trials: int, lives_s: float) -> Figures:
    """The figures of a soak: so many trials, killed so long after each run's first request."""
    watch, process = Watch(), Process()
    began = time.monotonic()
    async with serving(watch, FAULTS) as url:
        (folder / "killed").mkdir()
        sweep = Sweep(folder / "killed", trials, url)
        kills = await to_its_end(sweep, watch, process, lives_s)
    wall_s = time.monotonic() - began
    async with serving(quietly := Watch(), FaultPlan()) as url:
        (folder / "quiet").mkdir()
        quiet = Sweep(folder / "quiet", trials, url)
        await to_its_end(quiet, quietly, Process())
    summary = sweep.summary()
    return {
        "wall_s": wall_s,
        "peak_mb": process.peak_mb,
        "handles": process.handles,
        "trials": trials,
        "kills": kills,
        "requests": watch.asked.total(),
        "calls_made": len({key for key, _ in watch.asked}),
        "attempts_made_twice": watch.asked.total() - len(watch.asked),
        "answered_asked_again": watch.asked_again,
        "billed_usd": watch.billed_usd,
        "spent_usd": summary["sweep_cost_usd"],
        "set_aside_usd": summary["set_aside_usd"],
        "beyond_ledger_usd": max(
            0.0, watch.billed_usd - summary["sweep_cost_usd"] - summary["set_aside_usd"]
        ),
        "attempts_of_unknown_cost": summary["attempts_of_unknown_cost"],
        "quiet_billed_usd": quietly.billed_usd,
        "digest_differs": results_digest(sweep.db) != results_digest(quiet.db),
    }


def soak(trials: int, lives_s: float) -> Callable[[Bench], Figures]:
    """A soak as a case; nothing of it is left."""
    return lambda bench: asyncio.run(measure(bench.fresh("soak"), trials, lives_s))
