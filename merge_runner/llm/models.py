"""The models of ``experiments/models.toml``, and those that a user adds to them."""

from __future__ import annotations

from pathlib import Path

from merge_runner.config import (
    ModelEntry,
    endpoint_identity,
    find_experiments,
    model_id,
    read_toml,
    validated,
)
from merge_runner.errors import UsageError
from merge_runner.llm.formats import FORMATS
from merge_runner.registry import load_plugins
from merge_runner.text_safety import one_line

REGISTRY = "models.toml"


def load_models(beside: Path | None = None) -> dict[str, ModelEntry]:
    """The entries by name, each with a known format and provider; raises UsageError.

    Those of a ``models.toml`` in the working directory, or ``beside`` a study, are added to the
    registry, and take the place of those of the same name.
    """
    load_plugins()  # before the file is read: an error in a plug-in is none of the file's
    own = find_experiments() / REGISTRY
    added = dict.fromkeys((folder or Path()) / REGISTRY for folder in (None, beside))
    entries: dict[str, ModelEntry] = {}
    for path in (own, *(each for each in added if each.is_file() and each != own)):
        entries |= read_models(path)
    return entries


def read_models(path: Path) -> dict[str, ModelEntry]:
    """The entries of one file; raises UsageError."""
    entries = {}
    for name, table in read_toml(path).items():
        where = f"{path}: [{name}]"
        entry = entries[name] = validated(ModelEntry, table, where)
        try:
            FORMATS.require(entry.format)
            endpoint_identity(entry, {})
            if "id" not in entry.model_fields_set and model_id(entry, {}) is not None:
                raise UsageError("`id` is missing: the model's name at the provider")
        except UsageError as exc:
            raise UsageError(one_line(f"{where}: {exc}")) from exc
    return entries
