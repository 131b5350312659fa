"""The numbers of cei that the docs give are what its trials come to."""

import re
import subprocess
import sys

import pytest

from tests.support.harness import PROJECT, environment


@pytest.mark.parametrize(
    ("column", "command"), [(3, ["K0"]), (4, ["F1"]), (5, ["drag-free"]), (6, ["K0", "--tunnel"])]
)
def test_what_the_driver_cei_comes_to(column, command):
    program = [sys.executable, "-m", "merge_runner_cei.calibration", "check", *command]
    out = subprocess.check_output(program, cwd=PROJECT, env=environment(), text=True)
    # Each line ends with the mean, its spread, the tolerance and by how many of these it is off.
    found = [tuple(map(float, line.split()[-4:-2])) for line in out.splitlines()[1:]]
    text = (PROJECT / "docs/reference/cei.md").read_text("utf-8").replace("\N{MINUS SIGN}", "-")
    rows = re.findall(r"^\| (?:collisions|time-outs|who|gap|largest|conflict|first).*", text, re.M)
    cells = [re.split(r"(?<!\\)\|", row)[column].replace("*", "") for row in rows]
    shown = [tuple(map(float, re.findall(r"-?\d+(?:\.\d+)?", cell))) for cell in cells]
    # Counts are shown with one decimal of two.
    assert shown[:2] == [pytest.approx(pair, abs=0.051) for pair in found[:2]]
    assert shown[2:] == found[2:]
