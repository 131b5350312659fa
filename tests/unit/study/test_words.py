"""Factors of words cross with all others, for both drivers or for one of them."""

import hashlib
import json
from itertools import product

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from merge_runner.prompts.blocks import BASELINE, Prompt, blocks_of, composed, decomposed
from merge_runner.records import SIDES
from merge_runner.registry import using
from merge_runner.run.plan import make_plan

HEAD = 'repetitions = 2\nconditions = ["N_0_0"]\n'
EGO = 'given_to = "ego"'


def crossed(hurry="", persona=""):
    """A study of two factors of words, with more keys of the one and the other."""
    added = 'add = [{ after = "C3.human", text = "%s" }]\n'
    return (
        '[factors]\npersona = ["none", "taxi"]\nhurry = ["no", "yes"]\n'
        f"[texts.hurry.yes]\n{added % 'You are late.'}{hurry}\n"
        f"[texts.persona.taxi]\n{added % 'You drive a taxi.'}{persona}\n"
    )


BOTH, ONE = crossed(), crossed(EGO, EGO)


def by_label(plan):
    return {arm.label: arm for arm in plan.arms}


def paragraphs(prompt, road="merge"):
    texts = (getattr(block, road) for block in prompt.blocks.values())
    return "\n\n".join(filter(None, texts)).split("\n\n")


def test_levels_of_words_cross_and_stand_in_the_order_of_the_factors(plan_of):
    plan = plan_of(BOTH)
    assert [arm.variant for arm in plan.arms] == [
        "baseline",
        "hurry=yes",
        "persona=taxi",
        "persona=taxi hurry=yes",
    ]
    texts = paragraphs(plan.parts.prompts["persona=taxi hurry=yes"])
    place = texts.index("You drive a taxi.")
    assert texts[place - 1].startswith("Drive the way a human driver")
    assert texts[place + 1] == "You are late."
    plain = paragraphs(plan.parts.prompts["baseline"])
    assert texts[:place] + texts[place + 2 :] == plain
    ids = {spec.trial_id: spec for spec in plan.trial_specs()}
    assert len(ids) == plan.trials == 4 * 2
    spec = ids["emulator/baseline/N_0_0/rep01/hurry=yes/persona=none"]
    assert dict(spec.factors) == {"persona": "none", "hurry": "yes", "prompt": "baseline"}
    assert (spec.variant, spec.focal, spec.words) == ("hurry=yes", None, {"persona", "hurry"})


def test_words_apply_to_each_prompt_and_each_whole_prompt_has_its_hash(plan_of):
    text = BOTH.replace("[factors]\n", '[factors]\nprompt = ["baseline", "A1"]\n')
    plan = plan_of(text)
    assert {arm.variant for arm in plan.arms} == {
        composed(prompt, [*persona, *hurry])
        for prompt, persona, hurry in product(
            (BASELINE, "A1"), ((), ("persona=taxi",)), ((), ("hurry=yes",))
        )
    }
    assert len({spec.spec_hash for spec in plan.trial_specs()}) == len(plan.arms) == 8
    crossed = paragraphs(plan.parts.prompts["A1 persona=taxi hurry=yes"])
    assert "You are late." in crossed
    assert not any(text.startswith("History") for text in crossed)
    ids = {spec.trial_id for spec in plan.trial_specs()}
    assert "emulator/A1/N_0_0/rep01/hurry=yes/persona=taxi" in ids


def test_the_order_of_words_is_in_the_hash(plan_of):
    turned = BOTH.replace(
        'persona = ["none", "taxi"]\nhurry = ["no", "yes"]',
        'hurry = ["no", "yes"]\npersona = ["none", "taxi"]',
    )
    plans = [plan_of(text).trial_specs() for text in (BOTH, turned)]
    hashes = [{spec.trial_id: spec.spec_hash for spec in specs} for specs in plans]
    assert hashes[0].keys() == hashes[1].keys()
    differing = {name for name, hashed in hashes[0].items() if hashes[1][name] != hashed}
    assert differing == {f"emulator/baseline/N_0_0/rep0{n}/hurry=yes/persona=taxi" for n in (1, 2)}


