"""What the model of a server of one's own is called: known before anything is hashed."""

from __future__ import annotations

from collections.abc import Callable

from merge_runner.config import (
    PROVIDERS,
    UNNAMED,
    ModelEntry,
    driver_name,
    resolve_endpoint,
)
from merge_runner.errors import ProviderDown, UsageError
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.http_outcome import REGISTRY, TransportFailure, if_nobody


def recorded_name(entry: ModelEntry, cache: ResponseCache) -> str:
    """The one model that the recorded replies are of; UNNAMED where there are none, or several."""
    recorded = {r.model for r in cache.recorded(lambda r: r.provider == entry.provider)}
    return recorded.pop() if len(recorded) == 1 else UNNAMED


async def served_name(name: str, entry: ModelEntry, *, say: Callable[[str], None]) -> str:
    """The one model that a server lists; raises ProviderDown where nobody listens, UsageError."""
    from merge_runner.llm.http import listed_models  # imports httpx, which no replay needs

    endpoint = resolve_endpoint(name, entry)
    driver = driver_name(name, endpoint.identity)
    try:
        listed = await listed_models(endpoint)
    except TransportFailure as exc:
        if exc.outcome == "no_connection":
            raise ProviderDown(f"{driver}: {exc}: {if_nobody(name, entry)}") from exc
        listed, models = [], f"models that it does not list ({exc})"
    else:
        models = ", ".join(listed) or "no model"
    if len(listed) != 1:
        variable = PROVIDERS.require(entry.provider).model_env
        raise UsageError(
            f"{driver} serves {models}: name one with "
            f"{variable}, or with `id` of [{name}] in {REGISTRY}, which goes first"
        )
    say(f"{driver} serves {listed[0]}, which is asked")
    return listed[0]
