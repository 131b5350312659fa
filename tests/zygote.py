"""Starts the program by forking a process that has imported it already.

Most of what a short command takes is imports, and their teardown. A test gets a real process with
arguments, environment, folder and streams of its own, without those.
"""

from __future__ import annotations

import asyncio
import atexit
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
from functools import partial
from pathlib import Path

from tests.harness import PROGRAM, PROJECT, environment

# What commands import where they need it; nothing of it may start a thread.
WARM = (
    "analysis.commands",
    "analysis.report.writer",
    "merge_runner.llm.http",
    "merge_runner.emulator.server",
    "merge_runner.run.summary",
    "rich.live",
    "rich.table",
)
DIGITS = 10  # of a process id, as it is sent


class Zygote:
    """A process that forks the program on demand; it imports ``more`` too."""

    def __init__(self, *more: str) -> None:
        self._more = more

    def __enter__(self) -> Zygote:
        self._folder = tempfile.TemporaryDirectory(prefix="zygote")
        self._address = str(Path(self._folder.name) / "socket")
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.zygote", self._address, *self._more],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment(PYTHONPATH=str(PROJECT)),
            start_new_session=True,
        )
        assert self._process.stdout.readline() == b"ready\n"
        return self

    def __exit__(self, *_) -> None:
        self._process.stdin.close()
        self._process.wait()
        self._folder.cleanup()

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
        link = self._request(arguments, cwd, env, out, err, module)
        link.setblocking(False)
        pid = int(await asyncio.get_running_loop().sock_recv(link, DIGITS))
        return Forked(pid, link, out, err)

    def _request(self, arguments, cwd, env, out, err, module="") -> socket.socket:
        request = {"arguments": list(map(str, arguments)), "cwd": str(cwd), "env": env}
        request["module"] = module
        link = socket.socket(socket.AF_UNIX)
        link.connect(self._address)
        socket.send_fds(link, [json.dumps(request).encode()], [out.fileno(), err.fileno()])
        link.shutdown(socket.SHUT_WR)
        return link


class Forked:
    """A running program: what tests use of ``asyncio.subprocess.Process``."""

    def __init__(self, pid, link, *streams):
        self.pid = pid
        self.returncode: int | None = None
        self._ended = asyncio.create_task(self._end(link, streams))

    async def _end(self, link, streams) -> tuple[bytes, ...]:
        with link:
            self.returncode = int(await asyncio.get_running_loop().sock_recv(link, DIGITS))
        written = tuple(map(_content, streams))
        for stream in streams:
            stream.close()
        return written

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


def serve(address: str, *more: str) -> None:
    """Fork a process for each request until standard input closes."""
    for name in (*WARM, *more):
        importlib.import_module(name)
    # What is imported stays shared with the forked: their collector does not look at it.
    gc.collect()
    gc.freeze()
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(address)
    listener.listen(64)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    os.write(1, b"ready\n")
    if os.fork() == 0:
        while True:
            link, _ = listener.accept()
            if os.fork() == 0:
                listener.close()
                _attend(link)
            link.close()
    sys.stdin.read()
    os.killpg(0, signal.SIGTERM)


def _attend(link: socket.socket) -> None:
    """Run one request in a child of its own, and tell how it ended."""
    from analysis.commands import main

    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    data, streams, _, _ = socket.recv_fds(link, 2**16, 2)
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
    for number, stream in enumerate((os.open(os.devnull, os.O_RDONLY), *streams)):
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
