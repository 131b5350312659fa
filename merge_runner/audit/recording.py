"""Audit of a recording, by the checks of a database."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from itertools import islice
from pathlib import Path

import duckdb

from merge_runner.audit.checks import (
    CHECKS,
    Audit,
    Finding,
    counted,
    findings_of,
    notes_of,
    of_calls,
    prepare,
)
from merge_runner.errors import RecordingError
from merge_runner.llm.store import CachedCall
from merge_runner.records import SIDES, canonical_json
from merge_runner.results.appender import append
from merge_runner.results.database import schema_sql
from merge_runner.results.instance import SETTINGS, SIZES, in_memory
from merge_runner.results.recorded_sweeps import described_sweeps
from merge_runner.results.recording import read_provenance, read_recording
from merge_runner.results.rows import Row, TrialKey, call_row

ENTRIES_AT_ONCE = 100
NEVER = datetime(1970, 1, 1)  # noqa: DTZ001 # times of the database have no zone


def audit_recording(file: Path) -> Audit:
    """Audit a recording; damage is a finding. Raises UsageError without a file.

    Its calls are written into a database in memory, with the checks of a database.
    """
    with in_memory(SETTINGS) as connection:
        connection.execute(schema_sql())
        try:
            _fill(connection, read_recording(file))
            sweeps = described_sweeps(read_provenance(file))
        except RecordingError as exc:
            return Audit(str(file), findings=[Finding("recording", str(exc))])
        configs = (canonical_json({"models": sweep.models}) for sweep in sweeps)
        rows = ((n, "", NEVER, None, None, c, None, None, "{}") for n, c in enumerate(configs))
        append(connection, "sweeps", rows)  # for the aliases of models
        [(longest, _)] = connection.execute(SIZES).fetchall()
        prepare(connection, longest)
        connection.execute(CHECKS["trials"])
        connection.execute("INSERT INTO audited SELECT trial_id, spec_hash FROM trials")
        counts, possible = counted(connection)
        shown = {name: counts[name] for name in ("calls", "attempts", "reply ids")}
        findings = findings_of(connection, of_calls(possible))
        return Audit(str(file), shown, findings, notes=[*notes_of(connection, counts, possible)])


def _fill(connection: duckdb.DuckDBPyConnection, entries: Iterator[CachedCall]) -> None:
    """Fill the tables with the calls of a recording.

    Each endpoint becomes a spec, and each repetition of a condition a trial: a recording does not
    have the prompt variant of a call.
    """
    specs: dict[str, str] = {}
    trials: dict[TrialKey, Row] = {}
    while chunk := list(islice(entries, ENTRIES_AT_ONCE)):
        rows: list[Row] = []
        for entry in chunk:
            slot, endpoint = entry.request.slot, entry.request.endpoint
            specs[endpoint] = canonical_json({side: {"endpoint": endpoint} for side in SIDES})
            suffix = f"/set{slot.sample_set}" if slot.sample_set else ""
            key = (f"{slot.condition}/rep{slot.repetition:02d}{suffix}", endpoint)
            trials[key] = (
                *(*key, None, "llm", None, None, None, slot.condition, 0.0, 0.0),
                *(slot.repetition, slot.sample_set, "finished", None, 0.0, None, False, None),
            )
            rows += [
                call_row(key, entry.request, attempt, cached=True) for attempt in entry.attempts
            ]
        append(connection, "calls", rows)
    append(connection, "specs", specs.items())
    append(connection, "trials", trials.values())
