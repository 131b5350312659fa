"""A forked program is the program: it ends as one that was started does, and leaves the same."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from tests import forked_program
from tests.forked_program import DIGITS
from tests.harness import environment, watched
from tests.zygote import Zygote, wait_until_nobody_holds

pytestmark = pytest.mark.long

SWEEP = ("sweep", "baseline", "--reps", 1, "--conditions", "R_-4_8", "--json")


def left(folder):
    """The files by name, and whether each has content."""
    return {
        str(path.relative_to(folder)): path.stat().st_size > 0
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.mark.parametrize(
    "command", [SWEEP, ("digest", "--db", "nowhere")], ids=["a sweep", "wrong usage"]
)
async def test_a_forked_program_ends_and_leaves_what_a_started_one_does(
    merge_runner, emulator_url, tmp_path, command
):
    found = []
    for begin in (merge_runner.fork, merge_runner.start):
        folder = tmp_path / begin.__name__
        folder.mkdir()
        process = await begin(*command, cwd=folder, EMULATOR_BASE_URL=emulator_url)
        out, err = await process.communicate()
        words = [re.sub(rb"\d+", b"0", text) for text in (out, err)]
        found.append((process.returncode, len(words[0]) > 0, words[1][:20], left(folder)))
    assert found[0] == found[1]


async def test_a_forked_program_is_told_by_its_signal(merge_runner):
    async def middle(request, handler):
        arrived.set()
        await asyncio.Event().wait()

    arrived = asyncio.Event()
    async with watched(middle) as server:
        process = await merge_runner.fork(*SWEEP, EMULATOR_BASE_URL=f"{server.url}/v1")
        await arrived.wait()
        assert process.returncode is None
        process.kill()
        assert await process.wait() == process.returncode == -signal.SIGKILL


def test_a_shell_forks_it_by_name_with_its_streams_and_its_folder(zygote, tmp_path):
    (tmp_path / "bin").mkdir()
    variables = environment(**zygote.on_path(tmp_path / "bin"))
    done = subprocess.run(
        "merge-runner digest --db nowhere; echo $?; merge-runner init 'my study' | cat",
        shell=True, cwd=tmp_path, env=variables, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.splitlines()[0] == "2"
    assert done.stdout.splitlines()[1].startswith("go on: cd 'my study'")
    assert done.stderr.startswith("error: there is no database nowhere")
    assert (tmp_path / "my study/study.toml").exists()


def test_a_shells_forked_program_is_stopped_as_the_shell_is(zygote, tmp_path):
    (tmp_path / "bin").mkdir()
    process = subprocess.Popen(
        ["merge-runner", "emulate", "--port", "0"],
        env=environment(**zygote.on_path(tmp_path / "bin")), cwd=tmp_path,
        executable=tmp_path / "bin/merge-runner", stdout=subprocess.PIPE,
    )  # fmt: skip
    with process.stdout as said:
        assert said.readline().startswith(b"http://")
        process.terminate()
        assert said.read() == b"", "nobody writes any more"
    assert process.wait() == 128 + signal.SIGTERM


def test_a_signal_that_comes_before_the_forked_program_is_known_reaches_it(tmp_path):
    child = subprocess.Popen(["sleep", "1000"])
    with socket.socket(socket.AF_UNIX) as zygote:
        zygote.bind(str(tmp_path / "zygote"))
        zygote.listen()
        shell = subprocess.Popen(
            [sys.executable, "-IS", forked_program.__file__],
            env=environment(ZYGOTE=str(tmp_path / "zygote")),
        )
        link, _ = zygote.accept()
        with link:
            shell.terminate()
            link.sendall(f"{child.pid:{DIGITS}}".encode())
            assert child.wait(timeout=60) == -signal.SIGTERM
            link.sendall(str(child.returncode).encode())
    assert shell.wait() == 128 + signal.SIGTERM


def is_read(pipe):
    """Whether somebody waits for it to be closed."""
    try:
        os.close(os.open(pipe, os.O_WRONLY | os.O_NONBLOCK))
    except OSError:
        return False
    return True


def test_who_comes_when_nobody_holds_it_any_more_does_not_hold_what_is_about_to_end(tmp_path):
    held = tmp_path / "held"
    os.mkfifo(held)
    (tmp_path / "lock").touch()
    with ThreadPoolExecutor() as threads:
        ended = threads.submit(wait_until_nobody_holds, tmp_path)
        os.close(os.open(held, os.O_WRONLY))
        ended.result()
    assert not is_read(held)


def test_what_is_forked_from_ends_with_the_last_that_holds_it_and_is_started_anew(tmp_path):
    def works(zygote):
        return zygote.run_blocking(["--version"], cwd=tmp_path, env=environment())[0] == 0

    with Zygote(tmp_path / "z") as first:
        with Zygote(tmp_path / "z") as second:
            begun = (tmp_path / "z/socket").stat().st_mtime_ns
            assert works(second)
        assert works(first)
    with Zygote(tmp_path / "z") as just_then:
        assert works(just_then)
    while is_read(tmp_path / "z/held"):
        time.sleep(0.01)
    with Zygote(tmp_path / "z") as later:
        assert works(later)
        assert (tmp_path / "z/socket").stat().st_mtime_ns != begun
