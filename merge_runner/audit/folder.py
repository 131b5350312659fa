"""Whether a cache folder holds the replies of a database, so that a replay will work."""

from __future__ import annotations

import json
from pathlib import Path

from merge_runner.audit.findings import Audit, Finding
from merge_runner.database import read_database, room_for_texts, streamed
from merge_runner.errors import RecordingError, UsageError
from merge_runner.llm.cache import ResponseCache

# The answer to every call that a decision used, once, with the first place that used it.
USED = """
CREATE OR REPLACE TEMP TABLE used_answers AS
SELECT min_by(calls.rowid, (trial_id, decision, side)) AS place
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
ANSWERS = """
SELECT call_key, trial_id, side, decision, request::VARCHAR, reply::VARCHAR
FROM calls SEMI JOIN used_answers ON calls.rowid = place
"""


def audit_cache(path: Path, folder: Path, sweep_id: str | None = None) -> Audit:
    """Look up every reply of a sweep, or of all; raises UsageError."""
    if not (folder / "cache.db").is_file():
        raise UsageError(f"there is no cache in {folder}")
    cache = ResponseCache(folder)
    findings: list[Finding] = []
    calls = 0
    try:
        with read_database(path) as connection, room_for_texts(connection):
            connection.execute(USED, [sweep_id])
            for key, trial_id, side, decision, request, reply in streamed(connection, ANSWERS):
                calls += 1
                problem = _problem(cache, key, request, reply)
                if problem:
                    findings.append(Finding("cache", problem, sweep_id, trial_id, side, decision))
    finally:
        cache.close()
    return Audit(str(folder), {"calls": calls}, tuple(findings))


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
