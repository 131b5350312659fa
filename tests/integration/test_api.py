"""A study run from Python: its results as data frames, and what is refused."""

import math
import os
import subprocess
import sys

import pandas as pd
import pytest

from merge_runner import Study
from merge_runner.drivers.constant import ConstantDriver
from merge_runner.errors import UsageError
from merge_runner.prompts.blocks import VARIANTS, Variant
from merge_runner.results.store import results_digest
from merge_runner.scenarios.merge.conditions import CONDITIONS, Condition
from merge_runner_analysis import table
from merge_runner_analysis.metrics import METRICS, Metric
from tests.support.harness import CONFIGURING, a_model, watched
from tests.support.mock_server import BatchPlan, FaultPlan
from tests.support.priced import PRICE

STUDY = """
models = ["emulator"]
repetitions = 1
conditions = ["L_4_0", "N_0_0"]
[factors]
temperature = [0.2, 1.0]
opponent = ["self", "constant"]
memory_s = [1.0, 2.0]
"""


@pytest.fixture
def folder(tmp_path, monkeypatch, emulator_url):
    """A folder with a study, in which Python runs, beside an emulator."""
    for name in [name for name in os.environ if name.endswith(CONFIGURING)]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("EMULATOR_BASE_URL", emulator_url)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "study.toml").write_text(STUDY)
    (tmp_path / "models.toml").write_text(a_model("dear", price=PRICE))
    return tmp_path


async def test_trials_have_a_typed_column_for_each_factor_and_their_measures(folder):
    outcome = await Study("study.toml", only={"memory_s": 2.0}).arun()
    assert (outcome.ok, outcome.messages) == (True, [])
    trials = outcome.trials()
    assert dict(trials.groupby("temperature").size()) == {0.2: 4, 1.0: 4}
    assert trials["temperature"].dtype == "float64"
    assert all(pd.api.types.is_string_dtype(trials[name]) for name in ("opponent", "error"))
    assert trials["gap_m"].notna().any()
    assert trials["error"].isna().all()
    assert set(outcome.decisions()["trial_id"]) == set(trials["trial_id"])
    assert set(outcome.calls()["outcome"]) == {"ok"}
    assert set(outcome.states()["side"]) == {"left", "right"}
    assert outcome.sql("select count(*) as n from trials")["n"].tolist() == [8]
    assert outcome.facts["trials"]["planned"] == 8
    assert "left first" in repr(outcome)


async def test_an_outcome_holds_the_trials_of_its_own_sweep_which_a_replay_gives_again(folder):
    """A factor of numbers and other levels is of texts."""
    (folder / "study.toml").write_text(STUDY.replace("[0.2, 1.0]", '["default", 1]'))
    wanted = {"only": {"opponent": "constant", "memory_s": 1.0}, "conditions": ["N_0_0"]}
    study = Study("study.toml", **wanted)
    first = await study.arun()
    assert set(first.trials()["temperature"]) == {"default", "1"}
    replayed = await Study("study.toml", **wanted, db="again.duckdb").areplay()
    assert replayed.ok
    assert replayed.facts["calls"]["live"] == 0
    assert results_digest(replayed.db) == results_digest(study.db)
    other = Study("baseline", models="constant", repetitions=1, conditions=["L_4_0"])
    second = await other.arun()
    again = await study.arun()
    assert [len(outcome.trials()) for outcome in (first, second, again)] == [2, 1, 2]
    assert again.facts["trials"]["stored_before"] == 2


async def test_first_situations_are_asked_alone_in_the_conditions_or_on_a_grid(folder):
    wanted = {"temperature": 0.2, "memory_s": 2.0, "opponent": "self"}
    outcome = await Study("study.toml", only=wanted).arun(first=True)
    assert set(outcome.trials()["source"]) == {"first_decision"}
    assert sum(look["asked"] for look in outcome.facts["first_looks"]) == 4
    gridded = await Study("study.toml", only=wanted).arun(first=True, grid="h=2,dv=0:0.8:0.4")
    assert set(gridded.trials()["relative_velocity_mps"]) == {0.0, 0.4, 0.8}
    with pytest.raises(UsageError, match="a grid takes the place of the conditions"):
        await Study("study.toml", conditions=["N_0_0"]).arun(first=True, grid="usual")


