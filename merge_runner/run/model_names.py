"""What the model of a server of one's own is called: known before anything is hashed."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from merge_runner.config import (
    PROVIDERS,
    UNNAMED,
    Endpoint,
    ModelEntry,
    check_network,
    driver_name,
    resolve_endpoint,
)
from merge_runner.errors import ProviderDown, UsageError
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.http_outcome import REGISTRY, TransportFailure, if_nobody

# What Ollama adds to a name that has no tag.
USUAL_TAG = ":latest"


def recorded_name(name: str, entry: ModelEntry, *, cache: ResponseCache, strict: bool) -> str:
    """The model that the recorded replies are of; UNNAMED where there are none.

    Several models are a UsageError if ``strict``, and else as good as none.
    """
    recorded = sorted({r.model for r in cache.recorded(lambda r: r.provider == entry.provider)})
    if len(recorded) > 1 and strict:
        raise UsageError(
            f"replies of {name} are recorded from several models, {', '.join(recorded)}: "
            f"{_choose(name, entry)}"
        )
    return recorded[0] if len(recorded) == 1 else UNNAMED


async def served_name(name: str, entry: ModelEntry, *, say: Callable[[str], None]) -> str:
    """The one model that a server lists; raises ProviderDown where nobody listens, UsageError."""
    endpoint = resolve_endpoint(name, entry)
    driver = driver_name(name, endpoint.identity)
    try:
        listed = await _listed(endpoint, patient=True)
    except TransportFailure as exc:
        if exc.outcome == "no_connection":
            raise ProviderDown(f"{driver}: {exc}: {if_nobody(name, entry)}") from exc
        raise UsageError(
            f"{driver} does not say which models it serves ({exc}): {_choose(name, entry)}"
        ) from exc
    if len(listed) != 1:
        names = ", ".join(listed) or "no model"
        raise UsageError(f"{driver} serves {names}: {_choose(name, entry)}")
    say(f"{driver} serves {listed[0]}, which is asked")
    return listed[0]


async def check_served(entries: Mapping[str, ModelEntry]) -> None:
    """Raise UsageError where a server lists its models and not the one that is to be asked.

    A server that lists nothing, or does not answer, is judged by the first call.
    """
    for name, entry in entries.items():
        if PROVIDERS.require(entry.provider).model_env is None:
            continue
        endpoint = resolve_endpoint(name, entry)
        try:
            listed = await _listed(endpoint)
        except TransportFailure:
            continue
        if entry.id not in listed and entry.id + USUAL_TAG not in listed:
            raise UsageError(
                f"{driver_name(name, endpoint.identity)} serves {', '.join(listed) or 'no model'}, "
                f"and not {entry.id!r}: {_choose(name, entry)}"
            )


async def _listed(endpoint: Endpoint, *, patient: bool = False) -> list[str]:
    from merge_runner.llm.model_list import listed_models  # imports httpx, which no replay needs

    check_network(endpoint.base_url)
    return await listed_models(endpoint, patient=patient)


def _choose(name: str, entry: ModelEntry) -> str:
    variable = PROVIDERS.require(entry.provider).model_env
    return f"name one with {variable}, or with `id` of [{name}] in {REGISTRY}, which goes first"
