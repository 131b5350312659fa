"""The docs and the program name the same things, and links lead somewhere."""

import re
from pathlib import Path

import typer.main

from merge_runner import plugin
from merge_runner.cli import complete_app
from merge_runner.study.file import TEMPLATE
from merge_runner_analysis.published import published
from tests.support.harness import PROJECT

DOCS = PROJECT / "docs"
PAGES_OF_THE_PROGRAM = ("commands", "model-list", "promises", "prompt-blocks", "python", "tables")
PAGES = [PROJECT / "README.md", *PROJECT.glob("analysis/research/*/README.md"), *DOCS.rglob("*.md")]
GENERATED = {DOCS / f"{name}.md" for name in PAGES_OF_THE_PROGRAM}
WRITTEN = [PROJECT / "README.md", *sorted({*DOCS.glob("*.md")} - GENERATED)]
# Words of a dialect that a reader would have to learn.
REFUSED = re.compile(
    r"\b(told|singly|set aside|(is|are) due|becomes? of|comes? to|stands? beside|heeds?|dearest)\b"
)
STABLE = {"merge_runner", "merge_runner.plugin"}
LINKING = [*PAGES, *PROJECT.glob("*.md"), *PROJECT.glob("*/README.md")]


def test_every_command_and_every_make_target_is_in_the_docs():
    text = "\n".join(page.read_text() for page in PAGES)
    command = typer.main.get_command(complete_app())
    for name in command.commands:
        assert f"merge-runner {name}" in text or f"make {name}" in text, name
    targets = re.findall(r"^([a-z]+):.*## ", (PROJECT / "Makefile").read_text(), re.MULTILINE)
    for target in targets:
        assert f"make {target}" in text, target


def test_what_a_person_reads_is_short_and_in_plain_words():
    words = {page: len(page.read_text().split()) for page in WRITTEN}
    assert sum(words.values()) <= 20_000, words
    assert len(words) <= 22
    assert len((PROJECT / "README.md").read_text().split()) <= 900
    assert len((PROJECT / "CONTRIBUTING.md").read_text().split()) <= 700
    for page in [*WRITTEN, PROJECT / "CONTRIBUTING.md", PROJECT / "SECURITY.md"]:
        assert not REFUSED.search(page.read_text()), (page.name, REFUSED.search(page.read_text()))
        # A block whose lines are run together is no command that can be copied.
        assert not re.search(r"```\w+ \S", page.read_text()), page.name


def test_plug_ins_and_notebooks_of_the_docs_import_stable_names_of_the_runner_alone():
    pages = [DOCS / "extend.md", TEMPLATE / "plugin.py", *DOCS.glob("notebooks/*.ipynb")]
    text = "\n".join(page.read_text() for page in pages)
    assert {*re.findall(r"from (merge_runner(?:\.[\w.]+)?) import", text)} == STABLE
    used = text + (DOCS / "python.md").read_text()
    assert not [name for name in plugin.__all__ if not re.search(rf"\b{name}\b", used)]


def test_sentences_of_the_docs_are_short():
    lengths = []
    for page in WRITTEN:
        text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
        prose = [line for line in text.splitlines() if line[:1] not in {"|", "#", "!"}]
        sentences = re.split(r"(?<=[.!?:;])\s+|\n\n|\n *- ", "\n".join(prose))
        lengths += [len(sentence.split()) for sentence in sentences if sentence.strip()]
    assert sum(lengths) / len(lengths) <= 14
    assert sum(length > 25 for length in lengths) <= 3  # formulas and code


def test_every_page_is_in_the_index():
    index = (DOCS / "README.md").read_text()
    for page in {*DOCS.glob("*.md")} - {DOCS / "README.md"}:
        assert f"({page.name})" in index, page.name


def test_the_readings_of_the_docs_are_those_of_the_report():
    text = (PROJECT / "docs/reproduction.md").read_text(encoding="utf-8")
    shown = [line for line in text.splitlines() if line.startswith("| ")][1:]
    readings = published("readings").itertuples(index=False)
    assert shown == ["| " + " | ".join(c.replace("|", r"\|") for c in r) + " |" for r in readings]


def test_the_files_and_functions_that_the_design_names_are_there():
    folders = (PROJECT / "merge_runner", PROJECT / "analysis/merge_runner_analysis")
    named = re.findall(
        r"([\w/]+\.py)(?::(\w+(?:, \w+\b(?![/.]))*))?", (DOCS / "design.md").read_text()
    )
    assert len(named) > 50
    for path, functions in named:
        source = "".join(f.read_text() for base in folders if (f := base / path).exists())
        assert source, path
        for name in re.findall(r"\w+", functions):
            assert re.search(rf"^ *(async def|def|class|) ?{name}\b", source, re.M), (path, name)


def anchors(page: Path) -> set[str]:
    """What a link into a page can name: its headings, as GitHub spells them."""
    headings = re.findall(r"^#+ (.*)", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h).strip().lower().replace(" ", "-") for h in headings}


def test_links_of_the_docs_lead_somewhere():
    for page in LINKING:
        for target in re.findall(r"\]\((?!http)([^)]+)", page.read_text()):
            path, _, heading = target.partition("#")
            to = page.parent / path if path else page
            assert to.exists(), f"{page}: {target}"
            assert not heading or heading in anchors(to), f"{page}: {target}"
        for path in re.findall(r"`((?:merge_runner|analysis|tests)/[\w./]+)`", page.read_text()):
            assert (PROJECT / path).exists(), f"{page}: {path}"
