"""The hashes under which a reply and the definition of a trial are known.

The key of a reply covers the key version, the endpoint's identity, the path, the headers that
change the meaning of a request, its exact body and the slot. All stand in one canonical JSON
object, so no two of them can run into each other.
"""

from __future__ import annotations

import hashlib
import json
import re

from pydantic import JsonValue

from merge_runner.records import ChatRequest, Slot

KEY_VERSION = 1
SPEC_VERSION = 2  # since then one valid array in a reply is enough
_TEXT = re.compile(r'"[^"\\]*(?:\\.[^"\\]*)*"')
_CANONICAL = json.JSONEncoder(
    sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
)


def canonical_json(value: object) -> str:
    """Return the one spelling of a JSON value: sorted keys, no spaces; NaN raises ValueError."""
    return _CANONICAL.encode(value)


def spec_hash(text: str) -> str:
    """Return the short hash of the canonical JSON that defines a trial."""
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def make_request(
    *,
    provider: str,
    endpoint: str,
    model: str,
    path: str,
    headers: dict[str, str],
    body: dict[str, JsonValue],
    slot: Slot,
) -> ChatRequest:
    """Return a request with its key."""
    text = canonical_json(body)
    return ChatRequest(
        key=call_key(endpoint=endpoint, path=path, headers=headers, body=text, slot=slot),
        provider=provider,
        endpoint=endpoint,
        model=model,
        path=path,
        headers=headers,
        body=text,
        slot=slot,
    )


def call_key(*, endpoint: str, path: str, headers: dict[str, str], body: str, slot: Slot) -> str:
    """Return the SHA-256 of the canonical JSON of all parts; ``body`` is canonical already."""
    # "body" sorts before the other names and "slot" after them, so that the whole is canonical.
    parts = {"endpoint": endpoint, "headers": headers, "key_version": KEY_VERSION, "path": path}
    between = canonical_json(parts)[1:-1]
    text = f'{{"body":{body},{between},"slot":{canonical_json(slot.as_dict())}}}'
    return hashlib.sha256(text.encode()).hexdigest()


def without_prompt(body: str) -> str:
    """Return a canonical body without its longest text, which is the prompt."""
    return body.replace(max(_TEXT.findall(body), key=len, default='""'), '""')
