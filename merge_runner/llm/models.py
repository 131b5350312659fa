"""Models of the registry, shipped or a user's, and their parameters."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from copy import deepcopy
from datetime import date
from pathlib import Path
from typing import Any

from pydantic import JsonValue

from merge_runner.config import experiments, read_text, toml_of, validated
from merge_runner.errors import UsageError, unknown_name
from merge_runner.llm.formats import FORMATS
from merge_runner.providers import PROVIDERS, ModelEntry, endpoint_identity, model_id
from merge_runner.registry import load_plugins
from merge_runner.text_safety import one_line

REGISTRY = "models.toml"
SOON_DAYS = 30
CAP, EFFORT = "max_output_tokens", "reasoning_effort"


def load_models(study_folder: Path | None = None) -> dict[str, ModelEntry]:
    """Return the entries by name, each with a known format and provider; raise UsageError.

    Entries of a ``models.toml`` in the working directory, in its ``experiments``, or in
    ``study_folder`` join the shipped entries, and replace equal names.
    """
    load_plugins()  # first, so that an error in a plug-in is not reported as the file's
    entries: dict[str, ModelEntry] = {}
    for path in registry_files(study_folder):
        entries |= read_models(path)
    return entries


def registry_files(study_folder: Path | None) -> list[Path]:
    """Return the files of ``load_models``, in order: an entry replaces an earlier one."""
    folders = [*reversed(experiments()), Path(), *([] if study_folder is None else [study_folder])]
    return [
        path for path in dict.fromkeys(folder / REGISTRY for folder in folders) if path.is_file()
    ]


def read_entries(path: Path) -> dict[str, ModelEntry]:
    """Return the entries of one file, whose formats and providers may be unknown.

    Raises UsageError.
    """
    tables = toml_of(read_text(path), str(path)).items()
    return {
        name: validated(ModelEntry, table, f"{path}: [{name}]").with_place(f"[{name}] in {path}")
        for name, table in tables
    }


def read_models(path: Path) -> dict[str, ModelEntry]:
    """Return the entries of one file; raise UsageError."""
    entries = read_entries(path)
    for name, entry in entries.items():
        try:
            FORMATS.require(entry.format)
            endpoint_identity(entry, {})
            if "id" not in entry.model_fields_set and model_id(entry, {}) is not None:
                raise UsageError("`id` is missing: the model's name at the provider")
        except UsageError as exc:
            raise UsageError(one_line(f"{path}: [{name}]: {exc}")) from exc
    return entries


def shutdown_notes(entries: Mapping[str, ModelEntry], today: date) -> Iterator[str]:
    """Yield a line for each model with an announced shutdown: when, and what to do."""
    for name, entry in entries.items():
        if entry.shutdown is None:
            continue
        days = (entry.shutdown - today).days
        closes = f"{name} closes in {days} day{'s' * (days != 1)}, on {entry.shutdown}"
        if days <= 0:
            note = f"WARNING: {name} closed on {entry.shutdown}: only a recording has its replies"
        elif days <= SOON_DAYS:
            note = f"WARNING: {closes}: record it now (docs/recordings.md)"
        else:
            note = f"note: {closes}"
        yield note + (f"; its successor is {entry.successor}" if entry.successor else "")


def known_parameters(entries: Iterable[ModelEntry]) -> set[str]:
    """Return the common names of all parameters that some model takes."""
    return {CAP, EFFORT}.union(
        *(form.parameters for form in FORMATS.values()),
        *(provider.parameters for provider in PROVIDERS.values()),
        *(entry.parameters for entry in entries),
    )


def with_parameter(name: str, entry: ModelEntry, parameter: str, level: JsonValue) -> ModelEntry:
    """Return the entry ``name`` with a parameter set; raise UsageError if the model rejects it.

    The provider's default is not sent.
    """
    if parameter == CAP:
        capped = validated(ModelEntry, {**dict(entry), CAP: level}, name)
        return capped.with_place(entry.place)
    if parameter == EFFORT and entry.efforts:
        if level not in entry.efforts:
            raise unknown_name(f"{EFFORT} of {name}", str(level), entry.efforts)
        chosen = {**entry.parameters, **entry.efforts[str(level)]}
        return entry.model_copy(update={"parameters": chosen})
    defaults = entry.applied_defaults
    if parameter not in entry.parameters and parameter in defaults and defaults[parameter] == level:
        return entry
    places = FORMATS.require(entry.format).parameters
    takes = {*places, *PROVIDERS.require(entry.provider).parameters, *entry.parameters, CAP}
    takes -= {*entry.rejects}
    if parameter not in takes:
        default = f" but its default ({defaults[parameter]})" if parameter in defaults else ""
        valid = ", ".join(sorted(takes))
        raise UsageError(f"{name} takes no parameter {parameter}{default}; valid: {valid}")
    parameters: dict[str, Any] = deepcopy(entry.parameters)
    *outer, last = places.get(parameter, (parameter,))
    table = parameters
    for member in outer:
        if not isinstance(table.get(member), dict):
            table[member] = {}
        table = table[member]
    table[last] = level
    return entry.model_copy(update={"parameters": parameters})
