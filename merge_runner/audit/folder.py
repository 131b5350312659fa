"""Whether a cache folder holds the replies of a database, so that a replay will work."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import duckdb

from merge_runner.audit.findings import Audit, Finding
from merge_runner.database import read_database
from merge_runner.errors import RecordingError
from merge_runner.llm.cache import ResponseCache

BATCH = 1_000
# The answer to every call that a decision used, once, with the first place that used it.
ANSWERS = """
SELECT call_key, min_by((trial_id, side, decision), (trial_id, decision, side)),
    any_value(request::VARCHAR), any_value(reply::VARCHAR)
FROM calls SEMI JOIN decisions USING (trial_id, spec_hash, side, decision, call_key)
SEMI JOIN (SELECT trial_id, spec_hash FROM sweep_trials WHERE sweep_id = coalesce(?, sweep_id))
    USING (trial_id, spec_hash)
ANTI JOIN (SELECT trial_id, spec_hash, side, decision, max(attempt) AS attempt FROM calls
    GROUP BY ALL) AS answers
    ON answers.trial_id = calls.trial_id AND answers.spec_hash = calls.spec_hash
    AND answers.side = calls.side AND answers.decision = calls.decision
    AND answers.attempt > calls.attempt
GROUP BY call_key
"""


def audit_cache(path: Path, folder: Path, sweep_id: str | None = None) -> Audit:
    """Look up every reply of a sweep, or of all; raises UsageError."""
    cache = ResponseCache(folder, read_only=True)
    findings: list[Finding] = []
    calls = 0
    try:
        with read_database(path) as connection:
            for key, (trial_id, side, decision), request, reply in _answers(connection, sweep_id):
                calls += 1
                problem = _problem(cache, key, request, reply)
                if problem:
                    findings.append(Finding("cache", problem, sweep_id, trial_id, side, decision))
    finally:
        cache.close()
    return Audit(str(folder), {"calls": calls}, tuple(findings))


def _answers(
    connection: duckdb.DuckDBPyConnection, sweep_id: str | None
) -> Iterator[tuple[str, tuple[str, str, int], str, str | None]]:
    rows = connection.execute(ANSWERS, [sweep_id])
    while batch := rows.fetchmany(BATCH):
        yield from batch


def _problem(cache: ResponseCache, key: str, request: str, reply: str | None) -> str | None:
    try:
        entry = cache.get(key)
    except RecordingError as exc:
        return str(exc)
    if entry is None:
        return f"its reply is not in the cache ({key})"
    if entry.request.body != request:
        return f"the cache holds another request ({key})"
    kept = entry.attempts[-1].reply
    # The table holds a reply that is no JSON as a JSON string.
    if reply not in (kept, json.dumps(kept)):
        return f"the cache holds another reply than the database ({key})"
    return None
