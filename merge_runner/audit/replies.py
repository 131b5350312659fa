"""Whether every reply belongs to its request, and every sample is a reply of its own."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

import duckdb

from merge_runner.audit.findings import Finding, Sharing
from merge_runner.results.database import fetched

SHOWN = 3

# A place, a hash, and the parts of the text that should have it; llm/content_hashes.py has that
# of a key.
KEYS = """
SELECT trial_id, side, decision, call_key, '{"body":', request::VARCHAR,
    ',' || between_body_and_slot || '{"condition":' || to_json(condition)::VARCHAR
    || ',"decision":' || decision || ',"repetition":' || rep || ',"sample_set":' || sample_set
    || ',"side":"' || side || '"}}'
FROM calls JOIN audited USING (trial_id, spec_hash) LEFT JOIN drivers USING (spec_hash, side)
WHERE attempt = 1
"""
PROMPTS = """
SELECT trial_id, side, decision, prompt_hash, prompt
FROM decisions SEMI JOIN audited USING (trial_id, spec_hash) JOIN drivers USING (spec_hash, side)
WHERE body IS NOT NULL
"""

# Two slots of one spec with one call, and two calls of any spec with one reply: a proxy that
# caches answers a repetition, or a fresh set of samples, with an old reply. ``done`` holds the
# trials of which it was told before.
_SHARED = """
WITH suspects AS ({suspects})
SELECT list(DISTINCT (trial_id, side, decision, spec_hash)
    ORDER BY (trial_id, side, decision, spec_hash)) AS places
FROM {slots} SEMI JOIN suspects USING ({what})
GROUP BY {what}
HAVING len(places) > 1
    AND bool_or((trial_id, spec_hash) IN (SELECT (trial_id, spec_hash) FROM audited))
    AND NOT bool_or((trial_id, spec_hash) IN (SELECT (trial_id, spec_hash) FROM done))
"""
# Drivers of a study may ask the same at the same slot: that is told, see IN_COMMON, and no fault.
_DRIVEN = "(SELECT * FROM decisions JOIN trial_drivers USING (trial_id, spec_hash))"
SHARED_CALLS = _SHARED.format(
    what="spec_hash, driver, call_key",
    slots=_DRIVEN,
    suspects=f"SELECT spec_hash, driver, call_key FROM {_DRIVEN} GROUP BY ALL HAVING count(*) > 1",  # noqa: S608 # constants
)
SHARED_REPLIES = _SHARED.format(
    what="endpoint, model_requested, reply_id",
    slots="reply_ids",
    suspects="FROM repeated_ids WHERE same AND telling",
)

USED = """
CREATE OR REPLACE TEMP TABLE used AS
SELECT DISTINCT call_key, spec_hash, driver || '/' || variant AS name
FROM decisions JOIN trials USING (trial_id, spec_hash)
JOIN trial_drivers USING (trial_id, spec_hash) WHERE call_key IS NOT NULL
"""
IN_COMMON = """
SELECT a.name, a.spec_hash, b.name, b.spec_hash, count(DISTINCT call_key)
FROM used AS a JOIN used AS b USING (call_key)
WHERE (a.name, a.spec_hash) < (b.name, b.spec_hash)
    AND (a.spec_hash IN (SELECT spec_hash FROM audited)
        OR b.spec_hash IN (SELECT spec_hash FROM audited))
