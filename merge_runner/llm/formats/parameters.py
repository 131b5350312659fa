"""The parameters of requests by common names, and which of them a model takes."""

from __future__ import annotations

from collections.abc import Iterable

from pydantic import JsonValue

from merge_runner.config import PROVIDERS, ModelEntry
from merge_runner.errors import UsageError, unknown_name
from merge_runner.llm.formats import FORMATS

CAP, EFFORT = "max_output_tokens", "reasoning_effort"


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
    if parameter == EFFORT and entry.efforts:
        if level not in entry.efforts:
            raise unknown_name(f"{EFFORT} of {name}", str(level), entry.efforts)
        chosen = {**entry.parameters, **entry.efforts[str(level)]}
        return entry.model_copy(update={"parameters": chosen})
    defaults = entry.applied_defaults
    unset = parameter not in entry.parameters
    if unset and parameter in defaults and defaults[parameter] == level:
        return entry
    places = FORMATS.require(entry.format).parameters
    takes = {*places, *PROVIDERS.require(entry.provider).parameters, *entry.parameters, CAP}
    takes -= {*entry.rejects}
    if parameter not in takes:
        default = f" but its default ({defaults[parameter]})" if parameter in defaults else ""
        valid = ", ".join(sorted(takes))
        raise UsageError(f"{name} takes no parameter {parameter}{default}; valid: {valid}")
    place = places.get(parameter, (parameter,))
    return entry.model_copy(update={"parameters": _set(entry.parameters, place, level)})


def _set(
    values: dict[str, JsonValue], place: tuple[str, ...], level: JsonValue
) -> dict[str, JsonValue]:
    """Return the values with one set at a place, a name within a name."""
    first, *rest = place
    if not rest:
        return {**values, first: level}
    inner = values.get(first)
    return {**values, first: _set(inner if isinstance(inner, dict) else {}, tuple(rest), level)}
