"""A program of another revision is another driver, and none changes its rule without one."""

import hashlib
from dataclasses import replace

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.errors import UsageError
from merge_runner.plugin import PROGRAMS, Program
from merge_runner.results.store import query
from merge_runner.run.plan import make_plan
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from tests.support.braking import deciding
from tests.support.driven_trials import both, play
from tests.support.harness import FAST, PROJECT

DRIVEN = PROJECT / "tests/golden/driven.csv"
SPECS = PROJECT / "tests/golden/reference-spec-hashes.csv"
STUDY = """
models = ["braking"]
repetitions = 1
conditions = ["L_4_0", "N_0_0"]
[plugins]
files = ["mine.py"]
"""


def driven(program):
    """A hash of how a program drives against itself in the conditions of the humans."""
    told = hashlib.sha256()
    scenario = ScenarioConfig(step_s=0.05, plan_step_s=0.2, resistance="human")
    for condition in HUMAN_CONDITIONS:
        trial = play(both(program), condition, scenario=scenario, seeds={"left": 1, "right": 2})
        for row in trial.states:
            told.update(f"{row.side} {row.position_m:.6f} {row.velocity_mps:.6f}\n".encode())
    return told.hexdigest()[:16]


def test_no_program_drives_otherwise_without_another_revision():
    """Where one does, raise ``revision`` in its class, and write what is found into the file."""
    found = [
        f"{name},{program.revision},{driven(program)}"
        for name, program in sorted(PROGRAMS.items())
        if program.data is None  # who replays humans needs their trials
    ]
    assert found == DRIVEN.read_text().splitlines()[1:]


def test_the_spec_hashes_of_the_reference_drivers_are_the_committed_ones():
    """They change with a revision alone: say in the commit why it does."""
    specs = make_plan("reference", repetitions=1).trial_specs()
    found = sorted({f"{one.model_left},{one.spec_hash}" for one in specs})
    assert found == SPECS.read_text().splitlines()[1:]


@pytest.mark.parametrize("revision", [0, -1, "2", 1.5])
def test_a_revision_is_a_whole_number(revision):
    mine = type("Mine", (), {"revision": revision})
    with pytest.raises(UsageError, match="the revision of the driver Mine is a whole number"):
        Program(mine, "drives")


def test_a_driver_decides_in_an_async_method():
    mine = type("Mine", (), {"decide": lambda self, observation, number: None})
    with pytest.raises(UsageError, match="the driver Mine needs `async def decide"):
        Program(mine, "drives")


def test_the_class_names_its_revision_and_the_spec_has_it():
    constant = PROGRAMS["constant"]
    revised = type("Revised", (constant.driver,), {"revision": 2})
    specs = [replace(constant, driver=one).in_spec("c") for one in (constant.driver, revised)]
    assert [spec["revision"] for spec in specs] == [1, 2]


@pytest.mark.parametrize(
    ("model", "trial"), [("braking", "braking"), ("emulator+braking", "emulator+braking")]
)
async def test_an_edited_program_is_refused_until_its_revision_is_raised(
    merge_runner, tmp_path, model, trial
):
    (tmp_path / "study.toml").write_text(STUDY.replace("braking", model))

    async def sweep(revision, action, *more):
        plugin = deciding(f"return self.context.held({action})", within=f"revision = {revision}")
        (tmp_path / "mine.py").write_text(plugin)
        return await merge_runner(
            "sweep", "study.toml", "--db", "study.duckdb", "--trust", *more, *FAST
        )

    assert (await sweep(1, -0.1, "--conditions", "L_4_0")).code == 0
    edited = await sweep(1, -0.2)
    assert edited.code == 2
    assert f"braking drives otherwise than in the trial {trial}/baseline/L_4_0/rep01" in edited.err
    assert "give its class another `revision`" in edited.err
    for revision, action, trials in ((1, -0.1, 2), (2, -0.2, 4)):
        assert (await sweep(revision, action)).code == 0
        assert query(tmp_path / "study.duckdb", "SELECT count(*) FROM trials")[1] == [(trials,)]
