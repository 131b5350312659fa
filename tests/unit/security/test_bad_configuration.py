"""Whatever is wrong with a file: one line that says what is valid."""

from pathlib import Path

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.errors import UsageError
from merge_runner.llm.models import read_models
from merge_runner.providers import ModelEntry, Price
from merge_runner.run.plan import make_plan
from merge_runner.study.file import StudyFile
from tests.support.bad_configuration import BASELINE, CASES, NO_TEXT, with_line


@pytest.fixture
def files(tmp_path, monkeypatch):
    """The study ``mine.toml`` and its registry, both right."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "models.toml").write_text(with_line("rpm = 5"))
    (tmp_path / "mine.toml").write_text(BASELINE)
    return tmp_path


def registry():
    return read_models(Path("models.toml"))


def plan():
    return make_plan("mine.toml", "m")


def refusal(read):
    with pytest.raises(UsageError) as refused:
        read()
    (line,) = str(refused.value).splitlines()
    assert line.isprintable()
    return line


@pytest.mark.parametrize(
    ("content", "says"),
    [
        *((with_line(line).encode(), says) for line, says in CASES["model"].items()),
        *((text.encode(), says) for text, says in CASES["registry"].items()),
        *NO_TEXT.items(),
    ],
    ids=[*CASES["model"], *CASES["registry"], *"012"],
)
def test_a_registry_that_is_wrong(files, content, says):
    (files / "models.toml").write_bytes(content)
    line = refusal(registry)
    assert says in line
    assert line.startswith("models.toml")


@pytest.mark.parametrize(
    ("content", "says"),
    [
        *(
            ((line if line.startswith("repetitions") else f"{BASELINE}\n{line}").encode(), says)
            for line, says in CASES["study"].items()
        ),
        *(
            (f"{BASELINE}\n[scenario]\n{line}".encode(), says)
            for line, says in CASES["scenario"].items()
        ),
        (b"", "repetitions: Field required"),
        *list(NO_TEXT.items())[:2],
    ],
    ids=[*CASES["study"], *CASES["scenario"], "nothing", *"01"],
)
def test_a_sweep_that_is_wrong(files, content, says):
    (files / "mine.toml").write_bytes(content)
    assert says in refusal(plan)


@pytest.mark.parametrize(
    ("file", "content", "owner"),
    [
        ("models.toml", with_line("x = 5"), ModelEntry),
        ("models.toml", with_line('price = { input = 1, output = 2, source = "s", x = 1 }'), Price),
        ("mine.toml", f"{BASELINE}\nx = 1", StudyFile),
        ("mine.toml", f"{BASELINE}\n[scenario]\nx = 1", ScenarioConfig),
    ],
)
def test_an_unknown_key_is_answered_with_all_that_are_valid(files, file, content, owner):
    (files / file).write_text(content)
    read = registry if file == "models.toml" else plan
    assert refusal(read).endswith(f"x'; valid: {', '.join(owner.model_fields)}")


def test_files_with_the_byte_order_mark_of_windows_editors_are_read(files):
    for file in ("models.toml", "mine.toml"):
        (files / file).write_text((files / file).read_text(), encoding="utf-8-sig")
    assert registry()["m"].rpm == 5
    assert plan().study.text == BASELINE
