"""What cannot be a study is refused before anything is asked, in one line with what is valid."""

import tomllib

import pytest

from merge_runner.errors import UsageError
from merge_runner.run.plan import make_plan
from tests.support.braking import BRAKING, HEAD
from tests.support.harness import PROJECT

REFUSED = tomllib.loads((PROJECT / "tests/cases/studies_refused.toml").read_text())


@pytest.mark.parametrize(
    ("name", "near"), [("persona", ""), ("temprature", ". Did you mean temperature?")]
)
def test_an_unknown_factor_is_no_parameter_of_the_emulator(plan_of, name, near):
    with pytest.raises(UsageError) as refused:
        plan_of(f'[factors]\n{name} = ["none", "taxi"]\n')
    likely, _, valid = str(refused.value).partition("; valid: ")
    assert f"words are declared under [texts.{name}.LEVEL]" in likely
    assert "temperature" in valid
    assert valid.endswith(near)
    assert bool(near) == ("Did you mean" in valid)
    assert " x_" not in valid


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_is_refused_in_one_line_with_the_valid_choices(tmp_path, what):
    case = {"models": [], "plugin": None, "whole": False, "braking": False} | REFUSED[what]
    text = case["text"] if case["whole"] else HEAD + case["text"]
    if case["braking"]:
        text += '\n[plugins]\nfiles = ["mine.py"]\n'
        case["plugin"] = BRAKING
    if case["plugin"] is not None:
        (tmp_path / "mine.py").write_text(case["plugin"])
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(UsageError) as refused:
        make_plan(str(tmp_path / "mine.toml"), case["models"], trust=True)
    assert case["says"] in str(refused.value)
    assert "\n" not in str(refused.value)
