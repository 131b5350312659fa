"""The prompts, conditions and plug-ins that a study adds."""

import sys

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.registry import PROGRAMS
from merge_runner.errors import UsageError
from merge_runner.prompts.blocks import blocks_of, prompt_of, render_prompt
from merge_runner.registry import Registry, using
from merge_runner.run.plan import make_plan
from merge_runner.run.trials import TrialMaker
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from merge_runner.trial import play_trial
from tests.support.braking import deciding

HEAD = 'repetitions = 1\nconditions = ["N_0_0"]\n'
HELD = "return self.context.held(-0.2)"


def prompt(plan, variant):
    scenario = ScenarioConfig()
    seen = World(scenario, CONDITIONS["N_0_0"], TRACK).observe("left")
    return render_prompt(seen, None, prompt=plan.parts.prompts[variant], scenario=scenario)


def persona(text="You are a taxi driver."):
    added = f'add = [{{ after = "C3.human", text = "{text}" }}]'
    return f'[factors]\nprompt = ["taxi"]\n[prompts.taxi]\n{added}\n'


def test_a_paragraph_is_added_where_it_belongs(plan_of):
    plan = plan_of(persona("You drive {own_speed_kmh} km/h, {own_speed_mph} mph."))
    lines = prompt(plan, "taxi").split("\n\n")
    place = lines.index("You drive 36.00 km/h, 22.37 mph.")
    assert lines[place - 1].startswith("Drive the way a human driver")
    plain = prompt(make_plan("baseline"), "baseline")
    assert lines[:place] + lines[place + 1 :] == plain.split("\n\n")


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
    plan = plan_of(f'{head}{change}add = [{{ block = "state.time_gap" }}]\n', "emulator")
    names = list(plan.parts.prompts["more"].blocks)
    place = names.index("state.time_gap")
    assert (names[place - 1], names[place + 1]) == neighbours
    plan = plan_of(f'{head}{change}add = [{{ block = "state.time_gap", before = "C5" }}]\n')
    assert list(plan.parts.prompts["more"].blocks)[-2:] == ["state.time_gap", "C5"]
    assert "\n\nTime gap (" in prompt(plan, "more")


def test_what_is_added_after_a_block_stands_behind_what_earlier_prompts_added_there(plan_of):
    added = '{{ after = "C3.human", text = "You {}." }}'
    plan = plan_of(
        '[factors]\nprompt = ["late"]\nmood = ["calm", "angry"]\n'
        f"[prompts.taxi]\nadd = [{added.format('drive a taxi')}]\n"
        '[prompts.late]\nbased_on = "taxi"\n'
        f"add = [{added.format('hurry')}, {added.format('are late')}]\n"
        f"[texts.mood.angry]\nadd = [{added.format('are angry')}]\n"
    )
    lines = prompt(plan, "late mood=angry").split("\n\n")
    place = lines.index("You drive a taxi.")
    assert lines[place - 1].startswith("Drive the way a human driver")
    # Of one list the second stands first.
    assert lines[place + 1 : place + 4] == ["You are late.", "You hurry.", "You are angry."]


def test_an_edited_prompt_is_another_spec_at_once(plan_of):
    texts = ["You are late.", "You are early."]
    plans = [plan_of(persona(text)) for text in texts]
    specs = [plan.trial_specs()[0].spec_hash for plan in plans]
    assert specs[0] != specs[1]
    for plan, text in zip(plans, texts, strict=True):
        assert [each in prompt(plan, "taxi") for each in texts] == [each == text for each in texts]


def test_blocks_are_removed_replaced_and_moved_and_their_place_is_in_the_hash(plan_of):
    plan = plan_of(
        '[factors]\nprompt = ["other"]\n[prompts.other]\nbased_on = "A2"\n'
        'remove = ["C3.safety", "C4"]\nreplace = { "C3.human" = "Drive like a robot." }\n'
        'add = [{ after = "C0", block = "C4" }]\n'
    )
    rest = [name for name in blocks_of("A2") if name not in ("C0", "C3.safety", "C4")]
    assert list(plan.parts.prompts["other"].blocks) == ["C0", "C4", *rest]
    assert "Drive like a robot." in prompt(plan, "other")
    moved = 'remove = ["C4"]\nadd = [{ after = "C0", block = "C4" }]\n'
    plan = plan_of(f'[factors]\nprompt = ["other"]\n[prompts.other]\n{moved}')
    assert plan.parts.prompts["other"].digests != prompt_of("baseline").digests


OWN = """conditions = ["all",
    {{ name = "X", projected_headway_m = 1, relative_velocity_mps = 0.5, mean_speed_mps = {speed} }}
]
"""


