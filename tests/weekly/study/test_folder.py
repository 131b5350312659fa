"""The commands that a new study names."""

import re
import shlex
import subprocess

from merge_runner.study.file import write_folder


async def test_the_commands_of_its_readme_and_its_makefile_work(merge_runner, tmp_path):
    study = tmp_path / "mine"
    write_folder(study)
    (block,) = re.findall(r"```sh\n(.*?)```", (study / "README.md").read_text(), re.DOTALL)
    assert "pip install merge_runner-*.whl " in block  # as the project's own README says
    commands = [shlex.split(line, comments=True) for line in block.splitlines()]
    ours = [words[1:] for words in commands if words[0] == "merge-runner" and words[1] != "view"]
    assert len(ours) >= 8
    for words in ours:
        await merge_runner(*words, cwd=study, code=0)
    asked = ("sweep", "replay", "tables", "report", "view")
    targets = subprocess.run(
        ["make", "--no-print-directory", "-n", *asked, "ARGS=--db x"],
        cwd=study, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert targets.stdout.splitlines() == [
        "merge-runner sweep study.toml --db x",
        "merge-runner replay study.toml --db x",
        "merge-runner tables --study study.toml --db x",
        "merge-runner report --study study.toml --db x",
        "merge-runner view --study study.toml --db x",
    ]
