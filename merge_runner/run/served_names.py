"""The names of a plan's models, and the endpoints of its recorded replies."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta

from merge_runner.driver_names import driver_name
from merge_runner.errors import ProviderDown, UsageError
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.call import LONG_WAIT_S
from merge_runner.llm.templates import recorded_values
from merge_runner.providers import PROVIDERS, UNNAMED, ModelEntry, model_id, resolve_endpoint
from merge_runner.run.options import Options
from merge_runner.run.plan import Plan


async def with_names(
    plan: Plan, options: Options, cache: ResponseCache, say: Callable[[str], None]
) -> Plan:
    """Return the plan with its models' names, and in a replay with the recorded endpoints.

    A model's name comes from its entry, else from its provider's environment variable. If neither
    has one, it comes from recorded replies in a replay or a dry run, and from the server in a live
    run. Raises UsageError.
    """
    entries, endpoints = dict(plan.entries), dict(plan.endpoints)
    for name, entry in entries.items():
        served_id = model_id(entry)
        if not served_id and options.sends_nothing:
            # Recorded replies of several models of this provider leave the name open.
            models = recorded_values(cache, "model", provider=entry.provider)
            served_id = models.pop() if len(models) == 1 else UNNAMED
        entries[name] = entry.model_copy(
            update={"id": served_id or await _served_name(name, entry, say=say)}
        )
        known: set[str] = set()
        if options.replay and not _is_newest(cache, entries[name].id, endpoints[name]):
            known = recorded_values(cache, "endpoint", model=entries[name].id)
        if known and endpoints[name] not in known:
            endpoints[name], *others = sorted(known)
            if others:
                raise UsageError(
                    f"replies of {name} are recorded from several endpoints: "
                    f"{', '.join(sorted(known))}. Set the base URL variable of its provider to "
                    "the one to replay."
                )
    arms = tuple(replace(arm, entries={n: entries[n] for n in arm.entries}) for arm in plan.arms)
    return plan.model_copy(update={"arms": arms, "entries": entries, "endpoints": endpoints})


def _is_newest(cache: ResponseCache, model: str, endpoint: str) -> bool:
    """Return whether the newest reply is of a model at an endpoint, and no recording is named.

    Then the other replies need not be counted.
    """
    return not cache.recording[1] and any(
        (call.request.model, call.request.endpoint) == (model, endpoint) for call in cache.newest(1)
    )


async def _served_name(name: str, entry: ModelEntry, *, say: Callable[[str], None]) -> str:
    """Return the one model that a server lists; raises ProviderDown and UsageError."""
    # Imported here, since no replay needs them, and httpx takes long to load.
    from merge_runner.llm.endpoint_state import if_nobody, set_base_url
    from merge_runner.llm.http import LIST_TIMEOUT_S, listed_models
    from merge_runner.llm.http_outcome import TransportFailure

    endpoint = resolve_endpoint(name, entry)
    driver = driver_name(name, endpoint.identity)
    until = datetime.now(UTC) + timedelta(seconds=LIST_TIMEOUT_S)
    waits = f"{driver} has not listed its models yet: waits until {until:%H:%M:%S} UTC for that"
    telling = asyncio.get_running_loop().call_later(LONG_WAIT_S, say, waits)
    try:
        listed = await listed_models(endpoint)
        models = ", ".join(listed) or "no model"
    except TransportFailure as exc:
        if exc.outcome.name == "no_connection":
            raise ProviderDown(f"{driver}: {exc}: {if_nobody(entry)}") from exc
        wrong = f"; if that is another server, {set_base_url(entry)}"
        listed, models = [], f"models that it does not list ({exc}{wrong})"
    finally:
        telling.cancel()
    if len(listed) != 1:
        variable = PROVIDERS.require(entry.provider).model_env
        raise UsageError(
            f"{driver} serves {models}: name one with "
            f"{variable}, or with `id` of {entry.place}, which takes precedence"
        )
    say(f"{driver} serves {listed[0]}, which is asked")
    return listed[0]