def test_the_one_that_is_treated_sits_on_both_sides_of_a_mirrored_study(plan_of):
    arms = by_label(plan_of("mirror = true\n" + ONE))
    assert len(arms) == 1 + 3 * 2, "nobody is treated in the first, which is played once"
    assert arms["persona=none hurry=no"].focal is None
    for label, side in (("persona=none hurry=yes", "left"),
                        ("persona=none hurry=yes mirrored", "right")):  # fmt: skip
        arm, (other,) = arms[label], {*SIDES} - {side}
        assert (arm.variant, arm.focal, arm.ego) == ("hurry=yes", side, side)
        assert (arm.prompt(side), arm.prompt(other)) == ("hurry=yes", "baseline")
    plan = plan_of("mirror = true\n" + ONE)
    ids = {spec.trial_id: spec for spec in plan.trial_specs()}
    pair = [
        ids[f"emulator/baseline/N_0_0/rep01/hurry=yes/persona=none/focal={side}"] for side in SIDES
    ]
    assert pair[0].spec_hash != pair[1].spec_hash
    assert [spec.focal for spec in pair] == [*SIDES]
    assert len(ids) == plan.trials == 7 * 2
    assert len({spec.spec_hash for spec in ids.values()}) == 7
    unmirrored = {spec.trial_id: spec.spec_hash for spec in plan_of(ONE).trial_specs()}
    assert unmirrored.items() < {name: spec.spec_hash for name, spec in ids.items()}.items()


@pytest.mark.parametrize("given_to", ["ego", "other"])
def test_of_two_models_the_ego_or_the_other_is_treated(plan_of, given_to):
    text = crossed(f'given_to = "{given_to}"')
    plan = plan_of("mirror = true\n" + text, "random+emulator")
    for arm in plan.arms:
        assert arm.sides[arm.ego] == "emulator", "the first in the alphabet"
        if "hurry=yes" in arm.variant:
            (treated,) = (side for side in SIDES if "hurry=yes" in arm.prompt(side))
            assert arm.focal == arm.ego
            assert (arm.sides[treated] == "emulator") == (given_to == "ego")
    assert len(plan.arms) == 4 * 2


def test_a_parameter_and_the_perception_may_be_those_of_one_driver(plan_of):
    foggy = "[perception.foggy]\nspeed_sd_mps = 0.3\n"
    text = (
        'mirror = true\n[factors]\ntemperature = ["default", 2.0]\n'
        'perception = ["perfect", "foggy"]\n[given_to]\ntemperature = "ego"\n'
        f'perception = "other"\n{foggy}'
    )
    arms = by_label(plan_of(text))
    assert [arm.focal for arm in arms.values()] == [None, *["left", "right"] * 3]
    warm = arms["temperature=2.0 perception=perfect mirrored"]
    assert warm.full_names == {"left": "emulator", "right": "emulator temperature=2.0"}
    blind = arms["temperature=default perception=foggy mirrored"]
    assert blind.scenario.perception_left.speed_sd_mps == 0.3
    assert blind.scenario.perception_right.speed_sd_mps == 0.0


def test_an_effect_is_planted_in_the_emulator_on_both_sides_and_in_no_other_model(plan_of):
    text = crossed(f"{EGO}\nemulator = {{ own_first = 1.5, gap_m = 2 }}", EGO)
    arms = by_label(plan_of("mirror = true\n" + text))
    arm = arms["persona=taxi hurry=yes mirrored"]
    planted = [arm.entries[arm.full_names[side]].parameters for side in SIDES]
    assert planted == [{"x_other_first": 1.5, "x_gap_m": 2.0}, {"x_own_first": 1.5, "x_gap_m": 2.0}]
    assert arms["persona=taxi hurry=no"].entries["emulator"].parameters == {}
    assert plan_of("mirror = true\n" + text).driver == "emulator"
    plain = [plan_of(each, "smollm2") for each in (ONE, text)]
    assert plain[0].specs() == plain[1].specs()


