"""The cases of inspect-ai, in an environment of its own."""

from __future__ import annotations

from collections.abc import Callable

from benchmarks.cases import (
    KILLED_DELAY_MS,
    Bench,
    Figures,
    asked_again,
    figures_of,
    half_is_answered,
)
from benchmarks.processes import PROJECT, Run, run
from benchmarks.workload import CALLS, TRIALS

PEER = PROJECT / ".venv-peer" / "bin" / "python"
FEW = TRIALS // 8


def peer_cold(bench: Bench) -> Figures:
    """All calls, and its cache filled."""
    return _measured(_peer(bench, bench.fresh("peer").name, "--cache"))


def peer_cached(bench: Bench) -> Figures:
    """The same again, answered by its cache."""
    return _measured(_peer(bench, "peer", "--cache"))


def peer_resume(bench: Bench) -> Figures:
    """An eighth of the trials, killed without a word at half, and gone on with from its log."""
    name = bench.fresh("peer-killed").name
    bench.server.reset()
    few, until = ("--trials", str(FEW)), half_is_answered(bench.server, FEW)
    _peer(bench, name, *few, delay_ms=KILLED_DELAY_MS, until=until)
    return asked_again(
        bench.server,
        lambda: _peer(bench, name, "--retry", delay_ms=KILLED_DELAY_MS),
        calls=CALLS * FEW,
    )


def _measured(ran: Run) -> Figures:
    return figures_of(ran, calls=TRIALS * CALLS)


def installed() -> bool:
    """Return whether the peer is installed; ``make bench`` installs it."""
    return PEER.exists()


def _peer(
    bench: Bench,
    name: str,
    *options: str,
    delay_ms: int = 0,
    until: Callable[[], bool] | None = None,
) -> Run:
    return run(
        [
            str(PEER),
            "-m",
            "benchmarks.peer",
            "--url",
            bench.server.url(delay_ms),
            "--folder",
            str(bench.folder / name),
            *options,
        ],
        until=until,
        pinned=True,
    )