async def test_a_running_loop_is_told_what_to_await(folder):
    for call, awaited in (("run", "arun"), ("replay", "areplay"), ("dry_run", "adry_run")):
        with pytest.raises(UsageError, match=rf"await study\.{awaited}\("):
            getattr(Study("study.toml"), call)()


async def test_money_is_spent_only_with_leave(folder):
    only = {"opponent": "self", "memory_s": 2.0, "temperature": 0.2}
    study = Study("study.toml", models="dear", only=only)
    with pytest.raises(UsageError, match=r"spends money; yes=True goes ahead: .*trials  2 "):
        await study.arun()
    expected = await study.adry_run()
    assert expected.trials == 2
    assert (await study.arun(yes=True)).facts["cost_usd"] > 0


async def test_a_study_is_asked_in_batches_for_half_the_price(folder, monkeypatch):
    only = {"opponent": "self", "memory_s": 2.0, "temperature": 0.2}
    wanted = {"models": "dear", "only": only, "conditions": ["N_0_0"]}
    async with watched(faults=FaultPlan(batch=BatchPlan(delay_s=0.01))) as server:
        monkeypatch.setenv("EMULATOR_BASE_URL", f"{server.url}/v1")
        whole = await Study("study.toml", **wanted).arun(yes=True)
        elsewhere = {"db": "batched.duckdb", "cache": "batched"}
        half = await Study("study.toml", **wanted, **elsewhere).arun(yes=True, batch=True)
    assert half.facts["cost_usd"] == pytest.approx(whole.facts["cost_usd"] / 2)
    assert half.calls()["batch_id"].notna().all()


@pytest.mark.parametrize(
    "number",
    [*({"max_cost_usd": usd} for usd in (math.nan, math.inf, -1.0)), {"in_flight": 0}, {"rpm": 0}],
)
async def test_a_number_that_no_run_can_use_is_refused(folder, number):
    ((name, _),) = number.items()
    with pytest.raises(UsageError, match=rf"{name}\b.* is a .*number.* from [01], not "):
        await Study("study.toml").arun(**number)


async def test_trials_that_failed_are_in_the_outcome(folder):
    only = {"memory_s": 1.0, "opponent": "constant"}
    outcome = await Study("study.toml", cache="none", only=only).areplay()
    assert (outcome.ok, outcome.exit_code) == (False, 4)
    assert f"error: {outcome.messages[0]}" in repr(outcome)


async def test_objects_are_registered_and_a_cell_that_runs_again_replaces_them(folder):
    study = Study("study.toml", models="steady", prompts=["short"], conditions=["X_0_15"])
    (folder / "study.toml").write_text("repetitions = 1")
    for headway_m in (0.0, 1.0):
        study.register_driver("steady", ConstantDriver, "keeps its speed")
        study.register(VARIANTS, "short", Variant(frozenset({"C1", "C2"})))
        study.register(CONDITIONS, "X_0_15", Condition(headway_m, 1.5))
    stops = Metric(name="stops", label="stops", unit="", meaning="m", value="end_time_s")
    study.register(METRICS, stops.name, stops)
    trials = (await study.arun()).trials()
    assert trials[["model_left", "variant", "projected_headway_m"]].values.tolist() == [
        ["steady", "short", 1.0]
    ]
    assert "stops" in table(study.db, "ablation-quantitative")
    with pytest.raises(UsageError, match="there is a driver 'constant' already"):
        study.register_driver("constant", ConstantDriver, "keeps it")


def test_an_import_is_cheap():
    heavy = "{'pandas', 'duckdb', 'pydantic', 'asyncio'} & {*sys.modules}"
    code = f"import sys, merge_runner; print({heavy} or 'cheap')"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "cheap"
