"""What the model of a server of one's own is called: known before anything is hashed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from merge_runner.config import (
    PROVIDERS,
    UNNAMED,
    Endpoint,
    ModelEntry,
    check_network,
    driver_name,
    model_id,
    resolve_endpoint,
)
from merge_runner.errors import ProviderDown, UsageError
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.first_call import REGISTRY, if_nobody
from merge_runner.llm.transport import TransportFailure

Entries = Mapping[str, ModelEntry]
# What Ollama adds to a name that has none.
USUAL_TAG = ":latest"


def with_asked_names(entries: Entries, say: Callable[[str], None]) -> dict[str, ModelEntry]:
    """The entries with the names that their servers tell where nobody else does.

    Raises UsageError, and ProviderDown where nobody listens.
    """
    return {
        name: entry.model_copy(update={"id": model_id(entry) or _only_model(name, entry, say)})
        for name, entry in entries.items()
    }


def with_recorded_names(
    entries: Entries, cache: ResponseCache, *, strict: bool
) -> dict[str, ModelEntry]:
    """The entries with the names under which their replies are recorded where nobody tells one.

    Several are a UsageError where it is ``strict``, and else as good as none: the name stays open.
    """
    return {
        name: entry.model_copy(
            update={"id": model_id(entry) or _recorded_model(name, entry, cache, strict)}
        )
        for name, entry in entries.items()
    }


def check_listed(entries: Entries) -> None:
    """Raise UsageError where a server lists its models and the one to be asked is not among them.

    Whoever lists nothing, or does not answer, is found out by the first call.
    """
    for name, entry in entries.items():
        if PROVIDERS.require(entry.provider).model_env is None:
            continue
        endpoint = resolve_endpoint(name, entry)
        try:
            listed = _ask(endpoint)
        except TransportFailure:
            continue
        if entry.id not in listed and entry.id + USUAL_TAG not in listed:
            raise UsageError(
                f"{driver_name(name, endpoint.identity)} serves no model {entry.id!r}, but "
                f"{', '.join(listed) or 'none at all'}: {_choose(name, entry)}"
            )


def _only_model(name: str, entry: ModelEntry, say: Callable[[str], None]) -> str:
    endpoint = resolve_endpoint(name, entry)
    driver = driver_name(name, endpoint.identity)
    try:
        listed = _ask(endpoint, patient=True)
    except TransportFailure as exc:
        if exc.outcome == "no_connection":
            raise ProviderDown(f"{driver}: {exc}: {if_nobody(name, entry)}") from exc
        raise UsageError(
            f"{driver} does not tell what it serves ({exc}): {_choose(name, entry)}"
        ) from exc
    if len(listed) != 1:
        several = f"serves {', '.join(listed)}" if listed else "serves no model"
        raise UsageError(f"{driver} {several}: {_choose(name, entry)}")
    say(f"{driver} serves {listed[0]}, which is asked")
    return listed[0]


def _recorded_model(name: str, entry: ModelEntry, cache: ResponseCache, strict: bool) -> str:
    recorded = cache.recorded_models(entry.provider)
    if len(recorded) > 1 and strict:
        raise UsageError(
            f"replies of {name} are recorded from several models, {', '.join(recorded)}: "
            f"{_choose(name, entry)}"
        )
    return recorded[0] if len(recorded) == 1 else UNNAMED


def _ask(endpoint: Endpoint, *, patient: bool = False) -> Sequence[str]:
    from merge_runner.llm.model_list import listed_models  # imports httpx, which no replay needs

    check_network(endpoint.base_url)
    return listed_models(endpoint, patient=patient)


def _choose(name: str, entry: ModelEntry) -> str:
    """How to say which model is meant."""
    variable = PROVIDERS.require(entry.provider).model_env
    if entry.id in (UNNAMED, model_id(entry.model_copy(update={"id": UNNAMED}))):
        return f"set {variable} to one of them"
    return f"correct `id` of [{name}] in {REGISTRY}"
