"""The hash of the source of a driver, which may be edited."""

from __future__ import annotations

import ast
import hashlib
import re
import threading
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from importlib.util import find_spec, resolve_name
from io import StringIO
from tokenize import COMMENT, NL, generate_tokens

from merge_runner.errors import UsageError

SHARED = "merge_runner.drivers"
STUDY_PLUGINS = "study_plugins"
"""The package of a study's plug-ins, with a hash behind it: those of two studies are two."""
_OF_A_STUDY = re.compile(rf"{STUDY_PLUGINS}_[0-9a-f]+(?=\.)")
# The registry makes no decision, and what is typed into a notebook is in no file.
WITHOUT = (f"{SHARED}.registry", "__main__")
_PARSING = threading.Lock()


@cache
def source_digest(driver: type) -> str:
    """Return the SHA-256 of the source of a class's module and of all that it imports.

    What it imports counts as far as it belongs to the same top-level package, or to what all
    drivers share; of this program, that alone. Comments, docstrings and blank lines do not count.
    Raises UsageError where there is no source to read.
    """
    top = driver.__module__.partition(".")[0]
    packages = (f"{SHARED}.",) if SHARED.startswith(f"{top}.") else (f"{SHARED}.", f"{top}.")
    sources: dict[str, str] = {}
    waiting = [driver.__module__]
    while waiting:
        name = waiting.pop()
        module = None
        if name not in {*sources, *WITHOUT} and f"{name}.".startswith(packages):
            with suppress(ModuleNotFoundError, ValueError):  # it may be something within a module
                module = find_spec(name)
        if module is not None:
            read = getattr(module.loader, "get_source", None)
            source = read(name) if read else None
            if source is None:
                raise UsageError(f"the source of {name} is not there, and is needed: install it")
            sources[name] = source
            is_package = module.submodule_search_locations is not None
            waiting += _imported(source, name if is_package else name.rpartition(".")[0])
    if driver.__module__ not in sources:
        raise UsageError(
            f"the source of {driver.__qualname__} cannot be found, as that of a class of a "
            "notebook or a script: put it into a file of its own, such as my_driver.py, and "
            "import it"
        )
    # Each plug-in of a study counts by itself, whatever the others are.
    named = {_OF_A_STUDY.sub(STUDY_PLUGINS, name): source for name, source in sources.items()}
    code = [(name, code_of(source)) for name, source in sorted(named.items())]
    return hashlib.sha256(repr(code).encode()).hexdigest()


@cache
def code_of(source: str) -> tuple[str, ...]:
    """Return the lines of a source without comments, docstrings and blank lines.

    Only positions are taken from the parser, since its trees differ between versions of Python.
    """
    text = StringIO(source, newline=None).read()
    lines = text.split("\n")
    dropped = set()
    for token in generate_tokens(StringIO(text).readline):
        row, column = token.start
        if token.type == COMMENT:
            lines[row - 1] = lines[row - 1][:column].rstrip()
        elif token.type == NL and not lines[row - 1].strip():
            dropped.add(row)
    for node in ast.walk(parsed(text)):
        if not isinstance(node, ast.Expr) or not isinstance(node.value, ast.Constant):
            continue
        first, last = node.lineno, node.end_lineno or node.lineno
        around = lines[first - 1].encode()[: node.col_offset]
        around += lines[last - 1].encode()[node.end_col_offset :]
        if isinstance(node.value.value, str) and not around.strip():
            dropped.update(range(first, last + 1))
    return tuple(line for row, line in enumerate(lines, 1) if row not in dropped)


def parsed(source: str) -> ast.Module:
    """The tree of a source, made by one thread at a time: Python 3.11 counts the depth for all."""
    with _PARSING:
        return ast.parse(source)


def _imported(source: str, package: str) -> Iterator[str]:
    """What a module of a package may import, also within functions."""
    for node in ast.walk(parsed(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            whole = resolve_name("." * node.level + (node.module or ""), package)
            yield whole
            yield from (f"{whole}.{alias.name}" for alias in node.names)
