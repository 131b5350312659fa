"""The parameters of requests by common names, and which of them a model takes."""

from __future__ import annotations

from collections.abc import Iterable

from pydantic import JsonValue

from merge_runner.config import PROVIDERS, ModelEntry
from merge_runner.errors import UsageError, unknown_name
from merge_runner.llm.formats import FORMATS

CAP, EFFORT = "max_output_tokens", "reasoning_effort"
# From the least to the most that any provider takes.
RANGES = {
    "temperature": (0, 2),
    "top_p": (0, 1),
    "min_p": (0, 1),
    "presence_penalty": (-2, 2),
    "frequency_penalty": (-2, 2),
}


def known_parameters(entries: Iterable[ModelEntry]) -> set[str]:
    """Return the parameters that some model takes, by common names."""
    return {CAP, EFFORT}.union(
        *(form.parameters for form in FORMATS.values()),
        *(provider.parameters for provider in PROVIDERS.values()),
        *(entry.parameters for entry in entries),
    )


def with_parameter(name: str, entry: ModelEntry, parameter: str, level: JsonValue) -> ModelEntry:
    """Return the entry ``name`` with a parameter set; raises UsageError if the model rejects it.

    What is the provider's default already is not sent.
    """
    if parameter == CAP:
        if type(level) is not int or level < 1:
            raise UsageError(f"{CAP} is a whole number from 1")
        return entry.model_copy(update={CAP: level})
    _check_range(parameter, level)
    if parameter == EFFORT and entry.efforts:
        return _with_effort(name, entry, level)
    unset = parameter not in entry.parameters
    if unset and parameter in entry.applied_defaults and entry.applied_defaults[parameter] == level:
        return entry
    places = FORMATS.require(entry.format).parameters
    takes = {*places, *PROVIDERS.require(entry.provider).parameters, *entry.parameters, CAP}
    takes -= {*entry.rejects}
    if parameter not in takes:
        defaults = ", ".join(
            f"{n} = {v}" for n, v in entry.applied_defaults.items() if n in entry.rejects
        )
        raise UsageError(
            f"{name} takes no parameter {parameter}"
            + (f" but its default ({defaults})" if parameter in entry.applied_defaults else "")
            + f"; valid: {', '.join(sorted(takes))}"
        )
    return entry.model_copy(
        update={"parameters": _set(entry.parameters, places.get(parameter, (parameter,)), level)}
    )


def _check_range(parameter: str, level: JsonValue) -> None:
    if parameter not in RANGES:
        return
    low, high = RANGES[parameter]
    if isinstance(level, bool | str | list | dict) or level is None or not low <= level <= high:
        raise UsageError(f"{parameter} = {level!r} is no number from {low} to {high}")


def _with_effort(name: str, entry: ModelEntry, level: JsonValue) -> ModelEntry:
    if level not in entry.efforts:
        raise unknown_name(f"{EFFORT} of {name}", str(level), entry.efforts)
    parameters = {**entry.parameters, **entry.efforts[str(level)]}
    return entry.model_copy(update={"parameters": parameters})


def _set(
    values: dict[str, JsonValue], place: tuple[str, ...], level: JsonValue
) -> dict[str, JsonValue]:
    """Return the values with one set at a place, a name within a name."""
    first, *rest = place
    if not rest:
        return {**values, first: level}
    inner = values.get(first)
    return {**values, first: _set(inner if isinstance(inner, dict) else {}, tuple(rest), level)}
