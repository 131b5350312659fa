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
from merge_runner_analysis.power import HUMANS, Case, Contrast, chances, human, simulate
from merge_runner_analysis.stats.regressions import gap_ols, who_first_logit

PLANTED = """
repetitions = 10
[factors]
x_relative_speed = [-3.3, -0.2]
"""
NAMED = """
models = ["idm"]
repetitions = 10
[factors]
prompt = ["baseline", "A1"]
resistance = ["none", "human"]
[effect]
prompt = { gap_m = 2.0, relative_velocity = 3.0 }
resistance = { collided = 0.4 }
"""
HURRY = """
models = ["idm"]
repetitions = 10
mirror = true
conditions = ["L_4_0", "N_0_0", "R_-4_0"]
[factors]
prompt = ["baseline", "A1"]
opponent = ["projected-order", "constant"]
[effect]
prompt = { goes_first = 0.15 }
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


def test_what_is_the_same_has_no_chance_to_be_told_apart():
    conditions = list(HUMAN_CONDITIONS)
    same = Contrast(((human(), 10, human(), 10),), "first")
    assert same.effects(conditions) == {}
    assert Case(human(), 10, HUMANS).effects(conditions) == {}
    braver = replace(human(), gap_m=9.0, collided=0.5)
    assert list(Case(braver, 10, HUMANS).effects(conditions)) == ["collisions"]
    apart = Contrast(((braver, 10, human(), 10),), "first").effects(conditions)
    assert {name: size for name, (_, size, _) in apart.items()} == pytest.approx(
        {"collisions": 100 * (0.5 - 28 / 990), "gap": 9.0 - human().gap_m}
    )


def test_an_effect_on_who_goes_first_is_that_many_points_over_the_conditions():
    conditions = ["L_4_0", "N_0_0", "R_-4_0"]
    before = human().first(conditions)
    more = human().plus(Effect(goes_first=0.15), conditions).first(conditions)
    assert more.mean() - before.mean() == pytest.approx(0.15)
    assert all(more > before)
    trials = simulate(human(), conditions, 4000, np.random.default_rng(3))
    shares = trials.groupby("condition", sort=False)["left_first"].mean()
    assert list(shares) == pytest.approx(list(before), abs=0.03)


def test_a_study_of_an_effect_has_a_row_for_each_of_its_tests_and_none_for_mirrored_halves(file):
    found = powered(file(HURRY), simulations=20)
    assert [(r["question"], r["arms"], r["against"], r["trials"]) for r in found] == [
        ("goes first", "prompt=A1", "prompt=baseline", 4 * 10 * 3)
    ]
    (row,) = found
    assert (row["table"], row["effect"], row["unit"]) == ("effects", pytest.approx(15), "points")
    assert row["times_0.5"] <= row["times_4"] == 100


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
    effects = {
        (each["arms"], each["question"]): each["effect"]
        for each in found
        if each["table"] == "effects" and each["question"] != "goes first"
    }
    assert effects == {
        ("resistance=human", "collisions"): pytest.approx(40),
        ("prompt=A1", "gap"): pytest.approx(2),
    }
    # How a prompt's driver heeds its situation is a question about that driver.
    slopes = [e for e in found if e["question"] == "relative velocity"]
    assert [e["effect"] for e in slopes] == pytest.approx([3, 3])
    assert all(e["arms"].endswith("A1") for e in slopes)
    assert {each["table"] for each in found if each["against"] == HUMANS} == {"verdicts"}
    with pytest.raises(UsageError, match="resistence"):
        make_plan(str(file(NAMED.replace("resistance = {", "resistence = {"))), ())


def test_a_planted_persona_is_supposed_where_the_prompt_contains_it(file):
    effects = {e["arms"]: e["effect"] for e in powered(file(PERSONA)) if e["question"] == "I2"}
    assert effects == {"baseline": -3.3, "hurried": pytest.approx(-1.3)}


def test_equal_arms_share_a_row_and_half_of_the_trials_find_less():
    found = powered("ablations", ("o3",), simulations=2)
    assert {each["arms"].count(",") for each in found} == {6}
    assert {each["question"] for each in found} == {"goes first", "collisions", "gap"}
    assert {each["truth"] for each in found} == {"human"}
    (gap,) = (each for each in found if each["question"] == "gap")
    assert gap["times_0.5"] < gap["times_4"] == 100
    assert gap["cost_usd"] > 0


def test_power_sends_and_makes_nothing_and_says_where_a_price_is_unknown(prepare, tmp_path):
    (tmp_path / "experiments").mkdir()
    (tmp_path / "experiments/models.toml").write_text(
        '[dear]\nprovider = "openai"\nformat = "openai-chat"\nid = "no-such-model"\n'
        "max_output_tokens = 4000\n"
    )
    few = ("--model", "dear", "--reps", 1, "--conditions", "N_0_0,L_4_0", "--sims", 20)
    run = prepare(tmp_path, "power", "baseline", *few)
    assert run.code == 0, run.err
    assert "2 trials, an unknown price; 20 simulated studies" in run.out
    told = json.loads(prepare(tmp_path, "power", "baseline", *few, "--json").out)
    assert (told["study"], told["trials"], told["cost_usd"]) == ("baseline", 2, None)
    assert {row["trials"] for row in told["chances"]} == {2}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["experiments"]
