"""The models of ``experiments/models.toml``, and those that a user adds to them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import date
from pathlib import Path

from merge_runner.config import (
    ModelEntry,
    endpoint_identity,
    experiments,
    model_id,
    read_toml,
    validated,
)
from merge_runner.errors import UsageError
from merge_runner.llm.formats import FORMATS
from merge_runner.registry import load_plugins
from merge_runner.text_safety import one_line

REGISTRY = "models.toml"
SOON_DAYS = 30
HOW_TO_RECORD = "docs/how-to/record-before-shutdown.md"


def load_models(beside: Path | None = None) -> dict[str, ModelEntry]:
    """Return the entries by name, each with a known format and provider; raises UsageError.

    Those of a ``models.toml`` in the working directory, in its ``experiments``, or ``beside`` a
    study are added to those that ship, and take the place of those of the same name.
    """
    load_plugins()  # before the file is read: an error in a plug-in is none of the file's
    entries: dict[str, ModelEntry] = {}
    for path in registry_files(beside):
        entries |= read_models(path)
    return entries


def registry_files(beside: Path | None = None) -> list[Path]:
    """Return the files of ``load_models``, in order: an entry takes the place of an earlier one."""
    folders = [*reversed(experiments()), Path(), *([] if beside is None else [beside])]
    return [path for path in dict.fromkeys(each / REGISTRY for each in folders) if path.is_file()]


def read_entries(path: Path) -> dict[str, ModelEntry]:
    """Return the entries of one file, whose formats and providers may be unknown.

    Raises UsageError.
    """
    return {
        name: validated(ModelEntry, table, _where(path, name))
        for name, table in read_toml(path).items()
    }


def read_models(path: Path) -> dict[str, ModelEntry]:
    """Return the entries of one file; raises UsageError."""
    entries = read_entries(path)
    for name, entry in entries.items():
        try:
            FORMATS.require(entry.format)
            endpoint_identity(entry, {})
            if "id" not in entry.model_fields_set and model_id(entry, {}) is not None:
                raise UsageError("`id` is missing: the model's name at the provider")
        except UsageError as exc:
            raise UsageError(one_line(f"{_where(path, name)}: {exc}")) from exc
    return entries


def shutdown_notes(entries: Mapping[str, ModelEntry], today: date) -> Iterator[str]:
    """Yield, for each model with an announced shutdown, when that is and what to do."""
    for name, entry in entries.items():
        if entry.shutdown is None:
            continue
        days = (entry.shutdown - today).days
        successor = f"; its successor is {entry.successor}" if entry.successor else ""
        closes = f"{name} closes in {days} day{'s' * (days != 1)}, on {entry.shutdown}"
        if days <= 0:
            closed = f"{name} closed on {entry.shutdown}: only a recording answers for it"
            yield f"WARNING: {closed} (replay --recording FILE){successor}"
        elif days <= SOON_DAYS:
            yield f"WARNING: {closes}: record it now ({HOW_TO_RECORD}){successor}"
        else:
            yield f"note: {closes}{successor}"


def _where(path: Path, name: str) -> str:
    return f"{path}: [{name}]"