GROUP BY ALL ORDER BY ALL
"""
MANY_REPEATED = 5
# Of the answers to a prompt that was asked before, those that are word for word like another.
ASKED_AGAIN = """
CREATE OR REPLACE TEMP TABLE asked_again AS
SELECT min(decisions.rowid) AS place, model_left, model_right, side, prompt_hash
FROM decisions JOIN audited USING (trial_id, spec_hash)
WHERE valid AND call_key IS NOT NULL
GROUP BY call_key, model_left, model_right, side, prompt_hash
QUALIFY count(*) OVER (PARTITION BY model_left, model_right, side, prompt_hash) > 1
"""
ANSWERED = """
CREATE OR REPLACE TEMP TABLE answered AS
SELECT place, hash(coalesce(rationale, ''), plan) AS answer
FROM decisions JOIN asked_again ON decisions.rowid = place
"""
ALIKE = """
WITH repeated AS (
    SELECT count(*) AS times, count(DISTINCT answer) AS different
    FROM asked_again JOIN answered USING (place)
    GROUP BY model_left, model_right, side, prompt_hash
)
SELECT coalesce(sum(times - 1), 0)::INTEGER, coalesce(sum(times - different), 0)::INTEGER
FROM repeated
"""


def check_hashes(connection: duckdb.DuckDBPyConnection) -> Iterator[Finding]:
    """Hash every prompt and every request anew."""
    for kind, sql, text in (
        ("prompt", PROMPTS, "its prompt does not have the hash prompt_hash"),
        ("key", KEYS, "its request and slot do not have the key under which its reply is kept"),
    ):
        for trial_id, side, decision, whole in _hashed_otherwise(connection, sql):
            yield Finding(
                kind,
                text if whole or kind == "key" else "a model was asked without a prompt",
                trial=trial_id,
                side=side,
                decision=decision,
            )


def _hashed_otherwise(
    connection: duckdb.DuckDBPyConnection, sql: str
) -> list[tuple[str, str, int, bool]]:
    """The places where a text does not have its hash, and whether none of its parts is missing.

    Python hashes several times as fast as the database.
    """
    return sorted(
        (trial_id, side, decision, None not in parts)
        for trial_id, side, decision, told, *parts in fetched(connection.execute(sql))
        if None in parts or hashlib.sha256("".join(parts).encode()).hexdigest() != told
    )


def shared_calls(connection: duckdb.DuckDBPyConnection) -> Iterator[Finding]:
    """Find the slots of a spec that are no samples of their own, since they share a call."""
    return _shared(connection, SHARED_CALLS, "its call is also that of")


def shared_replies(connection: duckdb.DuckDBPyConnection) -> Iterator[Finding]:
    """Find the calls that are no samples of their own, since they share a reply."""
    told = "its answer, with the provider's id of it, is also that of"
    return _shared(connection, SHARED_REPLIES, told)


def _shared(connection: duckdb.DuckDBPyConnection, sql: str, text: str) -> Iterator[Finding]:
    for (slots,) in connection.execute(sql).fetchall():
        (trial_id, side, decision, _), *others = slots
        told = "; ".join("{}, {}, decision {}".format(*slot) for slot in others[:SHOWN])
        more = f" and {len(others) - SHOWN} more" if len(others) > SHOWN else ""
        yield Finding(
            "shared", f"{text} {told}{more}", trial=trial_id, side=side, decision=decision
        )


def calls_in_common(connection: duckdb.DuckDBPyConnection) -> Iterator[Sharing]:
    """The calls that several specs share, since their requests were identical."""
    for first, first_spec, second, second_spec, count in connection.execute(IN_COMMON).fetchall():
        if first == second:
            first, second = f"{first} ({first_spec})", f"{second} ({second_spec})"  # noqa: PLW2901 # one name for two specs
        yield Sharing("calls", first, second, count)


def answers_alike(connection: duckdb.DuckDBPyConnection) -> int:
    """How many answers to prompts that were asked before are word for word as before, if all are.

    A model that samples never gives only answers that it has given before. A proxy that caches and
    gives each reply a new id does, and so does a model at temperature 0: in both cases the
    repetitions are no samples. 0 also where a few answers alone were to such prompts.
    """
    connection.execute(ASKED_AGAIN)
    connection.execute(ANSWERED)
    row = connection.execute(ALIKE).fetchone()
    assert row is not None
    repeated, alike = row
    return alike if alike == repeated >= MANY_REPEATED else 0
