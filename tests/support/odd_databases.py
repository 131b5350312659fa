"""Odd databases of every kind, each with its report and its pages, to be looked at.

``python tests/support/odd_databases.py DIR`` makes them all; test_odd_databases.py reads what
they say.
"""

from __future__ import annotations

import argparse
import atexit
import os
import random
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from merge_runner.config import ScenarioConfig
from merge_runner.results.database import open_database
from merge_runner.results.store import Store
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.data.reference_data import PAIRS, published
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.explorer.export import export_folder
from merge_runner_analysis.human.archive import open_files
from merge_runner_analysis.human.load import import_trials, sort_files
from merge_runner_analysis.report.page import write_report
from tests.support.recordings import drive, write_folder
from tests.support.studies import Drive, Said, as_humans, write_study, yielding

RECORDINGS = Path(__file__).parents[2] / "cache/recordings"
# A study of its own drivers and factors, of a model that another sweep drives too.
STUDY = """
models = ["emulator"]
repetitions = 3
conditions = ["N_0_0", "L_0_-8", "R_0_8", "L_4_8"]
[factors]
prompt = ["baseline", "hurry"]
opponent = ["self", "projected-order"]
[prompts.hurry]
add = [{ after = "C3.human", text = "You are late, and in a hurry." }]
"""
OWN = {"endpoint": "openai", "body": {"model": "o3", "messages": [], "reasoning_effort": "medium"}}
# Programs that draw, crossed with prompts that they do not read.
CROSSED = """
models = ["human-odds", "idm"]
repetitions = 4
[factors]
prompt = ["baseline", "A1"]
"""
IMPORTED = 129
BASELINE = ("sweep", "baseline")
UNLIMITED = ("--rpm", "100000", "--tpm", "1000000000")


def two_trials(db: Path) -> None:
    """Two trials of one condition each."""
    write_study(db, yielding("o3", reps=1)[:2], asked=OWN)


def stand_in_behind_o3(db: Path) -> None:
    """The emulator at OPENAI_BASE_URL, asked for o3."""
    url = {"OPENAI_BASE_URL": f"{_emulator()}/v1", "OPENAI_API_KEY": "no-key"}
    _run(db, *BASELINE, "--model", "o3", "--reps", "2", "--yes", *UNLIMITED, **url)


def another_endpoint(db: Path) -> None:
    """A model that was asked at a gateway."""
    asked = OWN | {"endpoint": "http://localhost:8080/v1"}
    write_study(db, yielding("o3", reps=3), asked=asked)


