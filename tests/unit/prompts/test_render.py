"""The text of the prompts, byte for byte, and that an ablation changes nothing but its block.

To rewrite the golden files after a wanted change of the text, set UPDATE_GOLDEN_PROMPTS=1 and
run this file; then read the difference, since it is a new experiment.
"""

from dataclasses import replace

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.errors import UsageError
from merge_runner.prompts.blocks import (
    BLOCKS,
    VARIANTS,
    Block,
    Variant,
    blocks_of,
    prompt_of,
)
from merge_runner.records import Observation
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from tests.support.prompts import FIRST, SEEN, check, shown

REST_OF_PLAN = (0.3, 0.25, 0.2, 0.15, 0.1, 0.05, 0.0, 0.0, -0.05, -0.1, -1.0, -0.5, 0.0, 1.0, 0.5)
FORMS = ("first", "mid_run", "straight")
# How the paragraph begins that a variant leaves out.
REMOVED = {
    "A1": "History of the last",
    "A2": "Previous plan",
    "A3": "Avoid a collision",
    "A4": "Drive the way a human",
    "A5": "Be risk-averse",
    "A6": "Reassess",
    "A7": "Tactical decision",
}


def render(variant, form, **scenario):
    return shown(SEEN[form], None if form == "first" else REST_OF_PLAN, variant, **scenario)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_prompt_is_the_golden_text(variant, form):
    check(f"prompts/{variant}_{form}.txt", render(variant, form))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("variant", "beginning"), REMOVED.items())
def test_an_ablation_removes_its_paragraph_and_changes_no_other_byte(variant, beginning, form):
    paragraphs = render("baseline", form).split("\n\n")
    kept = [paragraph for paragraph in paragraphs if not paragraph.startswith(beginning)]
    # On the straight road nobody is asked for a tactical decision.
    assert len(paragraphs) - len(kept) == ((variant, form) != ("A7", "straight"))
    assert render(variant, form) == "\n\n".join(kept)
    (removed,), digests = VARIANTS[variant].removes, prompt_of("baseline").digests
    assert prompt_of(variant).digests == {n: x for n, x in digests.items() if n != removed}


@pytest.mark.parametrize("value", [-0.0, -0.001, -0.00499])
def test_a_value_that_rounds_to_zero_has_no_sign(value):
    seen = Observation("merge", *[value] * 4, (value,) * 10, (value,) * 10, value, value)
    prompt = shown(seen, (value,) * 15)
    assert "-0.00" not in prompt
    # Three speeds and distances, one to the merge point, two histories and the plan.
    assert prompt.count("0.00") == 4 + 2 * 10 + 15


def test_the_numbers_of_the_task_come_from_the_scenario():
    pace = {"horizon_s": 3, "step_s": 0.25, "prompt_rate_hz": 2, "memory_s": 1.5}
    prompt = render("baseline", "first", **pace, max_acceleration_mps2=3.5, vehicle_length_m=5.2)
    for words in (
        "a new plan every 0.5 s",
        "Length of each car: 5.2 m",
        "History of the last 1.5 s, one value every 0.25 s",
        "plan for the next 3 s as a list of exactly 12 numbers, one for every 0.25 s",
        "an acceleration of 3.5 m/s^2 and -1 for a deceleration of 3.5 m/s^2",
    ):
        assert words in prompt


def test_no_two_blocks_share_a_digest():
    blocks = *BLOCKS.values(), Block("x", "One.", "Two."), Block("x", "Two.", "One.")
    assert len({block.digest for block in blocks}) == len(blocks)


@pytest.mark.parametrize("name", BLOCKS)
def test_a_changed_text_on_either_road_or_another_place_changes_the_digest(name):
    block = BLOCKS[name]
    changed = {
        block.digest,
        replace(block, merge=f"{block.merge} ").digest,
        replace(block, straight=f"{block.straight or ''} ").digest,
        replace(block, before="C2").digest,
        replace(block, before="C5").digest,
    }
    assert len(changed) == 5
    assert replace(block, meaning="something else").digest == block.digest


def test_added_blocks_stand_where_they_say_in_the_order_of_their_names(own_parts):
    """Also where the last one was registered first."""
    for name, before in (("Z", "C5"), ("B", "C1"), ("Y", "C5"), ("X", "C5")):
        BLOCKS.register(name, Block("more", f"Text {name}.", None, before=before))
    VARIANTS.register("A8", Variant(removes=frozenset({"C4"}), adds=frozenset("ZBY")))
    kept = [name for name in blocks_of("baseline") if name != "C4"]
    assert [*blocks_of("A8")] == ["C0", "B", *kept[1:-1], "Y", "Z", "C5"]
    prompt = shown(FIRST, variant="A8")
    assert "\n\nText B.\n\nHistory of" in prompt
    assert "\n\nText Y.\n\nText Z.\n\nOutput format" in prompt


def test_a_variant_of_a_block_that_there_is_not_is_refused(own_parts):
    VARIANTS.register("A8", Variant(adds=frozenset({"C6"})))
    with pytest.raises(UsageError, match=r"unknown prompt block 'C6'; valid: C0, .*variant A8"):
        blocks_of("A8")


@pytest.mark.parametrize("history_start", ["cruise", "empty"])
def test_in_a_finer_world_the_histories_are_those_of_the_plans_steps(history_start):
    coarse = ScenarioConfig(history_start=history_start)
    fine = coarse.model_copy(update={"step_s": 0.05, "plan_step_s": 0.2})
    worlds = [World(scenario, CONDITIONS["L_4_0"], TRACK) for scenario in (coarse, fine)]
    for number in range(4):
        prompts = [
            shown(world.observe("right"), [0.5], **scenario.model_dump())
            for world, scenario in zip(worlds, (coarse, fine), strict=True)
        ]
        assert prompts[0] == prompts[1]
        for k in range(5):
            action = (0.313, -0.717, 0.919, 0.123, -0.231)[k] / (number + 1)
            for world, steps in zip(worlds, (1, 4), strict=True):
                for _ in range(steps):
                    world.drive([action / 2], [action])


@pytest.mark.parametrize("field", ["{own_speed:>999999999}", "{own_speed!r}"])
def test_a_field_of_a_block_stands_alone_in_its_braces(field):
    with pytest.raises(UsageError, match="cannot be read, a field stands alone in its braces"):
        Block("too wide", f"You drive at {field} m/s.", None)
