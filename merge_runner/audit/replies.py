"""Whether every reply belongs to its request, and every sample is a reply of its own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import duckdb

from merge_runner.audit.expected import Spec
from merge_runner.audit.findings import Finding, Sharing
from merge_runner.llm.keys import call_key
from merge_runner.records import Slot

BATCH = 1_000
SHOWN = 3

REQUESTS = """
SELECT trial_id, side, decision, call_key, spec_hash, request::VARCHAR, condition, rep, sample_set
FROM calls JOIN audited USING (trial_id, spec_hash)
WHERE attempt = 1
"""

# Earlier emulators gave every reply the same id: those of a stand-in tell nothing. The present
# ones give each reply its own, and are audited like any provider.
CONSTANT_IDS = ("chatcmpl-emulated", "resp_emulated", "msg_emulated", "emulated")
# A reply that is no JSON object has no id; neither has one of a server that sends none or "". An id
# is one within the endpoint that gave it: two emulators answer the same question with the same.
REPLY_IDS = f"""
CREATE OR REPLACE TEMP TABLE reply_ids AS
SELECT * FROM (
    SELECT trial_id, spec_hash, side, decision, call_key, provider, model_requested,
        coalesce(endpoint, '') AS endpoint,
        list_first(list_filter(try(json_extract_string(reply, ['$.id', '$.responseId'])),
            lambda found : found <> '')) AS reply_id
    FROM calls LEFT JOIN drivers USING (spec_hash, side)
    WHERE http_status = 200 AND reply IS NOT NULL
)
WHERE reply_id IS NOT NULL AND NOT (provider = 'emulator' AND reply_id IN {CONSTANT_IDS})
"""  # noqa: S608 # constants

# Two slots of one spec with one call, and two calls of any spec with one reply: a proxy that
# caches answers a repetition, or a fresh set of samples, with an old reply.
_SHARED = """
WITH suspects AS (SELECT {what} FROM {slots} GROUP BY ALL HAVING {several})
SELECT list(DISTINCT (trial_id, side, decision) ORDER BY (trial_id, side, decision)) AS places
FROM {slots} SEMI JOIN suspects USING ({what})
GROUP BY {what}
HAVING len(places) > 1
    AND bool_or((trial_id, spec_hash) IN (SELECT (trial_id, spec_hash) FROM audited))
    AND NOT bool_or((trial_id, spec_hash) IN (SELECT (trial_id, spec_hash) FROM done))
"""
SHARED_CALLS = _SHARED.format(what="spec_hash, call_key", slots="decisions", several="count(*) > 1")
SHARED_REPLIES = _SHARED.format(
    what="endpoint, model_requested, reply_id",
    slots="reply_ids",
    several="min(call_key) <> max(call_key)",
)

USED = """
CREATE OR REPLACE TEMP TABLE used AS
SELECT DISTINCT call_key, spec_hash,
    if(model_left = model_right, model_left, model_left || '+' || model_right) || '/' || variant
        || if(sample_set = 0, '', '/set' || sample_set) AS name
FROM decisions JOIN trials USING (trial_id, spec_hash) WHERE call_key IS NOT NULL
"""
IN_COMMON = """
SELECT a.name, a.spec_hash, b.name, b.spec_hash, count(DISTINCT call_key)
FROM used AS a JOIN used AS b USING (call_key)
WHERE (a.name, a.spec_hash) < (b.name, b.spec_hash)
    AND (a.spec_hash IN (SELECT spec_hash FROM audited)
        OR b.spec_hash IN (SELECT spec_hash FROM audited))
GROUP BY ALL ORDER BY ALL
"""
# Of the answers to a prompt that was asked before, those that are word for word like another.
ALIKE = """
WITH answers AS (
    SELECT DISTINCT call_key, model_left, model_right, side, prompt_hash, rationale, plan
    FROM decisions JOIN audited USING (trial_id, spec_hash)
    WHERE valid AND call_key IS NOT NULL
), repeated AS (
    SELECT count(*) AS times, count(DISTINCT (coalesce(rationale, ''), plan)) AS different
    FROM answers GROUP BY model_left, model_right, side, prompt_hash HAVING times > 1
)
SELECT coalesce(sum(times - 1), 0)::INTEGER, coalesce(sum(times - different), 0)::INTEGER
FROM repeated
"""


def check_keys(
    connection: duckdb.DuckDBPyConnection, specs: Mapping[str, Spec]
) -> Iterator[Finding]:
    """Hash every request anew."""
    rows = connection.execute(REQUESTS)
    while batch := rows.fetchmany(BATCH):
        for trial_id, side, decision, key, spec_hash, *request in batch:
            if _key(specs.get(spec_hash), side, decision, *request) != key:
                yield Finding(
                    "key",
                    "its request and slot do not have the key under which its reply is kept",
                    trial=trial_id,
                    side=side,
                    decision=decision,
                )


def check_sharing(connection: duckdb.DuckDBPyConnection) -> Iterator[Finding]:
    """Find the slots that are no samples of their own; ``done`` holds what was told before."""
    for sql, text in (
        (SHARED_CALLS, "its call is also that of"),
        (SHARED_REPLIES, "the provider's id of its reply is also that of"),
    ):
        for (slots,) in connection.execute(sql).fetchall():
            first, *others = slots
            told = "; ".join(_place(slot) for slot in others[:SHOWN])
            more = f" and {len(others) - SHOWN} more" if len(others) > SHOWN else ""
            trial_id, side, decision = first
            yield Finding(
                "shared", f"{text} {told}{more}", trial=trial_id, side=side, decision=decision
            )


def calls_in_common(connection: duckdb.DuckDBPyConnection) -> Iterator[Sharing]:
    """The calls that are those of several specs, since the requests were identical."""
    for first, first_spec, second, second_spec, count in connection.execute(IN_COMMON).fetchall():
        if first == second:
            first, second = f"{first} ({first_spec})", f"{second} ({second_spec})"  # noqa: PLW2901 # one name for two specs
        yield Sharing("calls", first, second, count)


def answers_alike(connection: duckdb.DuckDBPyConnection) -> tuple[int, int]:
    """How many answers were to a prompt that was asked before, and how many only repeat another."""
    row = connection.execute(ALIKE).fetchone()
    assert row is not None
    return row[0], row[1]


def _key(
    spec: Spec | None,
    side: str,
    decision: int,
    request: str | None,
    condition: str,
    repetition: int,
    sample_set: int,
) -> str | None:
    """The key of a request; None where its spec or the request itself is not stored."""
    driver: dict[str, Any] = spec.driver(side) if spec else {}
    if request is None or not {"endpoint", "path", "headers"} <= driver.keys():
        return None
    return call_key(
        endpoint=driver["endpoint"],
        path=driver["path"],
        headers=driver["headers"],
        body=request,
        slot=Slot(
            condition, repetition, "left" if side == "left" else "right", decision, sample_set
        ),
    )


def _place(slot: tuple[str, str, int]) -> str:
    return "{}, {}, decision {}".format(*slot)
