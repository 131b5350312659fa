"""Docstrings, comments and identifiers of the sources use the field's words in plain order."""

import ast
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.harness import PROJECT

SOURCES = (
    *(PROJECT / "merge_runner").rglob("*.py"),
    *(PROJECT / "analysis").rglob("*.py"),
    *(PROJECT / "benchmarks").rglob("*.py"),
)
# Everyday words in place of terms, and relative clauses in place of nouns.
PHRASES = re.compile(
    r"\b(told|singly|set aside|heeds?|dearest|both ways round|stand-ins?|nobody listens"
    r"|(is|are) due|(becomes?|became) of|comes? to|stands? (beside|with)"
    r"|(is|are|was) there already|what (is|was|it|a|the|they) \w+ (is|was|are|of|to))\b",
    re.IGNORECASE,
)
# A summary begins with a verb or a noun.
OPENERS = re.compile(r"(what|how|whether|of|where|who|when|which|those|that)\b", re.IGNORECASE)
# Names without a type or a role.
NAMES = {
    *("found", "one", "each", "told", "said", "own", "there", "here", "beside", "wanted", "held"),
    *("mine", "behind", "placed"),
}
# A key of perceptions in study files, and a method that plug-ins call.
PROMISED = {("config.py", "own"), ("base.py", "held")}


def identifiers(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield (line, name) for each name that a source defines: variables, parameters, functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.lineno, node.name


def docstrings(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield (line, text) for each docstring, also of a constant."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            yield node.lineno, str(node.value.value)


def comments(path: Path) -> Iterator[tuple[int, str]]:
    """Yield (line, text) for each comment."""
    with path.open("rb") as file:
        for token in tokenize.tokenize(file.readline):
            if token.type == tokenize.COMMENT and "noqa" not in token.string:
                yield token.start[0], token.string


def faults(path: Path) -> Iterator[str]:
    """Yield what a source has of the refused names, openers and phrases."""
    tree = ast.parse(path.read_bytes())
    texts = [*docstrings(tree)]
    for line, name in identifiers(tree):
        if name in NAMES and (path.name, name) not in PROMISED:
            yield f"{path}:{line}: the name {name}"
    for line, text in texts:
        if opener := OPENERS.match(text):
            yield f"{path}:{line}: a docstring that begins with {opener[0]}"
    for line, text in [*texts, *comments(path)]:
        if phrase := PHRASES.search(text):
            yield f"{path}:{line}: {phrase[0]}"


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PROJECT)))
def test_a_source_uses_plain_words(path):
    assert [*faults(path)] == []
