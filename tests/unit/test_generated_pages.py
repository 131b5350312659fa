"""The pages of the docs that are generated from the program.

``python -m tests.unit.test_generated_pages --write`` writes them.
"""

import re
import sys
from collections.abc import Iterator

import pytest
import typer
import typer.main

from merge_runner.cli import complete_app
from merge_runner.config import ScenarioConfig
from merge_runner.llm.models import read_models
from merge_runner.prompts.blocks import BLOCKS, FIELDS, VARIANTS, Situation
from merge_runner_analysis.figures import FIGURES
from merge_runner_analysis.tables import TABLES
from tests.support.harness import PROJECT, asked_to_write
from tests.support.prompts import FIRST

WIDTH = 80
COMMANDS = """\
# Commands

Generated from the program's help. `make` wraps the commands used most and installs what they need;
`ARGS="..."` passes options on. `merge-runner --install-completion` lets your shell complete
commands and options. [Exit codes](reliability.md#exit-codes);
[keys and base URLs](models.md#endpoints-and-keys).

| target | does |
|---|---|
"""
PROMPT_BLOCKS = """\
# Prompt blocks

Generated from `merge_runner/prompts/blocks.py`. A [study](run-a-study.md#prompts) names these
blocks, and these fields in braces. Values are those of the left driver at the start of `L_4_-8`, in
m, s and m/s unless the name or the value has another unit. Double a brace that is meant as one.
`distance_to_merge` exists before the merge point only. Fields on the other car are `not seen` while
it is out of sight.

## Fields

| field | value |
|---|---|
"""
SHOWN = {
    "tables": ("table", {name: table.about for name, table in TABLES.items()}),
    "figures": ("figure", {name: figure.shows for name, figure in FIGURES.items()}),
}
MODELS = (
    "# Model list\n\nGenerated from `experiments/models.toml`. `merge-runner models` adds prices "
    "and keys. RPM and TPM are requests and\ntokens a minute of a common paid tier.\n\n"
    "| name | provider | format | id | parameters | rejects | output tokens | RPM | TPM | shutdown "
    "| successor |\n" + "|---" * 11 + "|\n"
)


def _commands() -> Iterator[str]:
    yield COMMANDS
    targets = re.findall(r"^([a-z-]+):.*## (.*)", (PROJECT / "Makefile").read_text(), re.MULTILINE)
    yield from (f"| `make {target}` | {does} |\n" for target, does in targets)
    whole = typer.main.get_command(complete_app())
    root = typer.Context(
        whole,
        info_name="merge-runner",
        terminal_width=WIDTH,
        help_option_names=["-h", "--help"],
    )
    yield _help(root, "merge-runner")
    for name, command in whole.commands.items():
        of_command = typer.Context(command, info_name=name, parent=root)
        yield _help(of_command, name)
        if name in SHOWN:
            kind, shown = SHOWN[name]
            yield f"\n| {kind} | shows |\n|---|---|\n"
            yield from (f"| `{key}` | {about} |\n" for key, about in shown.items())
        for part, inner in getattr(command, "commands", {}).items():
            within = typer.Context(inner, info_name=part, parent=of_command)
            yield _help(within, f"{name} {part}")


def _help(ctx: typer.Context, title: str) -> str:
    text = "\n".join(line.rstrip() for line in ctx.command.get_help(ctx).splitlines())
    if title == "replay":
        text = (
            text.partition("\n\nOptions:")[0] + "\n\nOptions: those of sweep that concern a replay."
        )
    return f"\n## {title}\n\n```text\n{text}\n```\n"


def _prompt_blocks() -> Iterator[str]:
    now = Situation(FIRST, ScenarioConfig(), None, first=True)
    values = {name: field(now) for name, field in FIELDS.items()}
    yield PROMPT_BLOCKS
    yield from (f"| `{name}` | {value} |\n" for name, value in values.items())
    yield "\n## Variants\n\n| variant | without | title |\n|---|---|---|\n"
    for name in ("baseline", *(f"A{number}" for number in range(1, 8))):
        variant = VARIANTS[name]
        removed = ", ".join(f"`{block}`" for block in sorted(variant.removes)) or "–"
        yield f"| `{name}` | {removed} | {variant.title} |\n"
    ready = [name for name in BLOCKS if name.startswith("state.")]
    paper = [name for name in BLOCKS if name not in ready]
    for title, names in (("The baseline", paper), ("Ready blocks, in no prompt by default", ready)):
        yield f"\n## {title}\n"
        for name in names:
            block = BLOCKS[name]
            roads = {"before the merge point": block.merge, "after it": block.straight}
            if block.merge == block.straight:
                roads = {"on both roads": block.merge}
            for road, template in roads.items():
                if template is not None:
                    text = template.format_map(values)
                    yield f"\n`{name}`, {block.meaning}, {road}:\n\n```text\n{text}\n```\n"


def _model_list() -> Iterator[str]:
    yield MODELS
    for name, entry in read_models(PROJECT / "experiments/models.toml").items():
        given = [
            "a grammar" if key == "grammar" else f"{key} = {value}"
            for key, value in entry.parameters.items()
        ]
        cells = (
            *(f"`{each}`" for each in (name, entry.provider, entry.format, entry.id)),
            *(", ".join(given), ", ".join(entry.rejects), entry.max_output_tokens),
            *(entry.rpm or "", entry.tpm or "", entry.shutdown or "", entry.successor),
        )
        yield f"| {' | '.join(map(str, cells))} |\n"


PAGES = {"commands": _commands, "prompt-blocks": _prompt_blocks, "model-list": _model_list}


@pytest.mark.parametrize("name", PAGES)
def test_a_generated_page_is_what_the_program_says(name):
    assert (PROJECT / f"docs/{name}.md").read_text("utf-8") == "".join(PAGES[name]())


def test_every_option_says_what_it_does():
    for name, command in typer.main.get_command(complete_app()).commands.items():
        for inner in getattr(command, "commands", {"": command}).values():
            for param in inner.params:
                if not getattr(param, "hidden", False):
                    assert len(param.help.split()) > 1, f"{name}: {param.name}"


def main(*arguments: str) -> None:
    asked_to_write(arguments, "docs/commands.md, docs/prompt-blocks.md and docs/model-list.md anew")
    for name, make in PAGES.items():
        (PROJECT / f"docs/{name}.md").write_text("".join(make()), "utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
