"""The program as a user runs it: in the tests' own process, or as one of its own."""

import asyncio
import contextvars
import io
import logging
import os
import subprocess
import sys
import tempfile
import threading
import traceback
import warnings
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from unittest.mock import patch

from merge_runner.cli import main
from merge_runner.results import database
from merge_runner_analysis import cache
from tests.support.harness import PROGRAM, Run

# Folder, environment and streams belong to the whole process.
_alone = threading.Lock()
# What Python shows to nobody who runs a program.
UNTOLD = (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning)


def invoke(arguments, *, cwd: Path, env: dict[str, str]) -> Run:
    """Run the program in this process, with a folder, an environment and streams of its own.

    It sees nothing that the test has registered, and tells what it has told to an earlier run.
    """
    out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True) for _ in "oe")
    with _alone, ExitStack() as changed:
        before = Path.cwd()
        changed.callback(os.chdir, before)
        changed.enter_context(patch.dict(os.environ, env, clear=True))
        changed.enter_context(patch.object(sys, "argv", ["merge-runner", *map(str, arguments)]))
        changed.enter_context(patch.object(sys, "stdin", io.StringIO()))
        changed.enter_context(redirect_stdout(out))
        changed.enter_context(redirect_stderr(err))
        changed.enter_context(_as_a_process_tells_them(err))
        for told_once in (database.warn_of_other_measures, cache.warn_once):
            told_once.cache_clear()
        os.chdir(cwd)
        code = contextvars.Context().run(_to_its_end)
    return Run(code, *(stream.buffer.getvalue().decode() for stream in (out, err)))


@contextmanager
def _as_a_process_tells_them(err):
    """Write to ``err`` what the program logs and warns of, which pytest would keep for itself."""
    others = {thread.ident for thread in threading.enumerate()} - {threading.get_ident()}

    def warn(message, category, filename, lineno, file=None, line=None):
        if threading.get_ident() not in others:
            err.write(warnings.formatwarning(message, category, filename, lineno, line))

    handler = logging.StreamHandler(err)
    handler.setLevel(logging.WARNING)
    handler.addFilter(lambda record: record.thread not in others)
    with warnings.catch_warnings(), patch.object(logging.root, "handlers", [handler]):
        warnings.showwarning = warn
        for category in UNTOLD:
            warnings.simplefilter("ignore", category)
        yield


def _to_its_end() -> int:
    try:
        main()
    except SystemExit as exc:
        if isinstance(exc.code, int | None):
            return exc.code or 0
        sys.stderr.write(f"{exc.code}\n")
    except KeyboardInterrupt:  # it is meant for the tests
        raise
    except BaseException:  # noqa: BLE001 # as the interpreter does at the end of a program
        traceback.print_exc()
    return 1


def run(arguments, *, cwd: Path, env: dict[str, str]) -> Run:
    """Run the program to its end: as a process where it has packages or workers of its own."""
    own = {name for name in env if name.startswith("PYTHON") and env[name] != os.environ.get(name)}
    if not (own or "--dask" in arguments):
        return invoke(arguments, cwd=cwd, env=env)
    done = subprocess.run(
        [PROGRAM, *map(str, arguments)],
        cwd=cwd,
        env=env,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        check=False,
    )
    return Run(done.returncode, done.stdout.decode(), done.stderr.decode())


class Process:
    """A running program, whose streams are files, so that nobody need read them."""

    def __init__(self, process, streams) -> None:
        self._process, self._streams = process, streams
        self.pid = process.pid
        self.send_signal = process.send_signal
        self.terminate, self.kill = process.terminate, process.kill

    @property
    def returncode(self) -> int | None:
        return self._process.returncode

    async def said(self, words: str) -> None:
        """Wait until it has written these words to its standard error."""
        while words.encode() not in (told := os.pread(self._streams[1].fileno(), 2**20, 0)):
            assert self.returncode is None, told.decode()
            await asyncio.sleep(0.01)

    async def communicate(self) -> tuple[bytes, ...]:
        """Wait for its end; returns what it wrote to its standard output and error."""
        await self._process.wait()
        return tuple(os.pread(stream.fileno(), 2**26, 0) for stream in self._streams)

    async def wait(self) -> int:
        return await self._process.wait()


async def start(arguments, *, cwd: Path, env: dict[str, str], module: str = "") -> Process:
    """Start the program, or a module in its place, as a process of its own."""
    streams = [tempfile.TemporaryFile() for _ in "oe"]  # noqa: SIM115 # closed with the process
    process = await asyncio.create_subprocess_exec(
        *([sys.executable, "-m", module] if module else [PROGRAM]),
        *map(str, arguments),
        cwd=cwd,
        env=env,
        stdin=subprocess.DEVNULL,
        stdout=streams[0],
        stderr=streams[1],
        start_new_session=True,
    )
    return Process(process, streams)


def every_command(command, path=()):
    yield path, command
    for name, inner in getattr(command, "commands", {}).items():
        yield from every_command(inner, (*path, name))
