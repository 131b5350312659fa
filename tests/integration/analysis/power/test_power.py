"""What a study can find before it is played."""

import json
from dataclasses import replace

import numpy as np
import pytest

from merge_runner.errors import UsageError
from merge_runner.planted_effect import PlantedEffect
from merge_runner.run.plan import make_plan
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner.study.file import Effect
from merge_runner_analysis.power import chances, power, power_table, unread_words
from merge_runner_analysis.power.assumptions import HUMANS
from merge_runner_analysis.power.cases import Case, Contrast, Played
from merge_runner_analysis.power.truth import human, simulate
from merge_runner_analysis.selection import Selection
from merge_runner_analysis.stats.effects import effects
from merge_runner_analysis.stats.regressions import gap_ols, who_first_logit
from merge_runner_analysis.study import StudyResults

PLANTED = """
repetitions = 10
[factors]
x_relative_speed = [-3.3, -0.2]
"""
NAMED = """
models = ["o3"]
primary = "collided"
repetitions = 10
[factors]
prompt = ["baseline", "A1"]
resistance = ["none", "human"]
[effect]
prompt = { relative_velocity = 3.0 }
resistance = { collided = 0.4 }
"""
HURRY = """
models = ["o3"]
repetitions = 10
mirror = true
conditions = ["L_4_0", "N_0_0", "R_-4_0"]
[factors]
prompt = ["baseline", "A1"]
opponent = ["projected-order", "constant"]
[effect]
prompt = { goes_first = 0.15 }
"""
REHEARSED = """
models = ["emulator"]
repetitions = 2
conditions = ["L_4_0", "N_0_0"]
mirror = true
[factors]
persona = ["none", "taxi"]
hurry = ["no", "yes"]
opponent = ["self", "projected-order"]
[texts.persona.taxi]
add = [{ text = "You are a taxi driver." }]
given_to = "ego"
[texts.hurry.yes]
add = [{ text = "You are late." }]
given_to = "ego"
emulator = { own_first = 3.0 }
[effect]
hurry = { goes_first = 0.25 }
"""
PERSONA = """
repetitions = 4
[factors]
prompt = ["baseline", "hurried"]
x_persona = [{text = "You are late.", x_relative_speed = 2.0}]
[prompts.hurried]
add = [{text = "You are late."}]
"""


def test_simulated_trials_scatter_about_their_truth():
    truth = replace(human(), collided=0.1)
    trials = simulate(truth, list(HUMAN_CONDITIONS), 2000, np.random.default_rng(1))
    assert len(trials) == 22_000
    assert (trials["status"] == "collided").mean() == pytest.approx(0.1, abs=0.01)
    for name, term in who_first_logit(trials).terms.items():
        assert term.b == pytest.approx(getattr(truth, name), abs=4 * term.se)
    for value, term in zip(truth.gap, gap_ols(trials).terms.values(), strict=True):
        assert term.b == pytest.approx(value, abs=4 * term.se)
    # The odds of the emulator are those that the humans are supposed to have.
    assert PlantedEffect().coefficients == tuple(human().logit)


def level(truth, *, cell="", side="left", equal=False):
    return (Played(cell, side, equal, tuple(HUMAN_CONDITIONS), 10, truth),)


def test_what_is_the_same_has_no_chance_to_be_told_apart():
    conditions = tuple(HUMAN_CONDITIONS)
    assert Case(human(), conditions, 10, HUMANS).effects() == {}
    braver = replace(human(), gap_m=9.0, collided=0.5)
    assert list(Case(braver, conditions, 10, HUMANS).effects()) == ["collisions"]
    same = Contrast(level(human()), level(human()), "goes first", "default")
    assert same.size == pytest.approx(0)
    apart = (Contrast(level(braver), level(human()), of, "default") for of in ("collisions", "gap"))
    assert [each.size for each in apart] == pytest.approx(
        [100 * (0.5 - 28 / 990), 9.0 - human().gap_m]
    )


def test_two_equal_drivers_are_read_from_both_sides_and_favour_none():
    fair = replace(human(), intercept=0.0)
    sure = replace(fair, intercept=50.0, noise=0.0, collided=0.0)
    own = level(sure, side="left") + level(sure, side="right")
    contrast = Contrast(own, level(human(), equal=True), "goes first", "default", one_sided=True)
    assert contrast.size == pytest.approx(50, abs=0.5), "the left one goes as often as the other"
    assert power(contrast, 1, 20) == {"goes first": 1.0}


def test_an_effect_on_who_goes_first_is_that_many_points_over_the_conditions():
    conditions = ["L_4_0", "N_0_0", "R_-4_0"]
    before = human().first(conditions)
    more = human().plus(Effect(goes_first=0.15), conditions).first(conditions)
    assert more.mean() - before.mean() == pytest.approx(0.15)
    assert all(more > before)
    trials = simulate(human(), conditions, 4000, np.random.default_rng(3))
    shares = trials.groupby("condition", sort=False)["left_first"].mean()
    assert list(shares) == pytest.approx(list(before), abs=0.03)


def test_a_row_for_each_test_of_the_primary_measure_and_none_for_mirrored_halves(file):
    found = powered(file(HURRY), simulations=20)
    prompt, opponent = found
    assert [(r["question"], r["arms"], r["against"], r["trials"], r["assumed"]) for r in found] == [
        ("goes first", "prompt=A1", "prompt=baseline", 4 * 10 * 3, "[effect]"),
        ("goes first", "opponent=constant", "opponent=projected-order", 4 * 10 * 3, "default"),
    ]
    assert {(r["table"], r["unit"]) for r in found} == {("effects", "points")}
    assert [r["effect"] for r in found] == pytest.approx([15, 15])
    assert prompt["times_0.5"] <= prompt["times_4"] == opponent["times_4"] == 100


