"""A sweep that stops by itself at a time."""

from __future__ import annotations

import asyncio
import time
from datetime import UTC, datetime, timedelta

import pytest

from merge_runner.errors import UsageError
from merge_runner.run.plan import Options, make_plan
from merge_runner.run.sweep import INTERRUPTED, Sweep
from merge_runner.run.until import deadline
from tests.gate import Gate
from tests.harness import FAST, watched

pytestmark = pytest.mark.long


@pytest.fixture(autouse=True)
def amsterdam(monkeypatch):
    monkeypatch.setenv("TZ", "Europe/Amsterdam")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.mark.parametrize(
    ("text", "now", "found"),
    [
        ("07:00", "2026-11-22T23:30+01:00", "2026-11-23T07:00+01:00"),
        ("07:00", "2026-11-22T06:59+01:00", "2026-11-22T07:00+01:00"),
        ("07:00", "2026-11-22T07:00+01:00", "2026-11-23T07:00+01:00"),
        ("07:00:30", "2026-11-22T06:00+00:00", "2026-11-22T07:00:30+01:00"),
        ("2027-01-31T07:00", "2026-11-22T07:00+01:00", "2027-01-31T07:00+01:00"),
        ("2026-11-22T07:00+09:00", "2026-11-21T20:00+00:00", "2026-11-21T22:00+00:00"),
        # The clocks are turned back, and forward, in the night.
        ("07:00", "2026-10-24T23:00+02:00", "2026-10-25T07:00+01:00"),
        ("07:00", "2027-03-27T23:00+01:00", "2027-03-28T07:00+02:00"),
    ],
)
def test_a_time_of_day_is_the_next_one_by_local_clocks(text, now, found):
    assert deadline(text, datetime.fromisoformat(now)) == datetime.fromisoformat(found)


@pytest.mark.parametrize("text", ["7", "25:00", "soon", "", "2026-11-22T06:00", "07:00 pm"])
def test_what_is_no_time_to_come_is_refused_with_an_example(text):
    with pytest.raises(UsageError, match=r"--until .*07:00"):
        deadline(text, datetime.fromisoformat("2026-11-22T07:00+01:00"))


def in_s(seconds):
    return (datetime.now(UTC) + timedelta(seconds=seconds)).isoformat()


@pytest.mark.parametrize("where", [(), ("--dask", "local:2")], ids=["here", "on a cluster"])
async def test_at_its_time_a_sweep_begins_no_trial_and_the_same_command_goes_on(
    merge_runner, where
):
    async def middle(request, handler):
        if started.done() and not stopped:
            await asyncio.sleep(0.2)
        elif not started.done():
            started.set_result(None)
        return await handler(request)

    started = asyncio.get_running_loop().create_future()
    stopped = []
    sweep = ("sweep", "baseline", "--reps", 3, "--json", "--in-flight", 2, *FAST)
    async with watched(middle) as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        run = await merge_runner(*sweep, *where, "--until", in_s(12), **env)
        assert run.code == INTERRUPTED, run.err
        assert "Stopped as --until says" in run.err
        assert ", until " in run.err
        finished = run.summary["trials"]
        ended = finished["finished"] + finished["collided"]
        assert ended < 33
        assert "Stopping:" not in run.err, "what had begun was finished"
        asked = server.requests
        stopped.append(True)  # nothing slows the rest down
        done = await merge_runner(*sweep, **env)
        assert done.code == 0, done.err
        assert done.summary["trials"]["stored_before"] == ended
        assert max(server.asked.values()) == 1
        assert done.summary["calls"]["live"] == server.requests - asked


class Clock:
    """The time, and as much later as a test says."""

    perf_counter = staticmethod(time.perf_counter)
    ahead_s = 0.0

    def time(self):
        return time.time() + self.ahead_s


async def test_what_does_not_end_in_a_while_is_stopped_as_by_ctrl_c(tmp_path, monkeypatch):
    gate, clock, said = Gate(passing=2), Clock(), []

    def say(line):
        said.append(line)
        if "Stopping:" in line:
            gate.open()

    monkeypatch.setattr("merge_runner.run.sweep.GRACE_S", 0.3)
    monkeypatch.setattr("merge_runner.run.sweep.time", clock)
    async with watched(gate.middle) as server:
        monkeypatch.setenv("EMULATOR_BASE_URL", f"{server.url}/v1")
        plan = make_plan("baseline", "emulator", repetitions=1, conditions=["N_0_0", "L_4_0"])
        until = datetime.now().astimezone() + timedelta(days=1)
        options = Options(tmp_path / "m.duckdb", tmp_path / "c", until=until)
        sweep = asyncio.create_task(Sweep(plan, options, say=say).run())
        await gate.quiet(tmp_path / "c", trials=2)
        clock.ahead_s = 86_400
        outcome = await sweep
        assert outcome.exit_code == INTERRUPTED
        assert "2 trials have not ended" in outcome.messages[0]
        assert "Stopping:" in said[-1]
        again = await Sweep(plan, Options(tmp_path / "m.duckdb", tmp_path / "c"), say=print).run()
    assert again.exit_code == 0
    assert again.meter.calls_cached > 0
    assert max(server.asked.values()) == 1
