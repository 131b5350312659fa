"""A study as large as a real one: 35 groups, 2,000 trials, long names, three factors, humans.

``python -m tests.support.rich_study FOLDER`` makes it with the program itself, without a key:
the emulator with all prompts, an o3 that a faulty server on this machine answers, a small model
that gives no plan, programs, a crossed study and human recordings. It takes about two minutes.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from tests.support.harness import FAST, PROGRAM, PROJECT, environment
from tests.support.mock_server import FaultPlan, served
from tests.support.recordings import drive, write_folder

GROUPS = 35
LONG = "meta-llama/Llama-3.3-70B-Instruct-Turbo"
OPPONENT = "waits-for-the-other"
# One answer in a hundred has no array of actions, and one in twenty comes at the second attempt.
FAULTS = FaultPlan(rates={"malformed": 0.01, "empty": 0.004, "server_error": 0.05})
PROGRAMS = ("cei", "human-odds", "idm", "quantal", "constant")
HUMAN_RUNS = 129
CROSSED = f"""
description = "Does a driver in a hurry go first, and a polite one last?"
models = ["emulator", "{LONG}"]
repetitions = 3
[factors]
prompt = ["baseline", "hurry", "polite"]
temperature = [0.2, 1.0]
opponent = ["self", "{OPPONENT}"]
[[skip]]
model = "emulator"
opponent = "{OPPONENT}"
[prompts.hurry]
title = "In a hurry"
add = [{{ after = "C3.human", text = "You are late for an appointment, and in a hurry." }}]
[prompts.polite]
title = "Polite"
add = [{{ after = "C3.human", text = "You are a polite driver, and let others go first." }}]
[drivers.{OPPONENT}]
program = "idm"
headway_s = 3.0
"""
MODELS = f"""
["{LONG}"]
provider = "emulator"
format = "openai-chat"
id = "{LONG}"
max_output_tokens = 4000
price = {{ input = 0.9, output = 0.9, source = "a price of the tests" }}
"""


def make(folder: Path) -> Path:
    """Play the study in a new folder; gives its database."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "hurry.toml").write_text(CROSSED, encoding="utf-8")
    (folder / "models.toml").write_text(MODELS, encoding="utf-8")
    db = folder / "study.duckdb"
    places = ("--db", db, "--cache", folder / "replies")
    for program in PROGRAMS:
        _run(folder, "sweep", "baseline", "--model", program, *places)
    for model, reps in (("smollm2", 2), ("smollm2-free", 1)):
        recording = PROJECT / f"cache/recordings/{model}-baseline.parquet"
        which = ("--model", model, "--reps", reps, "--recording", recording)
        _run(folder, "replay", "baseline", *which, *places)
    with served(FAULTS) as url:
        of_o3 = ("sweep", "baseline", "--model", "o3", "--reps", 15, "--yes", *FAST)
        _run(folder, *of_o3, *places, OPENAI_API_KEY="x", OPENAI_BASE_URL=f"{url}/v1")
    _run(folder, "sweep", "hurry.toml", "--yes", "--trust", *places)
    _run(folder, "human", "import", _humans(folder / "humans"), "--db", db)
    # The last run is the one of which the first page says how it goes on.
    _run(folder, "sweep", "ablations", *places)
    return db


def _run(folder: Path, *arguments: object, **changes: str) -> None:
    """Run the program; what it says is shown where it fails."""
    command = [str(PROGRAM), *map(str, arguments)]
    done = subprocess.run(
        command,
        check=False,
        cwd=folder,
        env=environment(**changes),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}: {done.returncode}\n{done.stdout}{done.stderr}")


def _humans(folder: Path) -> Path:
    """Recordings of nine pairs, of whom who is behind, or slower where level, mostly yields."""
    runs = {}
    for number in range(HUMAN_RUNS):
        name, condition = list(HUMAN_CONDITIONS.items())[number % 11]
        pair, run = number % 9 + 1, number // 9 + 1
        ahead = condition.projected_headway_m or -condition.relative_velocity_mps
        left = number % 2 == 0 if ahead == 0 else (ahead > 0) != (number % 13 == 0)
        recorded = drive(
            name,
            yields="right" if left else "left",
            slowest_mps=8.35 + 0.1 * (pair - 5) + 0.12 * (number * 7 % 9 - 4),
            starts_m=number % 4,
        )
        runs[f"experiment_{pair}/experiment_{pair}_iter_{run}.csv"] = recorded.csv()
    return write_folder(folder, runs)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    sys.stdout.write(f"{make(parser.parse_args().folder)}\n")
