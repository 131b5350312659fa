"""One study of every kind of trial, played once in a run of the tests and copied.

It holds the shipped recordings of the emulator and of smollm2, three programs, imported humans, a
trial that failed and one whose words are hostile, and a crossed study with a plug-in of its own.
"""

import fcntl
import shutil
from pathlib import Path

import pytest

from merge_runner.results.store import Store
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from tests.support import crossed_study, program
from tests.support.harness import FAST, PROJECT, environment
from tests.support.hostile import hostile_trial
from tests.support.recordings import drive, write_folder
from tests.support.studies import Drive, Said, played

PROGRAMS = ("idm", "quantal", "projected-order")
REPETITIONS = 2  # of the emulator, smollm2 and each program, in the 11 conditions
PAIRS, RUNS = 3, 33  # of the imported humans: each condition once a pair


def make(folder: Path) -> Path:
    """Make the study in an empty folder; gives its database."""
    db = folder / "golden.duckdb"

    def run(*arguments: object) -> None:
        done = program.invoke(arguments, cwd=folder, env=environment(EMULATOR_BASE_URL=""))
        if done.code:
            raise RuntimeError(f"{arguments}: {done.out}{done.err}")

    for model in ("emulator", "smollm2"):
        recording = PROJECT / f"cache/recordings/{model}-baseline.parquet"
        which = ("--model", model, "--reps", REPETITIONS, "--recording", recording)
        run("replay", "baseline", *which, "--db", db)
    for name in PROGRAMS:
        run("sweep", "baseline", "--model", name, "--reps", REPETITIONS, "--db", db)
    crossed_study.write(folder)
    run("sweep", "mine.toml", "--yes", "--trust", "--db", db, *FAST)
    run("human", "import", _humans(folder / "humans"), "--db", db)
    lost = Drive("o4", "baseline", "L_4_0", 1, (0.4,), (-0.4,), {2: Said(("timeout",), lost=True)})
    Store(db).write("hostile", [hostile_trial(), played(lost)], patience_s=5)
    return db


def _humans(folder: Path) -> Path:
    """Recordings of pairs of whom who is behind, or slower where level, mostly yields."""
    files = {}
    conditions = list(HUMAN_CONDITIONS.items())
    for number in range(RUNS):
        name, condition = conditions[number % len(conditions)]
        ahead = condition.projected_headway_m or -condition.relative_velocity_mps
        left = number % 2 == 0 if ahead == 0 else (ahead > 0) != (number % 13 == 0)
        recorded = drive(name, yields="right" if left else "left", starts_m=number % 4)
        pair, trial = number % PAIRS + 1, number // PAIRS + 1
        files[f"experiment_{pair}/experiment_{pair}_iter_{trial}.csv"] = recorded.csv()
    return write_folder(folder, files)


@pytest.fixture(scope="session")
def golden(shared, tmp_path_factory) -> Path:
    """The folder of the golden study, to be read only: ``golden.duckdb`` and what made it."""
    made = shared / "golden"
    with (shared / "golden.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.exists():
            unfinished = tmp_path_factory.mktemp("unfinished")
            make(unfinished)
            unfinished.rename(made)
    # A copy for this process: DuckDB lets no two open a file of which one may write.
    return shutil.copytree(made, tmp_path_factory.mktemp("golden") / "study")


@pytest.fixture
def golden_copy(golden, tmp_path) -> Path:
    """A folder with the golden study, to be changed."""
    return shutil.copytree(golden, tmp_path / "golden")
