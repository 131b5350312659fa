"""Studies that run side by side in one process: each with its own words, conditions and drivers."""

import asyncio
import os
import signal
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import duckdb
import pytest

from merge_runner import Study
from merge_runner.drivers.constant import ConstantDriver
from merge_runner.drivers.language_model import LlmDriver
from merge_runner.errors import UsageError
from merge_runner.prompts.blocks import VARIANTS, Variant
from merge_runner.registry import NO_STUDY, in_use
from merge_runner.run.stored_replay import audit_database
from merge_runner.scenarios.merge.conditions import CONDITIONS, Condition
from tests.support.braking import deciding
from tests.support.harness import CONFIGURING

WORDS = {"a": "You are late.", "b": "You have time."}
HEADWAYS_M = {"a": 3.0, "b": -3.0}
BRAKING = {"a": -0.1, "b": -0.3}
STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
STUDY = """
models = ["emulator", "mine"]
repetitions = 1
conditions = [{{ name = "X", projected_headway_m = {headway_m}, relative_velocity_mps = 0 }}]
[factors]
prompt = ["hurry"]
[prompts.hurry]
add = [{{ after = "C3.human", text = "{words}" }}]
[plugins]
files = ["plugin.py", "gains.py"]
"""
OF_ITS_FOLDER = "from .gains import ACTION\nreturn self.context.held(ACTION)"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Two folders with a study each, which give the same names to other things."""
    for name in [name for name in os.environ if name.endswith(CONFIGURING)]:
        monkeypatch.delenv(name)
    monkeypatch.chdir(tmp_path)
    for name, words in WORDS.items():
        (tmp_path / name).mkdir()
        text = STUDY.format(words=words, headway_m=HEADWAYS_M[name])
        (tmp_path / name / "study.toml").write_text(text)
        (tmp_path / name / "plugin.py").write_text(deciding(OF_ITS_FOLDER, "mine"))
        (tmp_path / name / "gains.py").write_text(f"ACTION = {BRAKING[name]}\n")
    return tmp_path


def study(name):
    return Study(f"{name}/study.toml", trust=True)


def check(name, outcome):
    """All that a study stored is its own."""
    assert (outcome.exit_code, outcome.messages) == (0, [])
    prompts = outcome.sql("select prompt from decisions where prompt is not null")["prompt"]
    assert len(prompts) > 10
    assert all(WORDS[name] in prompt for prompt in prompts)
    assert set(outcome.trials()["projected_headway_m"]) == {HEADWAYS_M[name]}
    driven = outcome.sql("select distinct applied[1] as action from decisions where prompt is null")
    assert driven["action"].tolist() == [BRAKING[name]]
    assert len(outcome.sql("from specs")) == 2
    assert [audit.findings for audit in audit_database(outcome.db)] == [[], []]
    assert in_use() is NO_STUDY
    assert ("X" in CONDITIONS, "hurry" in VARIANTS) == (False, False)


@dataclass
class Meanwhile:
    """Calls something at each tenth decision of language models."""

    call: object
    count: int = 0

    def patch(self, monkeypatch):
        ask = LlmDriver.ask

        def counted(driver, observation, number):
            self.count += 1
            if self.count % 10 == 1:
                self.call()
            return ask(driver, observation, number)

        monkeypatch.setattr(LlmDriver, "ask", counted)


async def test_a_cell_that_runs_again_changes_nothing_of_its_study_that_runs(folder, monkeypatch):
    wanted = {"models": "emulator", "prompts": ["own"], "conditions": ["X"], "repetitions": 1}
    mine = Study("baseline", db="own.duckdb", **wanted)

    def register(removed, headway_m):
        mine.register(VARIANTS, "own", Variant(frozenset({removed})))
        mine.register(CONDITIONS, "X", Condition(headway_m, 0.0))

    register("C1", 2.0)
    Meanwhile(lambda: register("C0", -2.0)).patch(monkeypatch)
    outcome = await mine.arun()
    assert outcome.ok, outcome.messages
    assert all("History of" not in text for text in outcome.decisions()["prompt"])
    assert all("Road type" in text for text in outcome.decisions()["prompt"])
    assert set(outcome.trials()["projected_headway_m"]) <= {2.0}


async def test_two_studies_run_in_one_event_loop(folder):
    outcomes = await asyncio.gather(*(study(name).arun() for name in WORDS))
    for name, outcome in zip(WORDS, outcomes, strict=True):
        check(name, outcome)


async def test_two_studies_that_share_a_cache_never_ask_one_model_at_once(folder):
    small = {"models": "emulator", "repetitions": 1, "conditions": ["N_0_0"]}
    runs = (Study("baseline", **small, db=f"{name}.db").arun() for name in "ab")
    first, second = await asyncio.gather(*runs, return_exceptions=True)
    assert first.ok
    assert isinstance(second, UsageError)
    assert "asks scripted-driver at" in str(second)
    assert "name another folder with --cache" in str(second)


def test_what_is_registered_for_a_study_is_unknown_to_others_and_to_the_process(folder):
    mine = Study("baseline", db="mine.duckdb")
    mine.register(VARIANTS, "own", Variant(frozenset({"C1"})))
    mine.register_driver("steady", ConstantDriver, "keeps its speed")
    assert "own" not in VARIANTS
    with pytest.raises(UsageError, match="unknown variant 'own'"):
        Study("baseline", prompts=["own"], repetitions=1).plan()
    with pytest.raises(UsageError, match="there is a variant 'A1' already"):
        mine.register(VARIANTS, "A1", Variant())


async def test_two_studies_run_in_two_threads_while_both_are_planned(folder, monkeypatch):
    Meanwhile(lambda: [study(name).plan() for name in WORDS]).patch(monkeypatch)
    loop = asyncio.get_running_loop()
    with ThreadPoolExecutor(2) as threads:
        runs = [loop.run_in_executor(threads, study(name).run) for name in WORDS]
        for name, outcome in zip(WORDS, await asyncio.gather(*runs), strict=True):
            check(name, outcome)


def test_the_handlers_of_signals_are_those_of_the_host_during_a_run_and_after_it(folder):
    ours = {number: signal.getsignal(number) for number in STOPPING}
    theirs = {number: lambda *_: None for number in STOPPING[1:]}
    for number, handler in theirs.items():
        signal.signal(number, handler)
    seen = []
    run = Study("baseline", models="constant", conditions=["N_0_0"], db="x.duckdb")
    try:
        with pytest.MonkeyPatch.context() as patch:
            drive = ConstantDriver.decide

            async def decide(driver, observation, number):
                seen.append({each: signal.getsignal(each) for each in theirs})
                return await drive(driver, observation, number)

            patch.setattr(ConstantDriver, "decide", decide)
            assert run.run().ok
        seen.append({each: signal.getsignal(each) for each in theirs})
    finally:
        for number, handler in ours.items():
            signal.signal(number, handler)
    assert all(each == theirs for each in seen)


@pytest.mark.parametrize("how", ["event", "cancel"])
async def test_a_run_that_is_stopped_saves_what_is_answered(folder, monkeypatch, how):
    event = asyncio.Event()
    wanted = {"models": "emulator", "repetitions": 10, "conditions": ["N_0_0", "L_4_0"]}
    run = asyncio.create_task(Study("baseline", **wanted).arun(stop=event, in_flight=2))
    tenths = Meanwhile(
        lambda: tenths.count > 40 and (event.set if how == "event" else run.cancel)()
    )
    tenths.patch(monkeypatch)
    if how == "event":
        assert (await run).exit_code == 130
    else:
        with pytest.raises(asyncio.CancelledError):
            await run
    with duckdb.connect(str(folder / "results/merge.duckdb"), read_only=True) as connection:
        (code,) = connection.execute("SELECT exit_code FROM sweeps").fetchone()
        (ended,) = connection.execute("SELECT count(*) FROM trials").fetchone()
    assert code == 130
    assert 0 < ended < 20
    again = await Study("baseline", **wanted | {"repetitions": 1}, db="again.duckdb").areplay()
    assert again.facts["calls"]["cached"] > 10
