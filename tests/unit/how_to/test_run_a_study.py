"""The page about a study's file: every key is there, and every example can be played."""

import re
import tomllib
from dataclasses import fields, is_dataclass

import pytest

from merge_runner.config import Perception, ScenarioConfig, model_in
from merge_runner.run.options import Options
from merge_runner.run.plan import make_plan
from merge_runner.run.sweep import unsent
from merge_runner.study.file import StudyFile
from tests.support.harness import PROJECT

PAGE = (PROJECT / "docs/run-a-study.md").read_text()
PERCEPTION = (PROJECT / "docs/perception.md").read_text()
EXAMPLES = dict(re.findall(r"^## ([^\n]*)\n+```toml\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE))
(EXAMPLES["Perception"],) = re.findall(r"```toml\n(.*?)```", PERCEPTION, re.DOTALL)


def keys(model: type):
    """The keys of a table and of those within it, but the scenario's and the perception's."""
    if is_dataclass(model):
        yield from (field.name for field in fields(model))
        return
    yield from model.model_fields
    for field in model.model_fields.values():
        inner = model_in(field.annotation)
        if inner not in {None, Perception, ScenarioConfig}:
            yield from keys(inner)


def plan_of(folder, example, **asked):
    (folder / "study.toml").write_text(EXAMPLES[example])
    (folder / "plugin.py").touch()
    return make_plan(str(folder / "study.toml"), trust=True, **asked)


@pytest.mark.parametrize(
    ("example", "arms"),
    [
        ("The file", 3),
        ("What varies", 8 + 8 + 4 + 4),  # those against projected-order both ways round
        ("Prompts", 4),
        ("Text factors", 1 + 3 * 2 + 4 * 2),
        ("Perception", 2 * 3),
    ],
)
def test_every_example_can_be_played(example, arms, tmp_path):
    plan = plan_of(tmp_path, example)
    assert len(plan.arms) == arms
    assert len(plan.trial_specs()) == plan.trials


async def test_the_study_of_the_readme_fits_its_cap_with_models_that_answer_in_2027(tmp_path):
    readme = (PROJECT / "README.md").read_text()
    ((text, trials, usd),) = re.findall(
        r"^```toml\n(.*?)^```\n\n(\d+) trials, about (\d+) USD", readme, re.DOTALL | re.MULTILINE
    )
    (tmp_path / "study.toml").write_text(text)
    plan = make_plan(str(tmp_path / "study.toml"))
    options = Options(tmp_path / "db", tmp_path / "cache")
    expected = await unsent(plan, options, say=pytest.fail)
    assert (expected.trials, round(expected.cost_usd)) == (int(trials), int(usd))
    assert expected.cost_usd < plan.study.file.budget["total_usd"]
    for entry in plan.entries.values():
        assert entry.shutdown is None or entry.shutdown.year > 2027


def test_every_key_is_explained_and_shown_in_an_example():
    assert len(EXAMPLES) == PAGE.count("```toml\n") + 1 == 5
    assert re.findall(r"^\| `(\w+)` \|", PERCEPTION, re.MULTILINE) == [*Perception.model_fields]
    explained = re.sub(r"```.*?```", "", PAGE, flags=re.DOTALL)
    shown = "\n".join(EXAMPLES.values())
    for key in keys(StudyFile):
        if key != "name":  # of a condition, and of the scenario
            assert f"`{key}" in explained, key
        assert re.search(rf"\b{key}\b", shown) or key == "text", key
    for text in EXAMPLES.values():
        StudyFile.model_validate(tomllib.loads(text))


def test_combinations_that_skip_names_are_left_out(tmp_path):
    found = [(arm.model, *arm.factors.values()) for arm in plan_of(tmp_path, "What varies").arms]
    assert not [arm for arm in found if "o3" in arm[0] and "0.2" in arm]
    assert not [arm for arm in found if {"A2", "projected-order"} <= {*arm}]
    assert len(found) == len({*found})
