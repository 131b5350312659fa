"""Two different drivers: which is the ego, and what of their trials it takes for its own.

The trials are real ones of programs: ``brakes`` and ``goes`` keep to one action each, so that a
trial and the one with the sides changed are mirror images to the last bit.
"""

from __future__ import annotations

import json

import duckdb
import pytest

from merge_runner.config import ego_side
from merge_runner_analysis.data.load import load, load_trials
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.explain import explain
from merge_runner_analysis.stats.indicators import fits
from merge_runner_analysis.stats.regressions import who_first_logit
from merge_runner_analysis.tables import make_tables
from tests.support.studies import write_study, yielding

DRIVERS = """
from merge_runner.drivers.registry import PROGRAMS, Program

class Held:
    def __init__(self, seat):
        self.seat = seat
    async def decide(self, observation, number):
        return self.seat.held(self.action)

class Brakes(Held):
    action = -0.2

class Goes(Held):
    action = 0.2

class Follows(Held):
    action = -0.1

for name, driver in (("brakes", Brakes), ("goes", Goes), ("follows", Follows)):
    PROGRAMS.register(name, Program(driver, name))
"""
STUDY = """
models = ["goes"]
repetitions = 1
{head}
[factors]
opponent = ["brakes", "follows"]
[plugins]
files = ["drivers.py"]
"""


@pytest.fixture
def played(in_process, tmp_path):
    """Plays the study, with these lines at its head, into a database of its own."""
    (tmp_path / "drivers.py").write_text(DRIVERS)

    def play(head, name):
        (tmp_path / f"{name}.toml").write_text(STUDY.format(head=head))
        assert (
            in_process("sweep", f"{name}.toml", "--yes", "--trust", "--db", f"{name}.duckdb") == 0
        )
        return Study(tmp_path / f"{name}.duckdb")

    return play


def pooled(study):
    """The trials as their egos see them, without what says where they sat."""
    rows = [
        row
        for group in study.models
        for row in group.trials.drop(columns=["trial_id", "spec_hash", "ego"])
        .sort_values("condition")
        .astype(str)
        .to_numpy()
        .tolist()
    ]
    return [(group.id, group.levels) for group in study.models], rows


def values(study, *names):
    """What tables say, without their notes; the order of trials may change the last digits."""
    return [
        [(row.id, {name: rounded(value) for name, value in row.values.items()})]
        for table in make_tables(study, names)
        for row in table.rows
    ]


def rounded(value):
    if isinstance(value, tuple):
        return tuple(map(rounded, value))
    return round(value, 6) if isinstance(value, float) else value


@pytest.mark.slow
def test_a_study_and_its_mirror_image_give_the_same_rows(played, tmp_path):
    """One way round, the other way round, and both at once, where equal trials count once."""
    both = played("mirror = true", "both")
    one_way, other_way = (part(both.db, tmp_path, side) for side in ("left", "right"))
    assert len(load("FROM trials", both.db)) == 44
    assert pooled(one_way) == pooled(other_way)
    tables = ("who-first", "gap", "ablation-quantitative", "criticality")
    assert values(one_way, *tables) == values(other_way, *tables) == values(both, *tables)
    assert [(group.id, group.seats, group.repeated) for group in both.models] == [
        ("goes+brakes/baseline", (11, 11), 11),
        ("goes+follows/baseline", (11, 11), 11),
    ]
    assert [group.levels["model"] for group in both.models] == ["goes", "goes"]


def part(db, folder, side):
    """The study of those trials whose ego sat on a side."""
    copy = folder / f"{side}.duckdb"
    copy.write_bytes(db.read_bytes())
    with duckdb.connect(str(copy)) as connection:
        connection.execute(
            "CREATE TEMP TABLE other AS SELECT trial_id FROM trial_drivers WHERE ego <> ?", [side]
        )
        for table in ("trials", "states", "decisions", "trial_factors", "sweep_trials"):
            connection.execute(f"DELETE FROM {table} WHERE trial_id IN (FROM other)")
    return Study(copy)


@pytest.mark.slow
def test_who_goes_first_is_told_of_the_ego_on_either_side(played):
    study = played("mirror = true", "both")
    trials = load_trials(study.db)
    finished = trials[trials["status"] == "finished"]
    assert set(finished["ego"]) == {"left", "right"}
    assert set(finished["merged_first"]) == {"left"}, "who brakes is never first"
    assert set(finished["model_left"]) == {"goes"}
    (group,) = (group for group in study.models if group.driver == "goes+brakes")
    assert fits(group).logit.problem.startswith("who merged first is the same in all")
    (table,) = make_tables(study, ["who-first"])
    (note,) = (note for note in table.notes if note.startswith("of two different drivers left"))
    assert (
        f"{group.id}: goes sat on the left in 11 trials, and on the right in 11, mirrored" in note
    )


