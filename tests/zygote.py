"""Starts the program by forking a process that has imported it already.

Most of what a short command takes is imports, and their teardown. A test gets a real process with
arguments, environment, folder and streams of its own, without those. All processes of a run of
the tests fork from the same one.
"""

from __future__ import annotations

import asyncio
import atexit
import fcntl
import gc
import importlib
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from tests import forked_program
from tests.forked_program import DIGITS, asked
from tests.harness import PROGRAM, PROJECT, environment

# What commands import where they need it; nothing of it may start a thread.
WARM = (
    "merge_runner_analysis.commands",
    "merge_runner_analysis.report.page",
    "merge_runner.llm.http",
    "merge_runner.emulator.server",
    "merge_runner.run.sweep",
    "rich.live",
    "rich.table",
    "matplotlib.backends.backend_agg",
    "matplotlib.backends.backend_pdf",
    "matplotlib.backends.backend_svg",
    "statsmodels.formula.api",
)
# So that linear algebra starts none.
ALONE = {"OPENBLAS_NUM_THREADS": "1"}


class Zygote:
    """A process that forks the program on demand; it imports ``more`` too.

    Those with the same ``folder`` are one: the first starts it, and it ends with the last.
    """

    def __init__(self, folder: Path, *more: str) -> None:
        self._folder = folder
        self._address = str(folder / "socket")
        self._more = more

    def __enter__(self) -> Zygote:
        self._folder.mkdir(exist_ok=True)
        with (self._folder / "lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            try:
                self._held = os.open(self._folder / "held", os.O_WRONLY | os.O_NONBLOCK)
            except OSError:  # nobody reads it
                self._start()
                self._held = os.open(self._folder / "held", os.O_WRONLY)
        return self

    def _start(self) -> None:
        for name in ("held", "socket"):
            (self._folder / name).unlink(missing_ok=True)
        os.mkfifo(self._folder / "held")
        subprocess.run(
            [sys.executable, "-m", "tests.zygote", self._folder, *self._more],
            env=environment(PYTHONPATH=str(PROJECT), **ALONE),
            stdin=subprocess.DEVNULL,
            check=True,
        )

    def __exit__(self, *_) -> None:
        os.close(self._held)

    def on_path(self, folder: Path, path: str = os.environ["PATH"]) -> dict[str, str]:
        """Variables under which shells find in ``folder``, before ``path``, a forked program."""
        script = folder / "merge-runner"
        script.write_text(f'#!/bin/sh\nexec {sys.executable} -IS {forked_program.__file__} "$@"\n')
        script.chmod(0o755)
        return {"PATH": f"{folder}{os.pathsep}{path}", "ZYGOTE": self._address}

    async def run(self, arguments, *, cwd, env) -> tuple[int, str, str]:
        """Run the program to its end; returns its exit code and what it wrote."""
        process = await self.start(arguments, cwd=cwd, env=env)
        out, err = await process.communicate()
        return process.returncode, out.decode(), err.decode()

    def run_blocking(self, arguments, *, cwd, env) -> tuple[int, str, str]:
        """The same where no loop runs: in what prepares tests."""
        with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
            with self._request(arguments, cwd, env, out, err) as link, link.makefile() as told:
                code = int(told.read()[DIGITS:])
            return code, _content(out).decode(), _content(err).decode()

    async def start(self, arguments, *, cwd, env, module="") -> Forked:
        """Start the program, or a module in its place as ``python -m`` does; to be waited for."""
        out, err = (tempfile.TemporaryFile() for _ in "oe")  # noqa: SIM115 # closed at its end
        link = self._request(arguments, cwd, env, out, err, module=module)
        link.setblocking(False)
        pid = int(await asyncio.get_running_loop().sock_recv(link, DIGITS))
        return Forked(pid, link, out, err)

    @contextmanager
    def serving(self, arguments, *, cwd, env) -> Iterator[str]:
        """Runs a server; gives the first line that it writes."""
        ours, theirs = socket.socketpair()
        with theirs:
            link = self._request(arguments, cwd, env, theirs, theirs)
        with link:
            pid = int(link.recv(DIGITS, socket.MSG_WAITALL))
            with ours, ours.makefile() as said:
                yield said.readline()
            os.kill(pid, signal.SIGTERM)
            link.recv(DIGITS)  # once it has ended

    def _request(self, arguments, cwd, env, out, err, *, module="") -> socket.socket:
        with open(os.devnull) as nothing:
            return asked(
                self._address,
                list(map(str, arguments)),
                cwd=str(cwd),
                env=env,
                streams=[file.fileno() for file in (nothing, out, err)],
                module=module,
            )


class Forked:
    """A running program: what tests use of ``asyncio.subprocess.Process``."""

    def __init__(self, pid, link, *streams):
        self.pid = pid
        self._err = streams[1]
        self.returncode: int | None = None
        self._ended = asyncio.create_task(self._end(link, streams))

    async def _end(self, link, streams) -> tuple[bytes, ...]:
        with link:
            self.returncode = int(await asyncio.get_running_loop().sock_recv(link, DIGITS))
        written = tuple(map(_content, streams))
        for stream in streams:
            stream.close()
        return written

    async def said(self, words: str) -> None:
        """Wait until it has written these words to its standard error."""
        while words.encode() not in os.pread(self._err.fileno(), 2**20, 0):
            assert self.returncode is None
            await asyncio.sleep(0.01)

    async def communicate(self) -> tuple[bytes, ...]:
        return await asyncio.shield(self._ended)

    async def wait(self) -> int:
        await self.communicate()
        return self.returncode

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def _content(file) -> bytes:
    file.seek(0)
    return file.read()


def serve(folder: str, *more: str) -> None:
    """Return once requests are taken; fork a process for each until nobody holds the folder."""
    for name in (*WARM, *more):
        importlib.import_module(name)
    # What is imported stays shared with the forked: their collector does not look at it.
    gc.collect()
    gc.freeze()
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(f"{folder}/socket")
    listener.listen(64)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    if os.fork():
        os._exit(0)
    os.setsid()
    if os.fork() == 0:
        while True:
            link, _ = listener.accept()
            if os.fork() == 0:
                listener.close()
                _attend(link)
            link.close()
    wait_until_nobody_holds(folder)
    os.killpg(0, signal.SIGTERM)


def wait_until_nobody_holds(folder: str | Path) -> None:
    """Return, locked, when the last holder is gone and nobody can become one any more."""
    held = os.open(f"{folder}/held", os.O_RDONLY)
    lock = os.open(f"{folder}/lock", os.O_RDWR)
    while True:
        os.set_blocking(held, True)
        os.read(held, 1)
        # Somebody may have come just now; while it is locked nobody does, and then all ends.
        fcntl.flock(lock, fcntl.LOCK_EX)
        os.set_blocking(held, False)
        try:
            os.read(held, 1)
        except BlockingIOError:
            fcntl.flock(lock, fcntl.LOCK_UN)
        else:
            # At its end a process gives the lock back before it closes this: who came in between
            # would hold what is about to end.
            os.close(held)
            return


def _attend(link: socket.socket) -> None:
    """Run one request in a child of its own, and tell how it ended."""
    from merge_runner_analysis.commands import main

    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    data, streams, _, _ = socket.recv_fds(link, 2**16, 3)
    while part := link.recv(2**16):
        data += part
    request = json.loads(data)
    child = os.fork()
    if child == 0:
        link.close()
        _become_the_program(request, streams)
        module = partial(runpy.run_module, request["module"], run_name="__main__", alter_sys=True)
        _run_to_its_end(module if request["module"] else main)
    link.sendall(f"{child:{DIGITS}}".encode())
    _, status = os.waitpid(child, 0)
    link.sendall(str(os.waitstatus_to_exitcode(status)).encode())
    os._exit(0)


def _run_to_its_end(main) -> None:
    """Run it and end as the interpreter does, but for the teardown of every imported module.

    That would touch, and so copy, all the memory that was forked: more work than most commands.
    Whatever ends the program in another way than by ``sys.exit`` is left to the interpreter.
    """
    code = 0
    try:
        main()
    except SystemExit as exc:
        if not isinstance(exc.code, int | None):
            raise
        code = exc.code or 0
    threading._shutdown()
    atexit._run_exitfuncs()
    # What the program itself has made goes as it would: SQLite tidies its folder up only then.
    gc.collect()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _folders(env) -> list[str]:
    return list(filter(None, env.get("PYTHONPATH", "").split(os.pathsep)))


def _become_the_program(request, streams) -> None:
    os.setsid()
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    # As the interpreter does that starts with these variables: there may be packages of the test.
    sys.path[:0] = [folder for folder in _folders(request["env"]) if folder not in sys.path]
    sys.argv = ["merge-runner", *request["arguments"]]
    sys.modules["__main__"].__file__ = str(PROGRAM)  # what processes import that it starts


if __name__ == "__main__":
    serve(*sys.argv[1:])
