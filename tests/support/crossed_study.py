"""A study of several models, with an opponent, a condition and a metric of its own."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.support.harness import FAST, Run

STUDY = """
models = ["cheap", "dear"]
repetitions = 2
conditions = ["N_0_0", "L_4_0",
    {name = "X_0_15", projected_headway_m = 0, relative_velocity_mps = 1.5, mean_speed_mps = 11}]
skip = [{model = "dear", opponent = "sleepy"}]
[factors]
temperature = [1.0, 0.2]
opponent = ["self", "sleepy"]
[prompts.taxi]
add = [{text = "You are a taxi driver in a hurry."}]
title = "Taxi driver"
[plugins]
files = ["mine.py"]
"""
PLUGIN = """
from merge_runner_analysis.metrics import Metric, register
from merge_runner.plugin import PROGRAMS, Program

class Sleepy:
    def __init__(self, context):
        self.context = context
    async def decide(self, observation, number):
        return self.context.held(-0.1)

PROGRAMS.register("sleepy", Program(Sleepy, "brakes a little, always"))
register(Metric(name="duration_s", label="duration", unit="s", meaning="time to the end",
                value="end_time_s"))
"""
MODEL = """
[{name}]
provider = "emulator"
format = "openai-chat"
id = "scripted-driver"
max_output_tokens = 4000
price = {{ input = {price}, output = {price}, source = "mine" }}
"""


@dataclass(frozen=True)
class Mine:
    """The study's folder, what its sweep printed, and commands on its database."""

    folder: Path
    db: Path
    out: str
    run: Callable[..., Run]


def write(folder: Path) -> None:
    """Write the files of the study."""
    (folder / "mine.toml").write_text(STUDY)
    (folder / "mine.py").write_text(PLUGIN)
    models = [MODEL.format(name=name, price=price) for name, price in (("cheap", 1), ("dear", 9))]
    (folder / "models.toml").write_text("".join(models))


def play(folder: Path, prepare: Callable[..., Run]) -> Mine:
    """Write the study and play it."""
    write(folder)
    ran = prepare(folder, "sweep", "mine.toml", "--yes", "--trust", "--db", "t.duckdb", *FAST)
    assert ran.code == 0, ran.err

    def run(*arguments: object, db: str = "t.duckdb") -> Run:
        return prepare(folder, *arguments, "--db", db)

    return Mine(folder, folder / "t.duckdb", ran.out, run)
