"""The prompts, conditions and plug-ins that a study adds."""

from __future__ import annotations

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.errors import UsageError
from merge_runner.prompts.blocks import block_digests, blocks_of, render_prompt
from merge_runner.run.plan import make_plan
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from tests.harness import how_to

HEAD = 'repetitions = 1\nconditions = ["N_0_0"]\n'
DRIVER = """
from merge_runner.drivers.registry import PROGRAMS, Program

class Braking:
    def __init__(self, seat):
        self.seat = seat

    async def decide(self, observation, number):
        return self.seat.held({action})

PROGRAMS.register("braking", Program(Braking, "brakes"))
"""


@pytest.fixture
def plan_of(tmp_path):
    """Makes the plan of a study's text."""

    def plan(text, models=(), plugin=None, conditions=True):
        file = tmp_path / "mine.toml"
        file.write_text((HEAD if conditions else "repetitions = 1\n") + text)
        if plugin is not None:
            (tmp_path / "mine.py").write_text(plugin)
        return make_plan(str(file), models, trust=True)

    return plan


def prompt(variant):
    world = World(ScenarioConfig(), CONDITIONS["N_0_0"], TRACK)
    scenario = ScenarioConfig()
    return render_prompt(world.observe("left"), None, variant=variant, scenario=scenario)


def persona(text="You are a taxi driver."):
    added = f'add = [{{ after = "C3.human", text = "{text}" }}]'
    return f'[factors]\nprompt = ["taxi"]\n[prompts.taxi]\n{added}\n'


MODELS = """
[talker-1]
provider = "talker"
format = "say"
id = "talker-1"
max_output_tokens = 2000
price = "free"
"""


def test_models_beside_a_study_may_speak_a_wire_format_of_its_plug_ins(plan_of, tmp_path):
    (tmp_path / "models.toml").write_text(MODELS)
    named = 'models = ["talker-1"]\n[plugins]\nfiles = ["mine.py"]\n'
    plan = plan_of(named, plugin=how_to("add-a-wire-format"))
    assert plan.entries["talker-1"].format == "say"


def test_a_paragraph_is_added_where_it_belongs(plan_of):
    plan_of(persona("You drive {own_speed_kmh} km/h, {own_speed_mph} mph."))
    lines = prompt("taxi").split("\n\n")
    place = lines.index("You drive 36.00 km/h, 22.37 mph.")
    assert lines[place - 1].startswith("Drive the way a human driver")
    assert lines[:place] + lines[place + 1 :] == prompt("baseline").split("\n\n")


@pytest.mark.parametrize(
    ("change", "neighbours"),
    [
        ("", ("C0", "C1")),
        ('remove = ["C1", "C2"]\n', ("C0", "C3.safety")),
        ('based_on = "A1"\n', ("C0", "C2")),
    ],
)
def test_a_ready_block_stands_behind_the_situation_unless_it_is_put_elsewhere(
    plan_of, change, neighbours
):
    head = '[factors]\nprompt = ["more"]\n[prompts.more]\n'
    plan_of(f'{head}{change}add = [{{ block = "state.time_gap" }}]\n')
    names = list(blocks_of("more"))
    place = names.index("state.time_gap")
    assert (names[place - 1], names[place + 1]) == neighbours
    plan_of(f'{head}{change}add = [{{ block = "state.time_gap", before = "C5" }}]\n')
    assert list(blocks_of("more"))[-2:] == ["state.time_gap", "C5"]
    assert "\n\nTime gap (" in prompt("more")


def test_an_edited_prompt_is_another_spec_at_once(plan_of):
    texts = ["You are late.", "You are early."]
    specs = [plan_of(persona(text)).trial_specs()[0].spec_hash for text in texts]
    assert specs[0] != specs[1]
    assert "You are early." in prompt("taxi")
    assert "You are late." not in prompt("taxi")


def test_blocks_are_removed_replaced_and_moved(plan_of):
    plan_of(
        '[factors]\nprompt = ["other"]\n[prompts.other]\nbased_on = "A2"\n'
        'remove = ["C3.safety", "C4"]\nreplace = { "C3.human" = "Drive like a robot." }\n'
        'add = [{ after = "C0", block = "C4" }]\n'
    )
    rest = [name for name in blocks_of("A2") if name not in ("C0", "C3.safety", "C4")]
    assert list(blocks_of("other")) == ["C0", "C4", *rest]
    assert "Drive like a robot." in prompt("other")


def test_the_place_of_a_block_is_in_the_hash_of_its_prompt(plan_of):
    plan_of(
        '[factors]\nprompt = ["other"]\n[prompts.other]\nremove = ["C4"]\n'
        'add = [{ after = "C0", block = "C4" }]\n'
    )
    assert block_digests("other") != block_digests("baseline")


OWN = """
[[conditions]]
name = "X"
projected_headway_m = 1
relative_velocity_mps = 0.5
mean_speed_mps = {speed}
"""


def test_an_own_condition_is_played_and_another_mean_speed_is_another_spec(plan_of):
    specs = []
    for speed in (10.0, 12.0):
        specs += plan_of(OWN.format(speed=speed), conditions=False).trial_specs()
        assert CONDITIONS["X"].speeds_mps[0] == speed + 0.25
    assert len({spec.spec_hash for spec in specs}) == 2
    plain = make_plan("baseline", "emulator").trial_specs()[0].spec_hash
    assert specs[0].spec_hash == plain  # its headway and velocity stand in the trial's row