def test_an_own_condition_is_played_and_another_mean_speed_is_another_spec(plan_of):
    specs = []
    for speed in (10.0, 12.0):
        plan = plan_of(OWN.format(speed=speed), head="repetitions = 1\n")
        assert len(plan.conditions) == 11 + 1
        (spec,) = (spec for spec in plan.trial_specs() if spec.condition == "X")
        assert spec.kinematics.speeds_mps[0] == speed + 0.25
        specs.append(spec)
    assert len({spec.spec_hash for spec in specs}) == 2
    plain = make_plan("baseline", "emulator").trial_specs()[0].spec_hash
    assert specs[0].spec_hash == plain  # its headway and velocity stand in the trial's row


def test_a_plug_in_beside_the_study_drives_and_another_revision_is_another_driver(plan_of):
    text = '[plugins]\nfiles = ["mine.py"]\n'
    hashes, plain = [], deciding(HELD)
    revised = deciding(HELD, within="revision = 2")
    for plugin in (plain, f"# why\n{plain}", revised):
        plan = plan_of(text, ["braking"], plugin=plugin)
        hashes.append(plan.trial_specs()[0].spec_hash)
    assert hashes[0] == hashes[1] != hashes[2]
    assert plan.model_dump(mode="json")["study"]["plugins"] == {"mine.py": revised}


def test_what_a_plug_in_imports_is_no_part_of_its_study(plan_of, tmp_path, monkeypatch):
    """Also where it needs a path that the plug-in adds."""
    colours, register = Registry("colour"), "import sys\nsys.colours.register({!r}, 1)\n"
    monkeypatch.setattr(sys, "colours", colours, raising=False)
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    (tmp_path / "imported_by_a_plug_in.py").write_text(register.format("elsewhere"))
    (tmp_path / "beside").mkdir()
    (tmp_path / "beside/found_by_its_path.py").touch()
    own = f"sys.path.insert(0, {str(tmp_path / 'beside')!r})\nimport found_by_its_path\n"
    own = register.format("own") + own + "import imported_by_a_plug_in\n"
    plan = plan_of('[plugins]\nfiles = ["mine.py"]\n', plugin=own)
    with using(plan.parts.catalogue):
        assert {*colours} == {"elsewhere", "own"}
    assert [*colours] == ["elsewhere"]


def first_action(plan):
    trial = TrialMaker(plan).make(plan.trial_specs()[0])
    return play_trial(trial, None).decisions[0].decision.applied[0]


def test_what_a_function_of_a_plug_in_imports_is_imported_when_it_is_called(
    plan_of, tmp_path, monkeypatch
):
    """Its siblings are those of its study, also where another study has some of the same name."""
    package = tmp_path / "imported_late"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "more.py").write_text("FACTOR = 0.5\n")
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    late = f"from .strength import STRENGTH\nfrom {package.name} import more\n"
    late += "return self.context.held(STRENGTH * more.FACTOR)"
    plans, files = {}, '[plugins]\nfiles = ["strength.py", "mine.py"]\n'
    for strength in (-0.2, -0.4):
        (tmp_path / "strength.py").write_text(f"STRENGTH = {strength}\n")
        plans[strength] = plan_of(files, ["braking"], plugin=deciding(late))
    assert package.name not in sys.modules
    assert {strength: first_action(plan) for strength, plan in plans.items()} == {
        strength: strength * 0.5 for strength in plans
    }
    assert f"{package.name}.more" in sys.modules


def test_an_import_that_fails_is_told_in_one_line_with_its_first_reason(
    plan_of, tmp_path, monkeypatch
):
    """The module is run once: it would register its parts a second time."""
    monkeypatch.setattr(CONDITIONS, "_things", {**CONDITIONS._things})
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    (tmp_path / "fails_late.py").write_text(
        "from merge_runner.plugin import CONDITIONS, Condition\n"
        'CONDITIONS.register("Z", Condition(4, 0))\n'
        "import no_such_module\n"
    )
    with pytest.raises(UsageError) as refused:
        plan_of('[plugins]\nfiles = ["mine.py"]\n', plugin="# why\nimport fails_late\n")
    assert str(refused.value) == (
        "the plug-in mine.py, line 2, fails: ModuleNotFoundError: No module named 'no_such_module'"
    )


@pytest.mark.parametrize(
    "words", ["from {} import drivers", "try:\n    import {}.drivers\nfinally:\n    pass"]
)
def test_a_package_that_plug_ins_import_drives_in_all_studies_of_a_process(
    plan_of, tmp_path, monkeypatch, words
):
    monkeypatch.setattr(PROGRAMS, "_things", {**PROGRAMS._things})
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    package = tmp_path / f"drivers_{len(words)}"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "drivers.py").write_text(deciding(HELD))
    for text in ("", "", "# another study\n"):
        plugin = words.format(package.name)
        plan = plan_of(f'{text}[plugins]\nfiles = ["mine.py"]\n', ["braking"], plugin=plugin)
        assert "braking" in plan.parts.programs
