"""Starts the program by forking a process that has imported it already.

Half of what a short command takes is imports. A test that runs the program to its end gets a real
process with arguments, environment, folder and streams of its own, without that half.
"""

from __future__ import annotations

import asyncio
import importlib
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

from harness import PROGRAM, PROJECT, environment

# What commands import where they need it; nothing of it may start a thread.
WARM = (
    "analysis.commands",
    "analysis.report",
    "merge_runner.llm.http",
    "merge_runner.emulator.server",
    "merge_runner.summary",
    "rich.live",
    "rich.table",
)


class Zygote:
    """A process that forks the program on demand; it imports ``more`` too."""

    def __init__(self, *more: str) -> None:
        self._more = more

    def __enter__(self) -> Zygote:
        self._folder = tempfile.TemporaryDirectory(prefix="zygote")
        self._address = str(Path(self._folder.name) / "socket")
        self._process = subprocess.Popen(
            [sys.executable, __file__, self._address, *self._more],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment(PYTHONPATH=f"{PROJECT}:{PROJECT}/tests", OPENBLAS_NUM_THREADS="1"),
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

    async def start(self, arguments, *, cwd, env, module="") -> Forked:
        """Start the program, or a module in its place as ``python -m`` does."""
        request = {"arguments": list(map(str, arguments)), "cwd": str(cwd), "env": env}
        link = socket.socket(socket.AF_UNIX)
        streams = [tempfile.TemporaryFile() for _ in ("out", "err")]  # noqa: SIM115 # it closes them
        link.connect(self._address)
        data = json.dumps({**request, "module": module}).encode()
        socket.send_fds(link, [data], [file.fileno() for file in streams])
        link.shutdown(socket.SHUT_WR)
        link.setblocking(False)
        pid = int(await asyncio.get_running_loop().sock_recv(link, 16))
        return Forked(pid, link, streams)


class Forked:
    """The program, as asyncio's Process has it."""

    def __init__(self, pid, link, streams) -> None:
        self.pid = pid
        self.returncode: int | None = None
        self._link = link
        self._streams = streams
        self._written: list[bytes] = []

    async def wait(self) -> int:
        if self.returncode is None:
            self.returncode = int(await asyncio.get_running_loop().sock_recv(self._link, 16))
            self._link.close()
            self._written = [_content(file) for file in self._streams]
        return self.returncode

    async def communicate(self) -> list[bytes]:
        await self.wait()
        return self._written

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def _content(file) -> bytes:
    with file:
        file.seek(0)
        return file.read()


def serve(address: str, *more: str) -> None:
    """Fork a process for each request until standard input closes."""
    for name in (*WARM, *more):
        importlib.import_module(name)
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
    """Run one request in a child of its own; tell its number, and how it ended."""
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
        if request["module"]:
            runpy.run_module(request["module"], run_name="__main__", alter_sys=True)
        else:
            main()
        sys.exit()
    link.sendall(str(child).encode())
    _, status = os.waitpid(child, 0)
    link.sendall(str(os.waitstatus_to_exitcode(status)).encode())
    os._exit(0)


def _become_the_program(request, streams) -> None:
    os.setsid()
    for number, stream in enumerate((os.open(os.devnull, os.O_RDONLY), *streams)):
        os.dup2(stream, number)
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    sys.argv = ["merge-runner", *request["arguments"]]
    sys.modules["__main__"].__file__ = str(PROGRAM)  # what processes import that it starts


if __name__ == "__main__":
    serve(*sys.argv[1:])
