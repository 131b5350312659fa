"""Imported human trials that are driven again: what they were, to the last digit."""

import json
import shutil
from pathlib import Path

import duckdb
import pytest

from merge_runner.drivers.human_replay import HUMAN_REPLAY, SAMPLE_S, ImportedHumans
from merge_runner.errors import UsageError
from merge_runner.records import SIDES
from merge_runner.results.store import Store, query
from merge_runner.run.plan import make_plan
from merge_runner.run.spec import spec_text
from merge_runner.run.stored_replay import audit_database
from merge_runner_analysis.humans.load import import_trials, sort_files
from tests.support.driven_trials import driven_by
from tests.support.recordings import drive, file
from tests.support.serving import client_of

HUMAN = '\nrepetitions = 1\nconditions = ["L_4_0"]\n[scenario]\nresistance = "human"\n'
FILES = {
    "experiment_4_iter_1.csv": drive("L_4_0"),
    "experiment_4_iter_2.csv": drive("L_4_0", yields="nobody"),
    "experiment_5_iter_1.csv": drive("L_4_0", yields="left"),
    "experiment_5_iter_2.csv": drive("R_-4_0", yields="left"),
}


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    """A database with four human trials, one of which collided."""
    path = tmp_path_factory.mktemp("humans") / "merge.duckdb"
    download = sort_files(file(name, trial.csv()) for name, trial in FILES.items())
    assert import_trials(download, Store(path)).added == 4
    return path


@pytest.fixture
def db(tmp_path, imported):
    (tmp_path / "results").mkdir()
    return Path(shutil.copy(imported, tmp_path / "results"))


@pytest.fixture
def plan_of(tmp_path, db):
    def plan(models, text=HUMAN, db=db, **asked):
        (tmp_path / "mine.toml").write_text(text)
        return make_plan(str(tmp_path / "mine.toml"), models, db=db, **asked)

    return plan


def humans_of(plan):
    return plan.parts.programs[HUMAN_REPLAY].data


def recorded(db, trial_id):
    """Positions and speeds of a human trial by time and side, from the start of control on."""
    sql = f"SELECT time_s, side, position_m, velocity_mps FROM states WHERE trial_id = '{trial_id}'"
    return {(t, side): each for t, side, *each in query(db, f"{sql} AND step >= 0")[1]}


def driven(trial, sides=SIDES):
    rows = [row for row in trial.states if row.side in sides]
    return {(row.time_s, row.side): [row.position_m, row.velocity_mps] for row in rows}


# A human who is told a wrong own speed keeps its trace, too.
BLURRED = '[factors]\nperception = ["b"]\n[perception.b]\nspeed_sd_mps = 0.5\nown = true\n'
TEXTS = {"human": HUMAN, "none": HUMAN.replace('"human"', '"none"'), "blurred": HUMAN + BLURRED}


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_two_replayed_sides_of_a_trial_are_the_trial(db, plan_of, text):
    trial = driven_by(plan_of(HUMAN_REPLAY, text))
    wanted, found = recorded(db, "human/pair1/L_4_0/iter001"), driven(trial)
    assert found.keys() == wanted.keys()
    assert all(found[at] == pytest.approx(wanted[at], abs=1e-6) for at in wanted)
    assert (trial.status, trial.merged_first) == ("finished", "left")


@pytest.mark.parametrize("side", SIDES)
def test_a_replayed_human_keeps_its_trace_beside_a_free_driver(db, plan_of, side):
    pair = f"{HUMAN_REPLAY}+idm" if side == "left" else f"idm+{HUMAN_REPLAY}"
    trial = driven_by(plan_of(pair))
    wanted, found = recorded(db, "human/pair1/L_4_0/iter001"), driven(trial, (side,))
    shared = wanted.keys() & found.keys()
    assert len(shared) > 100
    assert all(found[at] == pytest.approx(wanted[at], abs=1e-6) for at in shared)
    # The free one starts where that human's partner did.
    other = next(each for each in SIDES if each != side)
    assert driven(trial, (other,))[0, other] == wanted[0, other]


def test_the_pairs_take_turns_and_a_trial_that_collided_is_left_out(db, plan_of):
    plan = plan_of(HUMAN_REPLAY, repetitions=2)
    second = driven_by(plan, 1)
    wanted = recorded(db, "human/pair2/L_4_0/iter001")
    assert driven(second)[0.0, "left"] == wanted[0.0, "left"]
    assert second.merged_first == "right"
    with pytest.raises(UsageError, match="has 2 trials of L_4_0 to replay, and 3 repetitions"):
        plan_of(HUMAN_REPLAY, repetitions=3)


def test_a_human_keeps_its_speed_once_its_trace_has_ended(plan_of):
    text = HUMAN + '[drivers.weak]\nprogram = "idm"\ndesired_speed_factor = 0.5\n'
    plan = plan_of("weak+human-replay", text)
    trial = driven_by(plan)
    traced = humans_of(plan).trials[0].speeds_mps["right"]
    after = [row for row in trial.states if row.side == "right"][len(traced) :]
    assert len(after) > 20
    assert {round(row.velocity_mps, 6) for row in after} == {round(traced[-1], 6)}


