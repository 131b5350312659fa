"""A server that holds its answers, so that a test can do something in the midst of a sweep."""

import asyncio
import json
import math
from contextlib import closing
from pathlib import Path

from merge_runner.llm.cache import ResponseCache
from merge_runner.records import SLOT_HEADER
from tests.support.harness import a_model

# Only what never ends takes so long, however loaded the machine is.
HANGS_S = 300


# The emulator as it ships, but for its patience, which a loaded machine would outlast.
PATIENT = a_model(timeout_s=HANGS_S, deadline_s=HANGS_S)


class Gate:
    """Lets a number of requests through, and holds the next ones until it opens.

    Of each driver it lets only the first ``decisions`` through. A sweep in ``folder`` waits as long
    for the emulator.
    """

    def __init__(self, passing: float, folder: Path, *, decisions: float = math.inf) -> None:
        (folder / "models.toml").write_text(PATIENT)
        self.passing = passing
        self.decisions = decisions
        self.asked: list[str] = []
        self.held: dict[str, int] = {}  # slot to the asking port
        self._open = asyncio.Event()

    async def middle(self, request, handler):
        slot = request.headers[SLOT_HEADER]
        self.asked.append(slot)
        late = json.loads(slot)["decision"] >= self.decisions
        if (late or len(self.asked) > self.passing) and not self._open.is_set():
            self.held[slot] = request.get_extra_info("peername", ("", 0))[1]
            await self._open.wait()
        return await handler(request)

    def open(self) -> None:
        self._open.set()

    async def held_trials(self, cache: Path, trials: int) -> None:
        """Wait until so many trials are held, and what passed is saved.

        How the answers that pass are spread over the trials is chance: a trial may wait for one
        of its drivers alone.
        """
        async with asyncio.timeout(HANGS_S):
            while len(set(map(_trial, self.held))) < trials or _saved(cache) < self.passing:
                await asyncio.sleep(0.05)

    @property
    def asked_again(self) -> set[str]:
        return {slot for slot in self.asked if self.asked.count(slot) > 1}


def _trial(slot: str) -> tuple[str, int]:
    told = json.loads(slot)
    return told["condition"], told["repetition"]


def _saved(cache: Path) -> int:
    with closing(ResponseCache(cache, read_only=True)) as opened:
        return sum(1 for _ in opened.entries())
