"""Sweeps of one user on one key keep its limits together."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import time

import pytest

from merge_runner.errors import UsageError
from merge_runner.llm.limiter import Limiter
from merge_runner.llm.shared_limits import SharedLimits, limits_file
from tests.llm.test_limiter import MINUTE, Queue, fullest_window, on_a_clock
from tests.virtual_time import now_s

pytestmark = pytest.mark.long

KEY = {"authorization": "Bearer sk-a-secret-key"}


def queues(folder, number=2, **limits):
    """Queues of so many processes that use one key."""
    return [
        Queue(Limiter(**limits, shared=SharedLimits(folder / "key", **limits, clock=now_s)))
        for _ in range(number)
    ]


async def served(*asked):
    """When all turns were given, in order, with their tokens."""
    for queue in asked:
        await queue.all_served()
    turns = sorted(turn for q in asked for turn in zip(q.times, q.tokens, strict=True))
    return [at for at, _ in turns], [tokens for _, tokens in turns]


@pytest.mark.parametrize("rpm", [7, 240])
@on_a_clock
async def test_two_sweeps_on_one_key_send_no_more_than_one_may(rpm, tmp_path):
    both = queues(tmp_path, rpm=rpm)
    for number in range(2 * rpm + 4):
        both[number % 2].ask(number)
    times, _ = await served(*both)
    assert fullest_window(times, [1] * len(times)) <= rpm
    # They flow evenly as well: in half a minute no more than half.
    assert fullest_window(times, [1] * len(times), MINUTE / 2) <= rpm / 2 + max(1, rpm / 120)


@on_a_clock
async def test_two_sweeps_on_one_key_use_no_more_tokens_than_one_may(tmp_path):
    both = queues(tmp_path, tpm=100)
    for number in range(12):
        both[number % 2].ask(number, tokens=30)
    times, tokens = await served(*both)
    assert fullest_window(times, tokens) <= 100
    assert times[-1] < 4.2 * MINUTE, "what has left the window is free again"


@on_a_clock
async def test_tokens_that_were_not_used_are_free_for_the_other_sweep(tmp_path):
    one, other = queues(tmp_path, tpm=100)
    settle = await one.ask(tokens=90)
    settle(20)
    other.ask(tokens=70)
    await other.all_served()
    assert other.times == [0]


@on_a_clock
async def test_a_pause_that_a_server_asks_for_holds_for_the_other_sweep(tmp_path):
    one, other = queues(tmp_path, rpm=600)
    one.limiter.pause(30)
    other.ask()
    await other.all_served()
    assert other.times == [pytest.approx(30)]


@on_a_clock
async def test_nobody_waits_for_a_process_that_holds_the_file(tmp_path):
    one, other = queues(tmp_path, rpm=600)
    with one.limiter._shared._locked():
        turn = other.ask()
        await asyncio.sleep(1)
        assert not turn.done()
        other.limiter.pause(0.5)  # not lost either
    await other.all_served()
    assert 1.5 <= other.times[0] < 1.6


@on_a_clock
async def test_a_file_from_before_the_clock_began_anew_holds_nobody_up(tmp_path):
    await asyncio.sleep(10_000)
    old = queues(tmp_path, number=1, rpm=1)[0]
    old.ask()
    await old.all_served()
    anew = SharedLimits(tmp_path / "key", rpm=1, clock=lambda: 5.0)
    assert anew.take(0) == 0


SENDS = """
import sys, time
from pathlib import Path
from merge_runner.llm.shared_limits import SharedLimits
def clock():
    global counted_at
    counted_at = time.monotonic()
    return counted_at
shared = SharedLimits(Path(sys.argv[1]), rpm=240, clock=clock)
print("ready", flush=True)
until = float(input())
while time.monotonic() < until:
    wait = shared.take(0)
    if wait:
        time.sleep(min(wait, 0.01))
    else:
        print(counted_at)
"""


def test_two_processes_keep_one_limit(tmp_path):
    command = [sys.executable, "-c", SENDS, str(tmp_path / "key")]
    piped = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    both = [subprocess.Popen(command, **piped) for _ in range(2)]
    assert [process.stdout.readline() for process in both] == ["ready\n"] * 2
    until = f"{time.monotonic() + 2}\n"
    for process in both:
        process.stdin.write(until)
        process.stdin.flush()
    sent = [[float(line) for line in process.communicate()[0].split()] for process in both]
    times = sorted(sent[0] + sent[1])
    assert len(times) > 5
    assert fullest_window(times, [1] * len(times), 1.0) <= 4 + 2


def test_the_file_is_for_us_alone_and_tells_nothing_of_the_key(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    file = limits_file("https://api.openai.com/v1", "o3", KEY)
    SharedLimits(file, rpm=60).take(100)
    assert "secret" not in str(file)
    assert b"secret" not in file.read_bytes()
    assert (file.parent.stat().st_mode & 0o777, file.stat().st_mode & 0o777) == (0o700, 0o600)
    other_key = {"authorization": "Bearer sk-another-key"}
    others = [
        limits_file("https://other/v1", "o3", KEY),
        limits_file("https://api.openai.com/v1", "o4", KEY),
    ]
    assert file not in [*others, limits_file("https://api.openai.com/v1", "o3", other_key)]


@pytest.mark.parametrize("kind", ["open to all", "a link", "a file"])
def test_a_folder_that_others_could_have_made_is_refused(kind, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    folder = tmp_path / f"merge-runner-{os.getuid()}"
    if kind == "open to all":
        folder.mkdir()
        folder.chmod(0o777)
    elif kind == "a link":
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        folder.symlink_to(tmp_path / "elsewhere")
    else:
        folder.write_text("")
    with pytest.raises(UsageError, match="XDG_RUNTIME_DIR"):
        limits_file("https://api.openai.com/v1", "o3", KEY)


def test_a_file_that_cannot_be_made_is_told_in_one_line(tmp_path):
    (tmp_path / "key").symlink_to("elsewhere")
    with pytest.raises(UsageError, match="XDG_RUNTIME_DIR"):
        SharedLimits(tmp_path / "key", rpm=60)
    assert not (tmp_path / "elsewhere").exists()


def test_without_the_folder_that_the_system_names_the_one_for_temporary_files_is_used(
    tmp_path, monkeypatch
):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "gone"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert limits_file("https://api.openai.com/v1", "o3", KEY).parent.parent == tmp_path
