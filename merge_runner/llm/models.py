"""The models of ``experiments/models.toml``."""

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


def load_models(path: Path | None = None) -> dict[str, ModelEntry]:
    """The entries by name, each with a known format and provider; raises UsageError."""
    load_plugins()  # before the file is read: an error in a plug-in is none of the file's
    path = path or find_experiments() / "models.toml"
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
