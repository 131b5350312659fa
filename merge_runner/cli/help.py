"""The help of commands as plain text in groups.

Typer draws it with rich, whose import takes twice as long as all else that ``--help`` needs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import typer
from typer.core import TyperCommand, TyperGroup

CommandT = TypeVar("CommandT", bound=Callable[..., Any])


def _write_groups(command: TyperCommand | TyperGroup, ctx: Any, formatter: Any) -> None:  # noqa: ANN401 # Typer keeps their types to itself
    """Write arguments, options and commands, each under the title of its group."""
    groups: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
    for param in command.get_params(ctx):
        usual = "Arguments" if param.param_type_name == "argument" else "Options"
        if record := param.get_help_record(ctx):
            name, _, _ = record[0].partition(" <")  # without the type of an argument
            panel = getattr(param, "rich_help_panel", None) or usual
            groups.setdefault(panel, []).append((name, record[1]))
    for name, listed in getattr(command, "commands", {}).items():
        summary = (listed.help or "").partition("\n\n")[0]
        groups.setdefault(listed.rich_help_panel or "Commands", []).append((name, summary))
    for title, rows in groups.items():
        if rows:
            with formatter.section(title):
                formatter.write_dl(rows)


class _Command(TyperCommand):
    format_options = _write_groups


class _Group(TyperGroup):
    format_options = _write_groups


class Program(typer.Typer):
    """Commands whose help is plain text."""

    def __init__(self, **settings: Any) -> None:  # noqa: ANN401 # as Typer's
        super().__init__(cls=_Group, rich_markup_mode=None, no_args_is_help=True, **settings)

    def command(self, name: str | None = None, **settings: Any) -> Callable[[CommandT], CommandT]:  # noqa: ANN401 # as Typer's
        """Add a command, as Typer does."""
        return super().command(name, cls=_Command, **settings)