def test_rows_are_those_of_the_table_of_effects_whatever_is_planted(file, prepare, tmp_path):
    study = file(REHEARSED)
    assert prepare(tmp_path, "sweep", study, "--db", "r.duckdb").code == 0
    played = StudyResults(tmp_path / "r.duckdb", Selection(file=str(study)))
    tested = [one for one in effects(played) if one.primary]
    plan = make_plan(str(study))
    said = []
    found = [row.values for row in chances(plan, 0.0, played.models, 20, said.append)]
    assert said == [f"simulating {n} of 3: {row['arms']}" for n, row in enumerate(found, 1)]
    named = {(f"{e.factor}={e.level.name}", f"{e.factor}={e.reference.name}"): e for e in tested}
    assert {(row["arms"], row["against"]) for row in found} == named.keys()
    assert len(named) == 3
    assumed = {row["arms"]: (row["assumed"], row["truth"]) for row in found}
    assert assumed == {
        "persona=taxi": ("default", "human"),
        "hurry=yes": ("[effect]", "human"),
        "opponent=projected-order": ("default", "human"),
    }
    sizes = {row["arms"]: row["effect"] for row in found}
    assert sizes["hurry=yes"] == pytest.approx(25, abs=0.5)
    for row in found:
        level = named[row["arms"], row["against"]].level
        assert row["trials"] == len(level.pooled.stored.trials)


def test_a_level_whose_words_the_emulator_does_not_read_is_named(file):
    study = str(file(REHEARSED))
    says = "persona=taxi: the power is that of a model which reads the words. The emulator reads no"
    assert unread_words(make_plan(study)).startswith(says)
    assert not unread_words(make_plan(study, ["o3"]))
    assert not unread_words(make_plan(study, only={"persona": ["none"]}))
    assert power_table("", [], "told first").notes[0] == "told first"


def powered(study, model=(), simulations=1):
    return [row.values for row in chances(make_plan(str(study), model), 7.0, [], simulations)]


@pytest.fixture
def file(tmp_path):
    def write(text):
        (tmp_path / "mine.toml").write_text(text)
        return tmp_path / "mine.toml"

    return write


def test_what_is_planted_is_told_and_strong_effects_need_fewer_trials(file):
    found = powered(file(PLANTED), simulations=2)
    assert {each["truth"] for each in found} == {"as planted"}
    speeds = {each["arms"]: each for each in found if each["question"] == "I2"}
    strong, weak = speeds["x_relative_speed=-3.3"], speeds["x_relative_speed=-0.2"]
    assert (strong["effect"], weak["effect"]) == (-3.3, -0.2)
    assert strong["enough"] <= strong["trials"] == 110
    assert weak["enough"] is None


def test_an_effect_that_the_study_names_beside_a_factor_is_supposed(file):
    found = powered(file(NAMED))
    sizes = {each["arms"]: each for each in found if each["table"] == "effects"}
    assert {each["question"] for each in sizes.values()} == {"collisions"}
    assert sizes["resistance=human"]["effect"] == pytest.approx(40)
    assert sizes["resistance=human"]["assumed"] == "[effect]"
    # What changes another measure is nothing to the primary one: twice as many collisions.
    assert sizes["prompt=A1"]["assumed"] == "default"
    assert sizes["prompt=A1"]["effect"] == pytest.approx(100 * 28 / 990 + 20)
    # How a prompt's driver heeds its situation is a question about that driver.
    slopes = [e for e in found if e["question"] == "relative velocity"]
    assert [e["effect"] for e in slopes] == pytest.approx([3, 3])
    assert all(e["arms"].endswith("A1") for e in slopes)
    assert {each["table"] for each in found if each["against"] == HUMANS} == {"verdicts"}
    with pytest.raises(UsageError, match=r"'rmse_mps'.*valid: goes_first, collided, gap_m"):
        powered(file(NAMED.replace('"collided"', '"rmse_mps"')))
    with pytest.raises(UsageError, match="resistence"):
        make_plan(str(file(NAMED.replace("resistance = {", "resistence = {"))), ())


def test_a_planted_persona_is_supposed_where_the_prompt_contains_it(file):
    effects = {e["arms"]: e["effect"] for e in powered(file(PERSONA)) if e["question"] == "I2"}
    assert effects == {"baseline": -3.3, "hurried": pytest.approx(-1.3)}


def test_equal_arms_share_a_row_and_half_of_the_trials_find_no_more():
    found = powered("ablations", ("o3",), simulations=2)
    assert {each["arms"].count(",") for each in found} == {6}
    (row,) = found
    assert (row["question"], row["truth"], row["assumed"]) == ("goes first", "human", "default")
    assert row["times_0.5"] <= row["times_4"] == 100
    assert row["cost_usd"] > 0


def test_power_sends_and_makes_nothing_and_says_where_a_price_is_unknown(prepare, tmp_path):
    (tmp_path / "experiments").mkdir()
    (tmp_path / "experiments/models.toml").write_text(
        '[dear]\nprovider = "openai"\nformat = "openai-chat"\nid = "no-such-model"\n'
        "max_output_tokens = 4000\n"
    )
    few = ("--model", "dear", "--reps", 1, "--conditions", "N_0_0,L_4_0", "--sims", 20)
    run = prepare(tmp_path, "power", "baseline", *few, code=0)
    assert "2 trials, an unknown price; 20 simulated studies" in run.out
    told = json.loads(prepare(tmp_path, "power", "baseline", *few, "--json").out)
    assert (told["study"], told["trials"], told["cost_usd"]) == ("baseline", 2, None)
    assert {row["trials"] for row in told["chances"]} == {2}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["experiments"]