def test_another_database_that_is_read_meanwhile_changes_no_trial_of_a_plan(plan_of, tmp_path):
    plan, other = plan_of(HUMAN_REPLAY), tmp_path / "other.duckdb"
    hashes, wanted = plan.specs().keys(), driven_by(plan)
    with pytest.raises(UsageError, match=r"holds none: merge-runner human import PATH"):
        plan_of(HUMAN_REPLAY, db=other)
    trials = sort_files([file("experiment_6_iter_1.csv", drive("L_4_0", yields="left").csv())])
    import_trials(trials, Store(other))
    second = plan_of(HUMAN_REPLAY, db=other)
    assert driven_by(plan).states == wanted.states != driven_by(second).states
    assert plan.specs().keys() == hashes != second.specs().keys()


def test_a_study_names_the_pair(db, plan_of):
    text = HUMAN + '[drivers.second]\nprogram = "human-replay"\npair = "pair2"\n'
    plan = plan_of("second", text)
    assert driven_by(plan).merged_first == "right"
    assert json.loads(spec_text(plan, plan.arms[0], "L_4_0"))["left"]["based_on"] == HUMAN_REPLAY
    unknown = "unknown pair of human-replay 'pair7'; valid: all, pair1, pair2"
    for changed, said in (
        (text.replace("pair2", "pair7"), unknown),
        (text + "clock = 1.0\n", "takes no clock"),
        (text + "[factors]\nstep_s = [0.025]\n", "needs a world of step_s = 0.05"),
    ):
        with pytest.raises(UsageError, match=said):
            plan_of("second", changed)


def test_a_trial_that_was_imported_in_two_ways_is_replayed_once(db, plan_of):
    once = humans_of(plan_of(HUMAN_REPLAY)).trials
    with duckdb.connect(str(db)) as connection:
        for table in ("trials", "states"):
            connection.execute(
                f"INSERT INTO {table} SELECT * REPLACE ('another' AS spec_hash) FROM {table}"
            )
    assert humans_of(plan_of(HUMAN_REPLAY)).trials == once


@pytest.mark.parametrize(("late_samples", "is_replayed"), [(0.4, True), (0.6, False)])
def test_a_trial_of_another_clock_than_the_recorders_is_left_out(
    db, plan_of, late_samples, is_replayed
):
    before = humans_of(plan_of(HUMAN_REPLAY)).trials
    with duckdb.connect(str(db)) as connection:
        connection.execute(
            "UPDATE states SET time_s = time_s + $1 WHERE trial_id = $2 "
            "AND step = (SELECT max(step) FROM states WHERE trial_id = $2)",
            [late_samples * SAMPLE_S, "human/pair1/L_4_0/iter001"],
        )
    after = humans_of(plan_of(HUMAN_REPLAY)).trials
    assert len(before) - len(after) == (not is_replayed)


def test_what_a_vehicle_cannot_do_is_not_replayed(db, plan_of):
    plan = plan_of(HUMAN_REPLAY)
    humans, config = humans_of(plan), plan.arms[0].scenario
    weak = config.model_copy(update={"max_acceleration_mps2": 1.0})
    assert humans.usable(config, "L_4_0", "all")
    assert not humans.usable(weak, "L_4_0", "all")
    (first, *others) = humans.trials
    assert ImportedHumans((first._replace(pair="pair9"), *others)).digest != humans.digest


async def test_a_sweep_of_them_is_stored_audited_and_shown_with_a_caution(
    merge_runner, tmp_path, db
):
    (tmp_path / "mine.toml").write_text(HUMAN)
    command = ("mine.toml", "--model", "human-replay+idm", "--json")
    assert (await merge_runner("sweep", *command)).summary["exit_code"] == 0
    cluster = await merge_runner("sweep", *command, "--dask", "local:2")
    told = "error: human-replay reads the database of this machine: leave --dask out\n"
    assert (cluster.code, cluster.err) == (2, told)
    (first, *_) = audit_database(db)
    assert not first.findings
    assert not [note for note in first.notes if "not replayed" in note]
    said = "the human on the left is replayed and does not react"
    tables = await merge_runner("tables", "ablation-quantitative")
    assert f"human-replay+idm: {said}" in " ".join(tables.out.split())
    explored = client_of(db)
    assert explored.get("/trials").text.count(said) == 1, "of five trials one"
    assert f",{said}," in explored.get("/trials.csv").text
    page = explored.get("/trials/human-replay+idm/baseline/L_4_0/rep01").text
    assert f"Note: {said}." in page
    assert "baseline: no prompt, since only programs drive." in page
    looked = (await merge_runner("sweep", *command, "--first")).summary["first_looks"]
    assert {look["model"] for look in looked} == {"human-replay", "idm"}
    # A replay needs the same import, and says so.
    assert (await merge_runner("replay", *command)).summary["trials"]["failed"] == 0
    elsewhere = await merge_runner("replay", *command, "--db", "none.duckdb")
    assert (elsewhere.code, "merge-runner human import PATH" in elsewhere.err) == (2, True)
    with duckdb.connect(str(db)) as connection:
        connection.execute("DELETE FROM trials WHERE source = 'human'")
    notes = [note for sweep in audit_database(db) for note in sweep.notes]
    assert any("other data: left.data" in note for note in notes)