@pytest.mark.slow
def test_mirrored_trials_stand_in_the_condition_that_their_ego_saw(played):
    study = played("mirror = true\nconditions = ['L_4_-8']", "both")
    seen = load_trials(study.db).set_index("trial_id")
    stored = load("FROM trials", study.db).set_index("trial_id")
    there = "brakes+goes/baseline/L_4_-8/rep01"
    assert stored.loc[there, "condition"] == "L_4_-8"
    assert seen.loc[there, "condition"] == "R_-4_8"
    numbers = seen.loc[there, ["projected_headway_m", "relative_velocity_mps"]]
    assert numbers.tolist() == [-4.0, 0.8]


@pytest.mark.slow
def test_a_condition_that_has_no_mirror_image_is_named_after_itself(played):
    own = (
        "{{name = '{}', projected_headway_m = {}, relative_velocity_mps = 0, mean_speed_mps = 15}}"
    )
    studies = {
        name: played(f"mirror = true\nconditions = [{', '.join(conditions)}]", name)
        for name, conditions in {
            "alone": [own.format("fast", 4)],
            "both": [own.format("fast", 4), own.format("tsaf", -4)],
        }.items()
    }
    assert set(load_trials(studies["alone"].db)["condition"]) == {"fast", "fast mirrored"}
    assert set(load_trials(studies["both"].db)["condition"]) == {"fast", "tsaf"}


@pytest.mark.slow
def test_the_trials_behind_a_cell_are_found_in_the_database(played):
    study = played("mirror = true", "both")
    (table,) = make_tables(study, ["gap"])
    row = next(row for row in table.rows if row.id == "goes+brakes/baseline/intercept")
    (source,) = explain(study, table, f"{row.id}:n").sources
    assert len(source.trials) == row.values["n"]
    assert load(source.query, study.db)["trial_id"].tolist() == list(source.trials)


@pytest.mark.slow
def test_a_pair_that_sits_one_way_alone_is_told_as_confounded(played):
    one_way, both = played("", "one"), played("mirror = true", "both")
    (table,) = make_tables(one_way, ["gap"])
    says = "goes sat on the left in 11 trials, and on the right in 0: what is its doing cannot"
    assert any(says in note and "`mirror = true`" in note for note in table.notes)
    assert "in 0: what" not in str(make_tables(both, ["gap"]))


@pytest.mark.parametrize("ego", ["left", "right"])
def test_a_planted_cue_has_its_sign_on_whichever_side_the_ego_sits(tmp_path, ego):
    """The left vehicle of ``yielding`` goes first where it is ahead; it is a model's either way."""
    db = write_study(tmp_path / "t.duckdb", yielding("o3", reps=5))
    expected = who_first_logit(load_trials(db)).terms
    body = {"endpoint": "openai", "body": {"model": "o3"}}
    sides = {"left": body, "right": {"program": "p"}}
    if ego == "right":
        sides = {"left": sides["right"], "right": body}
    with duckdb.connect(str(db)) as connection:
        connection.execute(
            "UPDATE trials SET model_left = ?, model_right = ?",
            ["o3", "aaa"] if ego == "left" else ["aaa", "o3"],
        )
        connection.execute("UPDATE specs SET spec = ?", [json.dumps(sides)])
    (group,) = Study(db).models
    assert (group.driver, group.models) == ("o3+aaa", ("o3", "aaa"))
    found = fits(group).logit.terms
    assert found["projected_headway"].b == pytest.approx(expected["projected_headway"].b)
    sign = 1 if ego == "left" else -1
    assert found["intercept"].b == pytest.approx(sign * expected["intercept"].b)


@pytest.mark.parametrize(
    ("left", "right", "asking", "opponent", "ego"),
    [
        ("o3", "o3", ["o3"], "self", "left"),
        ("constant", "constant", [], None, "left"),
        ("o3", "constant", ["o3"], None, "left"),
        ("constant", "o3", ["o3"], None, "right"),
        ("constant", "o3", ["o3"], "o3", "left"),
        ("o3", "constant", ["o3"], "constant", "left"),
        ("o3", "gpt", ["o3", "gpt"], None, "right"),
        ("gpt", "o3", ["o3", "gpt"], None, "left"),
        ("gpt", "o3", ["o3", "gpt"], "gpt", "right"),
        ("cei", "idm", [], None, "left"),
        ("cei", "idm", [], "cei", "right"),
    ],
)
def test_the_program_and_the_database_agree_on_the_ego(
    tmp_path, left, right, asking, opponent, ego
):
    assert ego_side({"left": left, "right": right}, asking, opponent or "self") == ego
    db = write_study(tmp_path / "t.duckdb", yielding("o3", reps=1)[:1])
    spec = {
        side: {"endpoint": "openai", "body": {}} if name in asking else {"program": name}
        for side, name in (("left", left), ("right", right))
    }
    with duckdb.connect(str(db)) as connection:
        connection.execute("UPDATE trials SET model_left = ?, model_right = ?", [left, right])
        connection.execute("UPDATE specs SET spec = ?", [json.dumps(spec)])
        if opponent:
            connection.execute(
                "INSERT INTO trial_factors SELECT trial_id, spec_hash, 'opponent', ? FROM trials",
                [opponent],
            )
        found = connection.execute("SELECT ego, driver FROM trial_drivers").fetchall()
    pair = {"left": (left, right), "right": (right, left)}[ego]
    assert found == [(ego, "+".join(dict.fromkeys(pair)))]
