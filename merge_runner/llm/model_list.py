"""The models that a server says it serves, by ``GET /models``."""

from __future__ import annotations

import asyncio
import time

from merge_runner.config import Endpoint
from merge_runner.llm.formats.base import as_dict, as_dicts, as_text
from merge_runner.llm.http import HttpTransport
from merge_runner.llm.http_outcome import NOBODY_S, TransportFailure

# A server that answers one call at a time may be busy with one.
TIMEOUT_S = 60.0
POLL_S = 0.5


async def listed_models(endpoint: Endpoint) -> list[str]:
    """Return the ids of the models; raises TransportFailure, ``no_list`` if there is no list.

    A server that is just starting is waited for some seconds.
    """
    transport = HttpTransport(endpoint, connections=1)
    began_s = time.monotonic()
    try:
        while True:
            try:
                raw = await transport.ask("GET", "/models", {}, timeout_s=TIMEOUT_S)
                break
            except TransportFailure as exc:
                if exc.outcome != "no_connection" or time.monotonic() - began_s >= NOBODY_S:
                    raise
            await asyncio.sleep(POLL_S)
    finally:
        await transport.close()
    payload = as_dict(raw.payload)
    if raw.status != 200 or "data" not in payload:
        raise TransportFailure("no_list", f"HTTP {raw.status}: {raw.error.message or 'no list'}")
    return [name for model in as_dicts(payload["data"]) if (name := as_text(model.get("id")))]