def test_all_stands_for_the_conditions_of_the_scenario(plan_of):
    text = (
        'conditions = ["all", { name = "Y", projected_headway_m = 1, relative_velocity_mps = 0 }]\n'
    )
    plan = plan_of(text, conditions=False)
    assert len(plan.conditions) == 12


def test_a_plug_in_beside_the_study_drives_and_an_edit_of_it_is_another_driver(plan_of):
    text = '[plugins]\nfiles = ["mine.py"]\n'
    hashes = []
    for action in (-0.1, -0.1, -0.2):
        plan = plan_of(text, ["braking"], plugin=DRIVER.format(action=action))
        hashes.append(plan.trial_specs()[0].spec_hash)
    assert hashes[0] == hashes[1] != hashes[2]
    assert plan.model_dump(mode="json")["study"]["plugins"] == {
        "mine.py": DRIVER.format(action=-0.2)
    }


def test_an_edit_of_what_a_plug_in_imports_is_another_driver(tmp_path):
    study = tmp_path / "mine.toml"
    study.write_text(HEAD + '[plugins]\nfiles = ["gains.py", "mine.py"]\n')
    driver = "from .gains import GAIN\n" + DRIVER.format(action="GAIN")
    (tmp_path / "mine.py").write_text(driver)
    hashes = []
    for gain in (-0.1, -0.9):
        (tmp_path / "gains.py").write_text(f"GAIN = {gain}\n")
        hashes.append(make_plan(str(study), ["braking"], trust=True).trial_specs()[0].spec_hash)
    assert hashes[0] != hashes[1]


def test_what_an_earlier_study_added_is_gone(plan_of):
    plan_of('[plugins]\nfiles = ["mine.py"]\n', ["braking"], plugin=DRIVER.format(action=0))
    with pytest.raises(UsageError, match="unknown model 'braking'"):
        plan_of("", ["braking"])
    plan_of(persona())
    with pytest.raises(UsageError, match="unknown variant 'taxi'"):
        plan_of('[factors]\nprompt = ["taxi"]\n')


@pytest.mark.parametrize(
    ("text", "plugin", "says"),
    [
        (
            persona("{speed}"),
            None,
            "block 'added by taxi': 'speed'; valid: ",
        ),
        (
            persona().replace("C3.human", "C9"),
            None,
            "unknown block of the prompt taxi 'C9'; valid: C0",
        ),
        (
            persona().replace("C3.human", "A"),
            None,
            "unknown block of the prompt taxi 'A'; valid: C0",
        ),
        ('[prompts.baseline]\nremove = ["C2"]\n', None, "there is a variant 'baseline' already"),
        (
            '[prompts.x]\nremove = ["C2"]\nreplace = { C2 = "x" }\n',
            None,
            "unknown block of the prompt x 'C2'; valid: C0",
        ),
        (
            '[prompts.x]\nadd = [{ after = "C0" }]\n',
            None,
            "give it a block, a text, or merge",
        ),
        (
            '[prompts.x]\nadd = [{ after = "C0", text = "a", merge = "b" }]\n',
            None,
            "give it a block, a text, or merge",
        ),
        ('[prompts.x]\nadd = [{ block = "C9" }]\n', None, "unknown prompt block 'C9'; valid: C0"),
        ('[prompts.x]\nadd = [{ block = "C2" }]\n', None, "C2, which it has already"),
        ("[prompts.x]\nad = []\n", None, "unknown key 'prompts.x.ad'; valid: based_on, remove"),
        ('[plugins]\nfiles = ["none.py"]\n', None, "none.py cannot be read"),
        (
            '[plugins]\nfiles = ["mine.py"]\n',
            "\n1 / 0",
            "mine.py, line 2, fails: ZeroDivisionError",
        ),
        ('[plugins]\nfiles = ["mine.py"]\n', "def", "mine.py, line 1, fails: SyntaxError"),
        ('[plugins]\nfiles = ["mine.py"]\n', "assert 0, 'no'", "fails: AssertionError: no"),
        ('[plugins]\nfiles = ["mine.py", "a/mine.py"]\n', "", "cannot be read"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(plan_of, text, plugin, says):
    with pytest.raises(UsageError) as caught:
        plan_of(text, plugin=plugin)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_a_plug_in_imports_is_no_part_of_its_study(plan_of, tmp_path, monkeypatch):
    register = 'CONDITIONS.register("elsewhere", Condition(1.0, 0.0))\n'
    imports = "from merge_runner.scenarios.merge.conditions import CONDITIONS, Condition\n"
    (tmp_path / "imported_by_a_plug_in.py").write_text(imports + register)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(CONDITIONS, "_things", dict(CONDITIONS._things))
    own = f"import imported_by_a_plug_in\n{imports}{register.replace('elsewhere', 'own')}"
    plan_of('[plugins]\nfiles = ["mine.py"]\n', plugin=own)
    assert {"elsewhere", "own"} < {*CONDITIONS}
    make_plan("baseline", "constant")
    assert "elsewhere" in CONDITIONS
    assert "own" not in CONDITIONS
