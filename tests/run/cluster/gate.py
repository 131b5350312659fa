"""A server that can hold its answers, and the processes of a cluster."""

from __future__ import annotations

import asyncio

import psutil

from merge_runner.records import SLOT_HEADER

# Six trials of 19 calls each.
SWEEP = ("sweep", "baseline", "--reps", 2, "--conditions", "L_4_0,N_0_0,R_-4_8", "--json")


class Gate:
    """Lets a number of requests through, and holds the next ones until it opens."""

    def __init__(self, passing: int) -> None:
        self.passing = passing
        self.asked: list[str] = []
        self.held: dict[str, int] = {}  # slot to the asking port
        self._open = asyncio.Event()

    async def middle(self, request, handler):
        slot = request.headers[SLOT_HEADER]
        self.asked.append(slot)
        if len(self.asked) > self.passing and not self._open.is_set():
            self.held[slot] = request.transport.get_extra_info("peername")[1]
            await self._open.wait()
        return await handler(request)

    def open(self) -> None:
        self._open.set()

    async def quiet(self, held: int = 1) -> None:
        """Wait until so many requests are held and none comes any more: all others are saved."""
        async with asyncio.timeout(30):
            while len(self.held) < held:
                await asyncio.sleep(0.05)
            before = -1
            while before != len(self.asked):
                before = len(self.asked)
                await asyncio.sleep(0.5)

    @property
    def asked_again(self) -> set[str]:
        return {slot for slot in self.asked if self.asked.count(slot) > 1}


def workers_of(pid: int) -> list[psutil.Process]:
    """The workers that a coordinator has started: what is forked from a process of its own."""
    children = psutil.Process(pid).children()
    servers = [child for child in children if "forkserver" in " ".join(child.cmdline())]
    return [worker for server in servers for worker in server.children()]


def held_from(gate: Gate, worker: psutil.Process) -> set[str]:
    """The slots that wait for an answer on a worker's connections."""
    ports = {c.laddr.port for c in worker.net_connections("tcp")}
    return {slot for slot, port in gate.held.items() if port in ports}
