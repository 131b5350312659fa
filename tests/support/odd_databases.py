"""Odd databases of every kind."""

import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from merge_runner_analysis.published import PAIRS, published
from tests.support import program
from tests.support.harness import PROJECT, environment
from tests.support.studies import Drive, as_humans, write_study, yielding

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


def separated(db: Path) -> None:
    """A driver that goes first wherever it is ahead, so that the logit has no finite estimate."""
    write_study(db, yielding("o3", reps=4), asked=OWN)


def all_tied(db: Path) -> None:
    """Every other trial of each condition collides."""
    drives = yielding("o3", reps=4)
    write_study(db, [d if d.rep % 2 else replace(d, left=(), right=()) for d in drives], asked=OWN)


def two_studies(db: Path) -> None:
    """A sweep of the paper and a study with factors, of one model, in one database."""
    _run(db, "sweep", "baseline", "--reps", "3")
    _study(db, STUDY)


def crossed_programs(db: Path) -> None:
    """Programs that draw by chance, each with two prompts."""
    _study(db, CROSSED)


def mirrored_chance(db: Path) -> None:
    """A pair in which one draws by chance and the other does not, both ways round."""
    _run(db, "sweep", "baseline", "--model", "human-odds+constant", "--mirror", "--reps", "10")


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
        separated, all_tied, two_studies, crossed_programs, mirrored_chance, complete_import,
    )
}  # fmt: skip


def made(folder: Path, kind: str) -> Path:
    """The database of a kind, or of the shipped recording of a model, in a folder of its own."""
    db = folder / kind / "merge.duckdb"
    db.parent.mkdir(parents=True)
    if kind in KINDS:
        KINDS[kind](db)
    else:
        recording = PROJECT / f"cache/recordings/{kind}-baseline.parquet"
        _run(db, "replay", "baseline", "--model", kind, "--recording", recording)
    return db


def _study(db: Path, text: str) -> None:
    db.with_name("study.toml").write_text(text)
    _run(db, "sweep", "study.toml")


def _run(db: Path, *arguments: object) -> None:
    own = ("--db", db.name, "--cache", "cache")
    env = environment(EMULATOR_BASE_URL="")
    done = program.invoke((*arguments, *own), cwd=db.parent, env=env)
    assert done.code == 0, done.err
