"""The sweep that clusters play, and their processes."""

from __future__ import annotations

import psutil

from tests.gate import Gate

# Six trials of 19 calls each.
SWEEP = ("sweep", "baseline", "--reps", 2, "--conditions", "L_4_0,N_0_0,R_-4_8", "--json")


def workers_of(pid: int) -> list[psutil.Process]:
    """The workers that a coordinator has started: what is forked from a process of its own."""
    children = psutil.Process(pid).children()
    servers = [child for child in children if "forkserver" in " ".join(child.cmdline())]
    return [worker for server in servers for worker in server.children()]


def held_from(gate: Gate, worker: psutil.Process) -> set[str]:
    """The slots that wait for an answer on a worker's connections."""
    ports = {c.laddr.port for c in worker.net_connections("tcp")}
    return {slot for slot, port in gate.held.items() if port in ports}
