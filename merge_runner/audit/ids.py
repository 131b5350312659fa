"""Whether an answer was given twice, by the ids that providers give their replies."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator

import duckdb

from merge_runner.results.database import append, fetched

# Earlier emulators gave every reply one of these ids, which therefore tell nothing. The present one
# gives each reply its own, and is audited like any provider.
CONSTANT_IDS = ("chatcmpl-emulated", "resp_emulated", "msg_emulated", "emulated")
# Where our own formats have the answer; what is beside it, such as a time, may differ in a copy.
ANSWERS = ("choices", "output", "candidates", "content")
REPLIES = "SELECT rowid, reply::VARCHAR, provider FROM calls WHERE http_status = 200"
# Ids are compared within an endpoint: two emulators give equal questions equal ids.
REPLY_IDS = """
CREATE OR REPLACE TEMP TABLE reply_ids AS
SELECT trial_id, spec_hash, side, decision, call_key, model_requested,
    coalesce(endpoint, '') AS endpoint, reply_id, content
FROM identified JOIN calls ON calls.rowid = place LEFT JOIN drivers USING (spec_hash, side)
"""
# Some servers draw ids out of a thousand, or have but one. An id that came with different answers
# proves nothing; neither does any other one of a server most of whose repeated ids are such.
REPEATED_IDS = """
CREATE OR REPLACE TEMP TABLE repeated_ids AS
SELECT *, count(*) FILTER (same) OVER server >= count(*) FILTER (NOT same) OVER server AS telling
FROM (
    SELECT endpoint, model_requested, reply_id, min(content) = max(content) AS same
    FROM reply_ids GROUP BY ALL HAVING min(call_key) <> max(call_key)
) WINDOW server AS (PARTITION BY endpoint, model_requested)
"""
MEANINGLESS = """
SELECT model_requested, endpoint, count(DISTINCT call_key)
FROM reply_ids SEMI JOIN audited USING (trial_id, spec_hash)
JOIN repeated_ids USING (endpoint, model_requested, reply_id)
WHERE NOT (same AND telling) GROUP BY ALL ORDER BY ALL
"""


def identified(reply: str, provider: str | None) -> tuple[str, str] | None:
    """A reply's id and a hash of its answer; None for one without an id that tells anything."""
    try:
        body = json.loads(reply)
    except (ValueError, RecursionError):
        return None
    if not isinstance(body, dict):
        return None
    found = body.get("id") or body.get("responseId")
    if not isinstance(found, str) or (provider == "emulator" and found in CONSTANT_IDS):
        return None
    # In an unknown format everything counts: else any two of its answers would be equal.
    known = any(name in body for name in ANSWERS)
    answer = json.dumps([body.get(name) for name in ANSWERS] if known else body)
    safe = found.encode(errors="replace").decode()  # half a surrogate pair is no UTF-8
    return safe, hashlib.blake2b(answer.encode(), digest_size=16).hexdigest()


def find_ids(connection: duckdb.DuckDBPyConnection) -> None:
    """Make ``reply_ids``, of all replies that have one, and ``repeated_ids``."""
    connection.execute(
        "CREATE OR REPLACE TEMP TABLE identified (place BIGINT, reply_id VARCHAR, content VARCHAR)"
    )
    found = [
        (place, *told)
        for place, reply, provider in fetched(connection.execute(REPLIES))
        if (told := identified(reply or "", provider))
    ]
    append(connection, "identified", found)
    connection.execute(REPLY_IDS)
    connection.execute(REPEATED_IDS)


def meaningless_ids(connection: duckdb.DuckDBPyConnection) -> Iterator[str]:
    """Notes on the servers whose ids prove nothing."""
    for model, endpoint, count in connection.execute(MEANINGLESS).fetchall():
        yield (
            f"{count} replies of {model} at {endpoint or 'its endpoint'} have an id that the "
            "server gave to different answers: its ids do not tell whether an answer was given "
            "twice"
        )
