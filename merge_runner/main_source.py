"""The source of what a notebook or a script defines, which has no module of its own to read."""

from __future__ import annotations

import ast
import dis
import inspect
import sys
from collections.abc import Callable, Iterator
from textwrap import dedent
from types import CodeType, ModuleType

from merge_runner.errors import UsageError

MAIN = "__main__"
Definition = ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
NAMED = ("LOAD_NAME", "LOAD_GLOBAL", "LOAD_FROM_DICT_OR_GLOBALS")


def main_source(made: type) -> dict[str, str]:
    """The source of a class of ``__main__`` by its name, and of all there that it rests on.

    These are the classes and functions of other cells, and the values of constants. What is
    imported counts by its name alone. Raises UsageError for anything else, such as an array, whose
    changes cannot be told.
    """
    there = vars(sys.modules[MAIN])
    sources: dict[str, str] = {}
    waiting: list[tuple[str, object]] = [(made.__name__, made)]
    while waiting:
        name, thing = waiting.pop()
        if name in sources:
            continue
        if _is_here(thing):
            sources[name] = text = _text(thing)
            waiting += ((n, there[n]) for n in _globals(compile(text, name, "exec")) if n in there)
        else:
            sources[name] = _named(made, name, thing)
    return sources


def _is_here(thing: object) -> bool:
    return callable(thing) and getattr(thing, "__module__", "") == MAIN


def _named(made: type, name: str, thing: object) -> str:
    """What stands for something that is no code of ``__main__``."""
    if isinstance(thing, ModuleType):
        return thing.__name__
    if callable(thing) and hasattr(thing, "__name__"):
        return f"{getattr(thing, '__module__', '')}.{thing.__name__}"
    try:
        if ast.literal_eval(repr(thing)) == thing:
            return repr(thing)
    except (ValueError, SyntaxError):
        pass
    raise UsageError(
        f"{made.__name__} rests on {name}, a {type(thing).__name__} whose changes cannot be told: "
        "use numbers, texts, lists and dicts of them, or make it within the class"
    )


def _text(thing: object) -> str:
    """The lines that define a class or a function."""
    members = vars(thing).values() if isinstance(thing, type) else [thing]
    for member in members:
        code = _code(member)
        if code is None:
            continue
        try:
            lines, _ = inspect.findsource(code)
        except OSError:  # made by a decorator
            continue
        for node in ast.walk(ast.parse("".join(lines))):
            if isinstance(node, Definition) and _defines(node, thing, code):
                first = _first_line(node)
                return dedent("".join(lines[first - 1 : node.end_lineno]))
    raise UsageError(
        f"the source of {getattr(thing, '__name__', thing)} is not known: write it in a cell, a "
        "class with a method of its own"
    )


def _code(member: object) -> CodeType | None:
    """The code of a function, whatever it is wrapped in."""
    inner = getattr(member, "fget", None) or getattr(member, "__func__", member)
    if not callable(inner):
        return None
    unwrapped: Callable[..., object] = inspect.unwrap(inner)
    return getattr(unwrapped, "__code__", None)


def _defines(node: Definition, thing: object, code: CodeType) -> bool:
    """Whether this is the definition of a class that has this code, or of the code's function."""
    if isinstance(thing, type):
        within = node.lineno <= code.co_firstlineno <= (node.end_lineno or 0)
        return isinstance(node, ast.ClassDef) and node.name == thing.__name__ and within
    return node.name == code.co_name and _first_line(node) == code.co_firstlineno


def _first_line(node: Definition) -> int:
    return min((each.lineno for each in node.decorator_list), default=node.lineno)


def _globals(code: CodeType) -> Iterator[str]:
    """The names that code looks up outside of its functions."""
    for step in dis.get_instructions(code):
        if step.opname in NAMED:
            yield str(step.argval)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _globals(constant)
