"""A driver of a script or a notebook: an edit of what it rests on is another driver."""

from __future__ import annotations

import subprocess
import sys

from tests.harness import environment

SCRIPT = """
from dataclasses import dataclass
import math
import numpy as np
from numpy import exp
from merge_runner.drivers.base import Seat
from merge_runner.drivers.registry import Program

GAIN = {"near": 0.1}
ARRAY = np.zeros(2)
seat = ARRAY  # the name of an attribute alone

def braking(distance_m):
    return -GAIN["near"] * exp(-distance_m) * math.pi

@dataclass
class Mine:
    seat: Seat

    async def decide(self, observation, number):
        for _ in range(2):
            pass
        return self.seat.held(braking(observation.relative_distance_m))

_ = ARRAY
print(Program(Mine, "brakes").source)
"""

PLANNED = """
from merge_runner.drivers.registry import PROGRAMS
from merge_runner.run.plan import make_plan

PROGRAMS.register("mine", Program(Mine, "brakes"))
print(make_plan("baseline", "mine+constant").config()["main"]["mine"]["braking"])
"""


def source(folder, *changes: tuple[str, str]):
    text = SCRIPT + PLANNED
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "mine.py").write_text(text)
    return subprocess.run(
        [sys.executable, "mine.py"],
        cwd=folder,
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
    )


def test_an_edit_of_the_class_or_of_what_it_uses_is_another_driver_and_no_other_edit_is(tmp_path):
    first = source(tmp_path).stdout
    digest, *braking = first.splitlines()
    assert len(digest) == 64
    assert braking[:2] == [
        "def braking(distance_m):",
        '    return -GAIN["near"] * exp(-distance_m) * math.pi',
    ]
    assert source(tmp_path, ('"brakes"', '"brakes a bit"'), ("_ = ARRAY", "_ = 1")).stdout == first
    others = {
        source(tmp_path, ('"near": 0.1', '"near": 0.2')).stdout,
        source(tmp_path, (" exp(-", " exp(+")).stdout,
        source(tmp_path, ("range(2)", "range(3)")).stdout,
        source(tmp_path, ("@dataclass", "@dataclass(slots=True)")).stdout,
    }
    assert len(others) == 4
    assert not {first, ""} & others


def test_what_cannot_be_told_apart_is_refused(tmp_path):
    said = source(tmp_path, ('GAIN["near"]', "ARRAY[0]")).stderr
    assert "Mine rests on ARRAY, a ndarray whose changes cannot be told" in said
