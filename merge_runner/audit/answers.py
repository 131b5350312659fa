"""What a stored attempt says, read again from its reply."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from merge_runner.llm.formats.base import Reading, WireFormat
from merge_runner.llm.http_outcome import RawReply, judge
from merge_runner.records import ANSWERED_FIELD, ANSWERS, says_scripted
from merge_runner.results.rows import Row

# The columns of ``calls`` that are read here: where an attempt stands, and what its reply says.
PLACE = ("decision", "side", "attempt")
READ = (
    "outcome",
    "error",
    "model_served",
    "finish_reason",
    "input_tokens",
    "cached_input_tokens",
    "output_tokens",
    "reasoning_tokens",
    "scripted",
)
COLUMNS = (*PLACE, *READ, "call_key", "provider", "http_status", "reply")


@dataclass(frozen=True, slots=True)
class Answer:
    """An attempt: its row, what that should hold, and the text of its answer, None without one."""

    row: dict[str, Any]
    wanted: dict[str, Any]
    text: str | None
    payload: object = None

    @property
    def derived(self) -> Row:
        """The row as it should be."""
        return tuple({**self.row, **self.wanted}.values())


def read_answer(row: dict[str, Any], wire: WireFormat) -> Answer:
    """Read the reply of a row.

    A failed attempt is taken as it is stored: its outcome depends on headers, which are not. The
    mark of a stand-in may have been a header too, so that a stored ``scripted`` is believed.
    """
    raw = RawReply(row["http_status"] or 0, {}, _body(row["reply"]))
    told = {"scripted": row["scripted"] or row["provider"] == "emulator" or says_scripted(raw.body)}
    if raw.status == 200 and isinstance(raw.payload, dict):
        reading = wire.read(raw.payload)
        if reading.outcome != "error":
            wanted = {**_told(reading), **told, "outcome": reading.outcome, "error": None}
            return Answer(row, wanted, reading.text, raw.payload)
    if row["outcome"] not in ANSWERS:
        return Answer(row, told, None)
    outcome = judge(raw, wire)
    wanted = {**_told(outcome.reading), **told, "outcome": outcome.name}
    return Answer(row, {**wanted, "error": outcome.message}, "")


def answers_another(payload: object, body_sha256: str, slot: Mapping[str, Any]) -> bool:
    """Whether a reply says that it answers another request, as only the emulator's can.

    It names a slot only if the client sent one.
    """
    told = payload.get(ANSWERED_FIELD) if isinstance(payload, dict) else None
    if not isinstance(told, dict):
        return False
    return told.get("body_sha256") != body_sha256 or told.get("slot") not in (None, slot)


def _told(reading: Reading) -> dict[str, Any]:
    return {
        "model_served": reading.model_served,
        "finish_reason": reading.finish_reason,
        "input_tokens": reading.usage.input_tokens,
        "cached_input_tokens": reading.usage.cached_input_tokens,
        "output_tokens": reading.usage.output_tokens,
        "reasoning_tokens": reading.usage.reasoning_tokens,
    }


def _body(reply: str | None) -> str:
    """The body as it came; what the table could not take as JSON is stored as a JSON string."""
    if reply is None or not reply.startswith('"'):
        return reply or ""
    try:
        body: str = json.loads(reply)
    except ValueError:
        return reply
    return body
