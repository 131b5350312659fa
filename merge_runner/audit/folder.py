"""Whether a cache folder holds the attempts of a database, so that a replay will work."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import duckdb

from merge_runner.audit.findings import Audit, Finding
from merge_runner.errors import RecordingError
from merge_runner.llm.cache import ResponseCache
from merge_runner.records import ChatRequest, Slot
from merge_runner.results.comparison import Spans, TrialKey, in_batches, rows_of_trials
from merge_runner.results.database import by_name, read_database
from merge_runner.results.rows import call_row

TRIALS = """
SELECT DISTINCT trial_id, spec_hash FROM sweep_trials WHERE sweep_id = coalesce(?, sweep_id)
"""


def audit_cache(path: Path, folder: Path, sweep_id: str | None = None) -> Audit:
    """Look up every attempt of a sweep, or of all; raises UsageError."""
    cache = ResponseCache(folder, read_only=True)
    findings: list[Finding] = []
    keys: set[str] = set()
    try:
        with read_database(path) as connection:
            trials = connection.execute(TRIALS, [sweep_id]).fetchall()
            read = partial(_attempts, connection)
            for rows in in_batches(connection, trials, ["calls"], read):
                for row in rows:
                    keys.add(row["call_key"])
                    if problem := _problem(cache, row):
                        place = (row["trial_id"], row["side"], row["decision"])
                        findings.append(Finding("cache", problem, sweep_id, *place))
    finally:
        cache.close()
    return Audit(str(folder), {"calls": len(keys)}, findings)


def _attempts(
    connection: duckdb.DuckDBPyConnection, keys: list[TrialKey], spans: Spans
) -> list[dict[str, Any]]:
    rows = rows_of_trials(connection, "*", "calls", keys, spans["calls"])
    return list(by_name(rows))


def _problem(cache: ResponseCache, row: dict[str, Any]) -> str | None:
    """In what the cache disagrees with a row; None if in nothing."""
    key, number, cached = row["call_key"], row["attempt"], row["cached"]
    place = (row["trial_id"], row["spec_hash"], row["side"], row["decision"])
    try:
        entry = cache.get(key)
        attempts = entry.attempts if entry else cache.unanswered(key)
    except RecordingError as exc:
        return str(exc)
    if not 1 <= number <= len(attempts):
        return f"its {f'attempt {number}' if attempts else 'reply'} is not in the cache ({key})"
    request = entry.request if entry else _asked(row)
    wanted = call_row(*place, request, attempts[number - 1], cached=cached)
    differing = [name for (name, old), new in zip(row.items(), wanted, strict=True) if old != new]
    if not differing:
        return None
    return f"the cache holds another {', '.join(differing)} than the database ({key})"


def _asked(row: dict[str, Any]) -> ChatRequest:
    """The request of a row whose call has attempts in the cache, but no answer."""
    return ChatRequest(
        key=row["call_key"],
        provider=row["provider"],
        endpoint="",
        model=row["model_requested"],
        path="",
        headers={},
        body=row["request"],
        slot=Slot("", 0, row["side"], row["decision"], 0),
    )
