"""Thousands of trials of a program that decides 20 times a second: in bounded memory and time."""

import json
import subprocess
import sys

from tests.support.harness import environment

STUDY = """
models = ["idm"]
repetitions = 100
[scenario]
step_s = 0.05
plan_step_s = 0.2
"""
# The program, which writes into a file what it took.
MEASURED = """
import json, runpy

def tell():
    with open("/proc/self/status") as status:
        (peak_kb,) = (line.split()[1] for line in status if line.startswith("VmHWM"))
    with open("used.json", "w") as file:
        json.dump({"peak_mb": int(peak_kb) / 1024}, file)

try:
    runpy.run_module("merge_runner", run_name="__main__", alter_sys=True)
finally:
    tell()
"""


def test_a_sweep_of_them_takes_less_than_400_mb(tmp_path):
    (tmp_path / "study.toml").write_text(STUDY)
    done = subprocess.run(
        [sys.executable, "-c", MEASURED, "sweep", "study.toml"],
        cwd=tmp_path, env=environment(), capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "used.json").read_text())["peak_mb"] < 400
