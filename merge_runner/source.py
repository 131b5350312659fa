"""The hash of the source of a driver, which may be edited."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Callable, Iterator
from functools import cache
from importlib.util import find_spec, resolve_name
from typing import Any

from merge_runner.errors import UsageError


@cache
def source_digest(made: Callable[..., Any], ours: str = "", without: str = "") -> str:
    """SHA-256 of the source of the module of a class or function, and of all that it imports.

    What it imports counts as far as it belongs to the same package: to ``ours``, a part of this
    program, or else to the top-level package of somebody else. The module ``without`` never does.
    A change of the layout alone is a change, too. Raises UsageError where there is no source to
    read.
    """
    top = made.__module__.partition(".")[0]
    package = ours if ours.startswith(f"{top}.") else top
    sources: dict[str, str] = {}
    waiting = [made.__module__]
    while waiting:
        name = waiting.pop()
        if name not in {*sources, without} and f"{name}.".startswith(f"{package}."):
            source = _source(name)
            if source is not None:
                sources[name] = source
                waiting += _imported(name, source)
    if made.__module__ not in sources:
        raise UsageError(f"{made.__qualname__} is in no module of its own")
    return hashlib.sha256(repr(sorted(sources.items())).encode()).hexdigest()


def _source(name: str) -> str | None:
    """The source of a module; None where the name is that of something within one."""
    try:
        found = find_spec(name)
    except (ModuleNotFoundError, ValueError):
        return None
    if found is None:
        return None
    read = getattr(found.loader, "get_source", None)
    source: str | None = read(name) if read else None
    if source is None:
        raise UsageError(f"the source of {name} is not there, and is needed: install that too")
    return source


def _imported(name: str, source: str) -> Iterator[str]:
    """What a module may import, also within functions."""
    found = find_spec(name)
    assert found is not None
    package = name if found.submodule_search_locations is not None else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            whole = resolve_name("." * node.level + (node.module or ""), package)
            yield whole
            yield from (f"{whole}.{alias.name}" for alias in node.names)
