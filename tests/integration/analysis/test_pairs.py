"""Two different drivers: which is the ego, and what of their trials it takes for its own.

The trials are real ones of programs: ``brakes`` and ``goes`` keep to one action each, so that a
trial and the one with the sides changed are mirror images to the last bit.
"""

import json

import duckdb
import pytest

from merge_runner.driver_names import ego_side
from merge_runner_analysis.frames import load, load_trials
from merge_runner_analysis.stats.indicators import fits
from merge_runner_analysis.stats.regressions import who_first_logit
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables import make_tables
from tests.support.cases import table
from tests.support.studies import changed, write_study, yielding
from tests.support.tables import made, notes_with

DRIVERS = """
from merge_runner.plugin import PROGRAMS, Program

class Held:
    def __init__(self, context):
        self.context = context
    async def decide(self, observation, number):
        return self.context.held(self.action)

for name, action in (("brakes", -0.2), ("goes", 0.2), ("follows", -0.1)):
    PROGRAMS.register(name, Program(type(name, (Held,), {"action": action}), name))
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
MIRROR = "mirror = true"
OWN = "{{name = '{}', projected_headway_m = {}, relative_velocity_mps = 0, mean_speed_mps = 15}}"


@pytest.fixture(scope="module")
def play(prepare, tmp_path_factory):
    """Plays the study, with these lines at its head, into a database of its own."""
    folder = tmp_path_factory.mktemp("pairs")
    (folder / "drivers.py").write_text(DRIVERS)

    def play(head, name):
        (folder / f"{name}.toml").write_text(STUDY.format(head=head))
        sweep = ("sweep", f"{name}.toml", "--yes", "--trust", "--db", f"{name}.duckdb")
        assert prepare(folder, *sweep).code == 0
        return StudyResults(folder / f"{name}.duckdb")

    return play


@pytest.fixture(scope="module")
def both(play):
    return play(MIRROR, "both")


def pooled(study):
    """The trials as their egos see them, without what says where they sat."""
    columns = ["drive", "way", "trial_id", "spec_hash", "ego"]
    return [
        (group.id, group.levels, group.trials.drop(columns=columns)
         .sort_values("condition").astype(str).to_numpy().tolist())
        for group in study.models
    ]  # fmt: skip


def values(study):
    """What tables say, without their notes; the order of trials may change the last digits."""
    tables = make_tables(study, ("who-first", "gap", "ablation-quantitative", "criticality"))
    return {
        (table.name, row.id, name): rounded(value)
        for table in tables
        for row in table.rows
        for name, value in row.values.items()
    }


def rounded(value):
    if isinstance(value, tuple):
        return tuple(map(rounded, value))
    return round(value, 6) if isinstance(value, float) else value


def part(db, folder, side):
    """The study of those trials whose ego sat on a side."""
    copy = folder / f"{side}.duckdb"
    copy.write_bytes(db.read_bytes())
    return changed(
        copy,
        f"CREATE TEMP TABLE other AS SELECT trial_id FROM trial_drivers WHERE ego <> '{side}'",
        *(
            f"DELETE FROM {table} WHERE trial_id IN (FROM other)"
            for table in ("trials", "states", "decisions", "trial_factors", "sweep_trials")
        ),
    )


def test_a_study_and_its_mirror_image_give_the_same_rows(both, tmp_path):
    """One way round, the other way round, and both at once, where equal trials count once."""
    one_way, other_way = (part(both.db, tmp_path, side) for side in ("left", "right"))
    assert len(load("FROM trials", both.db)) == 44
    assert pooled(one_way) == pooled(other_way)
    assert values(one_way) == values(other_way) == values(both)
    assert [(g.id, g.ego_sides, g.repeated, g.levels["model"]) for g in both.models] == [
        ("goes+brakes/baseline", (11, 11), 11, "goes"),
        ("goes+follows/baseline", (11, 11), 11, "goes"),
    ]
    # One way alone is confounded.
    says = "goes drove on the left in 11 trials, and on the right in 0: driver and side cannot"
    (note,) = notes_with(made(one_way, "gap"), says)
    assert "`mirror = true`" in note
    assert not notes_with(made(both, "gap"), "in 0: what")


def test_who_goes_first_is_told_of_the_ego_on_either_side(both):
    trials = load_trials(both.db)
    finished = trials[trials["status"] == "finished"]
    assert set(finished["ego"]) == {"left", "right"}
    assert set(finished["merged_first"]) == {"left"}, "who brakes is never first"
    assert set(finished["model_left"]) == {"goes"}
    (group,) = (group for group in both.models if group.driver == "goes+brakes")
    assert str(fits(group).logit.problem).startswith("who merged first is the same in all")
    (note,) = notes_with(made(both, "who-first"), "where two different drivers meet")
    says = f"{group.id}: goes drove on the left in 11 trials, and on the right in 11, mirrored"
    assert says in note


def test_mirrored_trials_stand_in_the_condition_that_their_ego_saw(both):
    seen = load_trials(both.db).set_index("trial_id")
    stored = load("FROM trials", both.db).set_index("trial_id")
    there = "brakes+goes/baseline/L_4_-8/rep01"
    assert (stored.loc[there, "condition"], seen.loc[there, "condition"]) == ("L_4_-8", "R_-4_8")
    numbers = seen.loc[there, ["projected_headway_m", "relative_velocity_mps"]]
    assert numbers.tolist() == [-4.0, 0.8]


def test_a_condition_that_has_no_mirror_image_is_named_after_itself(play):
    conditions = [OWN.format(*at) for at in (("alone", 2), ("fast", 4), ("tsaf", -4))]
    study = play(f"{MIRROR}\nconditions = [{', '.join(conditions)}]", "own")
    seen = {*load_trials(study.db)["condition"]}
    assert seen == {"alone", "alone mirrored", "fast", "tsaf"}


def test_a_planted_cue_has_its_sign_on_whichever_side_the_ego_sits(tmp_path):
    """The left vehicle of ``yielding`` goes first where it is ahead; it is a model's either way."""
    db = write_study(tmp_path / "t.duckdb", yielding("o3", reps=5))
    expected = who_first_logit(load_trials(db)).terms
    body, program = {"endpoint": "openai", "body": {"model": "o3"}}, {"program": "p"}
    for ego, other, sign in (("left", "right", 1), ("right", "left", -1)):
        study = changed(
            db,
            f"UPDATE trials SET model_{ego} = 'o3', model_{other} = 'aaa'",
            f"UPDATE specs SET spec = '{json.dumps({ego: body, other: program})}'",
        )
        (group,) = study.models
        assert (group.driver, group.models) == ("o3+aaa", ("o3", "aaa"))
        found = fits(group).logit.terms
        assert found["projected_headway"].b == pytest.approx(expected["projected_headway"].b)
        assert found["intercept"].b == pytest.approx(sign * expected["intercept"].b)


def test_the_program_and_the_database_agree_on_the_ego(tmp_path):
    db = write_study(tmp_path / "t.duckdb", yielding("o3", reps=1)[:1])
    for left, right, asking, opponent, ego in table("pairs", "egos"):
        assert ego_side({"left": left, "right": right}, asking, opponent) == ego
        spec = {
            side: {"endpoint": "openai", "body": {}} if name in asking else {"program": name}
            for side, name in (("left", left), ("right", right))
        }
        with duckdb.connect(str(db)) as connection:
            connection.execute("UPDATE trials SET model_left = ?, model_right = ?", [left, right])
            connection.execute("UPDATE specs SET spec = ?", [json.dumps(spec)])
            connection.execute("DELETE FROM trial_factors")
            connection.execute(
                "INSERT INTO trial_factors SELECT trial_id, spec_hash, 'opponent', level, false "
                "FROM trials, (SELECT ?::VARCHAR AS level)",
                [opponent],
            )
            found = connection.execute("SELECT ego, driver FROM trial_drivers").fetchall()
        pair = {"left": (left, right), "right": (right, left)}[ego]
        assert found == [(ego, "+".join(dict.fromkeys(pair)))]
