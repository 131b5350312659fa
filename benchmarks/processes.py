"""Runs whole programs and measures what they take."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

PROJECT = Path(__file__).resolve().parents[1]
PYTHON = sys.executable
RUNNER = (PYTHON, "-m", "merge_runner")
PROGRAM = (PYTHON, "-c", "from merge_runner.__main__ import main; main()")


@dataclass(frozen=True, slots=True)
class Run:
    """One process: wall and CPU time in s, peak memory in MB, and its output.

    A peak below this process's peak cannot be measured: 0.
    """

    wall_s: float
    cpu_s: float
    peak_mb: float
    output: str

    @property
    def summary(self) -> dict[str, Any]:
        """The JSON object in its last line."""
        summary: dict[str, Any] = json.loads(self.output.strip().splitlines()[-1])
        return summary


def run(
    argv: Sequence[str],
    *,
    environment: Mapping[str, str] | None = None,
    until: Callable[[], bool] | None = None,
    pinned: bool = False,
) -> Run:
    """Run a program to its end, or kill it without a word when ``until`` says so.

    ``pinned`` keeps it off the server's CPUs. Raises RuntimeError where it fails by itself.
    """
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        began = time.perf_counter()
        with started_on(0 if pinned else None):
            process = subprocess.Popen(
                argv,
                cwd=PROJECT,
                env={**_usual_environment(), **(environment or {})},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=errors,
            )
        while until is not None and not until():
            if os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
                raise RuntimeError(f"{' '.join(argv)} ended before it was to be killed")
            time.sleep(0.01)
        if until is not None:
            process.send_signal(signal.SIGKILL)
        _, status, usage = os.wait4(process.pid, 0)
        wall_s = time.perf_counter() - began
        process.returncode = os.waitstatus_to_exitcode(status)
        texts = []
        for file in (output, errors):
            file.seek(0)
            texts.append(file.read().decode())
    if process.returncode and until is None:
        raise RuntimeError(f"{' '.join(argv)} ended with {process.returncode}\n{''.join(texts)}")
    cpu_s = usage.ru_utime + usage.ru_stime
    ours_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    peak_kb = usage.ru_maxrss if usage.ru_maxrss > ours_kb else 0
    return Run(wall_s, cpu_s, peak_kb / 1024, texts[0])


def _usual_environment() -> dict[str, str]:
    """Return this process's environment, in which Python keeps compiled files, as for users."""
    return {name: v for name, v in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


@contextmanager
def started_on(half: int | None) -> Iterator[None]:
    """Processes that are started within this stay on one half of the CPUs, 0 or 1.

    Where there is but one CPU, or the system cannot, they run anywhere.
    """
    cpus = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    if half is None or len(cpus) < 2:
        yield
        return
    middle = len(cpus) // 2
    os.sched_setaffinity(0, cpus[middle:] if half else cpus[:middle])
    try:
        yield
    finally:
        os.sched_setaffinity(0, cpus)


@dataclass(frozen=True, slots=True)
class Server:
    """The loopback server of a benchmark."""

    port: int

    def url(self, delay_ms: int = 0) -> str:
        """A base URL whose answers take a while."""
        return f"http://127.0.0.1:{self.port}/delay/{delay_ms}/v1"

    def reset(self) -> None:
        """Forget what was asked."""
        self._ask(Request(f"http://127.0.0.1:{self.port}/reset", data=b"", method="POST"))

    def stats(self) -> dict[str, Any]:
        """Return the requests since the last reset."""
        return self._ask(Request(f"http://127.0.0.1:{self.port}/stats"))

    def _ask(self, request: Request) -> dict[str, Any]:
        with urlopen(request) as reply:  # noqa: S310 # our own server
            content: dict[str, Any] = json.load(reply)
        return content


@contextmanager
def serving(argv: Sequence[str], *, half: int | None = None) -> Iterator[str]:
    """A server as a process of its own, until the end of this; gives the first line it prints.

    ``half`` are the CPUs that it stays on. Raises RuntimeError where it prints nothing.
    """
    with tempfile.TemporaryFile() as errors:
        with started_on(half):
            process = subprocess.Popen(
                argv,
                cwd=PROJECT,
                env=_usual_environment(),
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
            )
        with process:
            assert process.stdout is not None
            try:
                line = process.stdout.readline().strip()
                if not line:
                    errors.seek(0)
                    raise RuntimeError(f"{' '.join(argv)} served nothing\n{errors.read().decode()}")
                yield line
            finally:
                process.terminate()


@contextmanager
def served() -> Iterator[Server]:
    """The loopback server, on the other CPUs than what is measured."""
    with serving([PYTHON, "-m", "benchmarks.server"], half=1) as port:
        yield Server(int(port))