def partial_import(db: Path) -> None:
    """A driver beside 129 human trials of five pairs."""
    write_study(db, yielding("o3", reps=5), asked=OWN)
    files = {}
    for number in range(IMPORTED):
        experiment = (4, 5, 6, 8, 9)[number % 5]
        played, condition = list(CONDITIONS.items())[number // 5 % len(CONDITIONS)]
        ahead = condition.projected_headway_m - condition.relative_velocity_mps
        yields = "right" if ahead > 0 or (ahead == 0 and number % 2) else "left"
        name = f"experiment_{experiment}/experiment_{experiment}_iter_{number + 1}.csv"
        files[name] = drive(played, yields=yields).csv()
    with open_files(write_folder(db.parent / "recordings", files)) as found:
        import_trials(sort_files(found), Store(db))


def other_vehicle_length(db: Path) -> None:
    """Vehicles of 8 m."""
    write_study(db, yielding("o3", reps=3), ScenarioConfig(vehicle_length_m=8.0), asked=OWN)


def temperature(db: Path) -> None:
    """A model that was sent a temperature of 0.2."""
    body = {"model": "gpt", "messages": [], "temperature": 0.2, "max_tokens": 4000}
    write_study(db, yielding("gpt", reps=3), asked={"endpoint": "openai", "body": body})


def programs(db: Path) -> None:
    """Drivers that are programs, each with repetitions, and one against the emulator."""
    for model in ("projected-order", "constant", "emulator+constant"):
        _run(db, *BASELINE, "--model", model, "--reps", "2")


def only_failed(db: Path) -> None:
    """Every trial failed for want of an answer."""
    drives = yielding("o3", reps=1)
    write_study(
        db, [replace(d, said={1: Said(("timeout",), lost=True)}) for d in drives], asked=OWN
    )


def killed(db: Path) -> None:
    """A sweep that was killed: two trials, and no end."""
    write_study(db, yielding("o3", reps=1)[5:7], asked=OWN)
    with open_database(db, read_only=False, patience_s=5) as connection:
        connection.execute("UPDATE sweeps SET ended_at = NULL, exit_code = NULL")


def word_for_word(db: Path) -> None:
    """A model that goes the same way each time."""
    once = [drive for drive in yielding("o3", reps=2) if drive.rep == 1]
    drives = [replace(drive, rep=rep, said={}) for drive in once for rep in (1, 2, 3)]
    write_study(db, drives, asked=OWN)


def two_studies(db: Path) -> None:
    """A sweep of the paper and a study with factors, of one model, in one database."""
    _run(db, *BASELINE, "--reps", "3")
    db.with_name("study.toml").write_text(STUDY)
    _run(db, "sweep", "study.toml")


def crossed_programs(db: Path) -> None:
    """Programs that draw by chance, each with two prompts."""
    db.with_name("study.toml").write_text(CROSSED)
    _run(db, "sweep", "study.toml")


def mirrored_chance(db: Path) -> None:
    """A pair in which one draws by chance and the other does not, both ways round."""
    _run(db, *BASELINE, "--model", "human-odds+constant", "--mirror", "--reps", "10")


def no_valid_reply(db: Path) -> None:
    """A language model of whose replies none was valid."""
    replayed(db, "smollm2-free")


def separated(db: Path) -> None:
    """A driver that goes first wherever it is ahead, so that the logit has no finite estimate."""
    write_study(db, yielding("o3", reps=4), asked=OWN)


def all_tied(db: Path) -> None:
    """Every other trial of each condition collides."""
    drives = [
        drive if drive.rep % 2 else replace(drive, left=(), right=())
        for drive in yielding("o3", reps=4)
    ]
    write_study(db, drives, asked=OWN)


def complete_import(db: Path) -> None:
    """A driver beside all 990 human trials: published outcomes, and pairs who differ."""
    chance = random.Random(4)
    pairs = [(pair, chance.gauss(0, 1), chance.gauss(0, 0.1)) for pair in PAIRS.values()]
    drives = yielding("o3", reps=5)
    for row in published("human_outcomes").itertuples():
        trials = [
            (bold + chance.gauss(0, 1), 0.4 + close + chance.gauss(0, 0.1), pair, rep)
            for pair, bold, close in pairs
            for rep in range(1, 11)
        ]
        # Bold pairs go first on the left.
        for place, (_, strength, pair, rep) in enumerate(sorted(trials, reverse=True)):
            strong = min(max(strength, 0.25), 1.0)
            faster, slower = (strong,) * 3, (-strong,) * 3
            ways = {True: (faster, slower), False: (slower, faster)}
            crash = place >= row.left_first + row.right_first
            left, right = ((), ()) if crash else ways[place < row.left_first]
            drives.append(Drive("human", pair, row.condition, rep, left, right))
    write_study(db, drives, asked=OWN)
    as_humans(db)


KINDS: dict[str, Callable[[Path], None]] = {
    make.__name__: make
    for make in (
        two_trials,
        stand_in_behind_o3,
        another_endpoint,
        partial_import,
        complete_import,
        other_vehicle_length,
        temperature,
        programs,
        only_failed,
        killed,
        word_for_word,
        two_studies,
        crossed_programs,
        mirrored_chance,
        no_valid_reply,
        separated,
        all_tied,
    )
}


def made(folder: Path, kind: str) -> Path:
    """The database of a kind, in a folder of its own."""
    db = folder / kind / "merge.duckdb"
    db.parent.mkdir(parents=True)
    KINDS[kind](db)
    return db


def replayed(db: Path, model: str) -> None:
    """Replay the shipped recording of a model."""
    recording = str(RECORDINGS / f"{model}-baseline.parquet")
    _run(db, "replay", "baseline", "--model", model, "--recording", recording)


def _emulator() -> str:
    """The URL of an emulator, which ends with this process."""
    process = subprocess.Popen(
        [sys.executable, "-m", "merge_runner", "emulate", "--port", "0"],
        stdout=subprocess.PIPE,
        text=True,
    )
    atexit.register(process.terminate)
    assert process.stdout is not None
    return process.stdout.readline().strip()


def _run(db: Path, *arguments: str, **environment: str) -> None:
    subprocess.run(
        [sys.executable, "-m", "merge_runner", *arguments, "--db", db.name, "--cache", "cache"],
        cwd=db.parent,
        env={**os.environ, **environment},
        check=True,
        capture_output=True,
    )


def main() -> None:
    """Make the kinds that are named after the folder, else all, and say what they are."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("kinds", nargs="*", help=f"of {', '.join(KINDS)}; all if none is named")
    asked = parser.parse_args()
    for kind in asked.kinds or KINDS:
        db = made(asked.folder, kind)
        for _ in write_report(Study(db), db.with_name("report.html"), db.with_name("files")):
            pass
        export_folder(db, db.with_name("pages"))
        sys.stdout.write(f"{db.parent}: {KINDS[kind].__doc__}\n")


if __name__ == "__main__":
    main()