STUDY = """mirror = true
skip = [{ model = "emulator", memory_s = 2.0 }]
models = ["emulator", "gemini-2.5-pro+emulator", "constant"]
[factors]
prompt = ["baseline", "A2", "late"]
temperature = ["default"]
opponent = ["self"]
perception_left = ["perfect", "foggy"]
memory_s = [1.0, 2.0]
[prompts.late]
based_on = "A1"
remove = ["C3.human"]
add = [{ after = "C0", text = "You are late." }, { after = "C0", text = "So late." }]
[perception.foggy]
speed_sd_mps = 0.3
"""


@pytest.mark.parametrize(
    ("study", "model", "digest"),
    [
        ("baseline", ["o3"], "2f49f4958817cf47"),
        ("baseline", ["emulator", "smollm2"], "037a1a6f3984b776"),
        ("ablations", ["emulator"], "02ffefe1ca1ae59d"),
        ("mine", [], "5496432ce6ba4563"),
    ],
)
def test_studies_without_words_keep_their_trials_and_specs(plan_of, study, model, digest):
    plan = plan_of(STUDY) if study == "mine" else make_plan(study, model)
    trials = [
        [spec.trial_id, spec.spec_hash, spec.order, spec.arm, spec.variant]
        for spec in plan.trial_specs()
    ]
    assert hashlib.sha256(json.dumps(trials).encode()).hexdigest()[:16] == digest


ANCHORS = ["C0", "C3.human", "C3.distance", "C5"]
CHANGES = st.tuples(
    st.sampled_from(ANCHORS), st.sampled_from(["before", "after", "last"]), st.booleans()
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)
@given(
    first=st.lists(CHANGES, min_size=1, max_size=2),
    second=st.lists(CHANGES, min_size=1, max_size=2),
)
def test_a_composed_prompt_is_the_levels_applied_by_hand(plan_of, first, second):
    tables, by_hand = "", list(blocks_of(BASELINE))
    for factor, changes in (("one", first), ("two", second)):
        added = []
        for number, (anchor, place, _) in enumerate(changes, 1):
            name = f"{factor}=yes.{number}"
            where = "" if place == "last" else f'{place} = "{anchor}", '
            added.append(f'{{ {where}text = "{factor} {number}" }}')
            if place == "last":
                by_hand.append(name)
                continue
            at = by_hand.index(anchor)
            if place == "after":
                at += 1
                while at < len(by_hand) and "=" in by_hand[at]:
                    at += 1
            by_hand.insert(at, name)
        tables += f"[texts.{factor}.yes]\nadd = [{', '.join(added)}]\n"
    plan = plan_of(f'[factors]\none = ["no", "yes"]\ntwo = ["no", "yes"]\n{tables}')
    prompt = plan.parts.prompts["one=yes two=yes"]
    assert list(prompt.blocks) == by_hand
    known = blocks_of(BASELINE)
    assert paragraphs(prompt) == [
        part
        for name in by_hand
        for part in (known[name].merge if name in known else name.replace("=yes.", " ")).split(
            "\n\n"
        )
    ]
    with using(plan.parts.catalogue):
        assert Prompt(blocks_of("one=yes two=yes")).digests == prompt.digests
    assert len({spec.trial_id for spec in plan.trial_specs()}) == plan.trials


@given(
    st.sampled_from([BASELINE, "A1", "my.own"]),
    st.lists(st.sampled_from(["a=b", "c=d.e"]), unique=True),
)
def test_the_name_of_a_composed_prompt_says_what_it_is_made_of(variant, words):
    assert decomposed(composed(variant, words)) == (variant, words)
