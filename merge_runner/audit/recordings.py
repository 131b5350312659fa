"""The audit of a recording: of what a sweep asked and was answered, without its results."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path

import duckdb

from merge_runner.audit.checks import prepare, unclear_ids
from merge_runner.audit.findings import Audit, Finding
from merge_runner.errors import RecordingError
from merge_runner.llm.cache import CachedCall
from merge_runner.llm.content_hashes import canonical_json, spec_hash, without_prompt
from merge_runner.results.database import SETTINGS, append, in_memory, schema_sql
from merge_runner.results.recorded_study import RecordedSweep, described_sweeps
from merge_runner.results.recording import read_provenance, read_recording
from merge_runner.results.rows import Row, call_row

NO_CONFIG = "it does not say of what sweep it is: trials are not compared"
# Each driver's decisions, with the one before, and how many prompts asked for it.
NUMBERED = """
SELECT trial_id, side, rep, coalesce(lag(decision) OVER driver, -1), decision, calls,
    first_value(calls) OVER driver
FROM (
    SELECT trial_id, calls.side, spec_hash, rep, decision, count(DISTINCT call_key) AS calls
    FROM calls JOIN trials USING (trial_id, spec_hash) GROUP BY ALL
) WINDOW driver AS (PARTITION BY trial_id, side, spec_hash ORDER BY decision) ORDER BY ALL
"""
COUNTS = """
SELECT 'calls', count(DISTINCT call_key) FROM calls
UNION ALL SELECT 'attempts', count(*) FROM calls
UNION ALL SELECT 'reply ids', count(DISTINCT (endpoint, model_requested, reply_id)) FROM reply_ids
UNION ALL (SELECT 'answers ' || outcome, count(*)
FROM (SELECT max_by(outcome, attempt) AS outcome FROM calls GROUP BY call_key)
GROUP BY ALL ORDER BY ALL)
"""
FINDINGS = """
SELECT DISTINCT kind, text, NULL, trial_id, side, decision
FROM (FROM call_findings UNION ALL FROM shared_findings) ORDER BY ALL
"""
BATCH = 1_000
NEVER = datetime(1970, 1, 1)  # noqa: DTZ001 # as the database has all times


def audit_recording(file: Path) -> Audit:
    """Audit a recording; one that is damaged is a finding. Raises UsageError without a file.

    Its calls become those of a database in memory, and the checks of a database read them.
    """
    audit = Audit(str(file))
    with in_memory(SETTINGS) as connection:
        connection.execute(schema_sql())
        try:
            sweeps = described_sweeps(read_provenance(file))
            _fill(connection, read_recording(file))
        except RecordingError as exc:
            return Audit(str(file), findings=[Finding("recording", str(exc))])
        append(connection, "sweeps", map(_sweep_row, range(len(sweeps)), sweeps))
        prepare(connection)
        connection.execute("INSERT INTO audited SELECT trial_id, spec_hash FROM trials")
        audit.counts = dict(connection.execute(COUNTS).fetchall())
        audit.findings += _numbering(connection, sweeps)
        audit.findings += [Finding(*row) for row in connection.execute(FINDINGS).fetchall()]
        for sweep in sweeps:
            audit.findings += _missing(connection, sweep) if sweep.ended and sweep.models else ()
        audit.notes += unclear_ids(connection)
        audit.notes += [] if sweeps else [NO_CONFIG]
    return audit


def _fill(connection: duckdb.DuckDBPyConnection, entries: Iterator[CachedCall]) -> None:
    """Fill the tables with the calls of a recording.

    A spec stands for all requests that differ in the prompt alone, and a trial for a repetition
    of a condition: a recording does not say which prompt variant a call was made for.
    """
    specs: dict[str, str] = {}
    trials: dict[tuple[str, str], Row] = {}
    rows: list[Row] = []
    for entry in entries:
        request, slot = entry.request, entry.request.slot
        asked = (request.endpoint, request.model, request.path, request.headers)
        spec = spec_hash(canonical_json([*asked, without_prompt(request.body)]))
        driver = {"endpoint": request.endpoint}
        specs[spec] = canonical_json({"left": driver, "right": driver})
        trial_id = _trial(slot.condition, slot.repetition, slot.sample_set)
        where = (slot.condition, 0.0, 0.0, slot.repetition, slot.sample_set)
        trials[trial_id, spec] = (
            *(trial_id, spec, None, "llm", None, None, None),
            *where,
            *("finished", None, 0.0, None, False),
        )
        place = (trial_id, spec, slot.side, slot.decision, request)
        rows += [call_row(*place, attempt, cached=True) for attempt in entry.attempts]
        if len(rows) >= BATCH:
            append(connection, "calls", rows)
            rows.clear()
    append(connection, "calls", rows)
    append(connection, "specs", specs.items())
    append(connection, "trials", trials.values())


def _sweep_row(number: int, sweep: RecordedSweep) -> Row:
    config = sweep.model_dump_json(include={"models"})
    return (str(number), sweep.name, NEVER, None, None, config, None, None, "{}")


def _trial(condition: str, repetition: int, sample_set: int) -> str:
    return f"{condition}/rep{repetition:02d}" + (f"/set{sample_set}" if sample_set else "")


def _numbering(
    connection: duckdb.DuckDBPyConnection, sweeps: Sequence[RecordedSweep]
) -> Iterator[Finding]:
    """Every driver is asked from its first decision to its last, once per arm at most.

    Where a driver takes control at its own tunnel's exit, the later one begins later.
    """
    late = any(sweep.begins_late for sweep in sweeps)
    for trial, side, rep, before, number, calls, at_first in connection.execute(
        NUMBERED
    ).fetchall():
        if number > before + 1 and not (late and before == -1):
            # One finding for each hole: the numbers of a foreign file may be of any size.
            text = f"nothing is recorded, though of later ones: the next is {number}"
            yield Finding("numbering", text, None, trial, side, before + 1)
        arms = sum(sweep.arms_of(rep) for sweep in sweeps) if sweeps else at_first
        if calls > arms:
            text = f"{calls} requests are recorded, for {arms} prompt variants"
            yield Finding("numbering", text, None, trial, side, number)


def _missing(connection: duckdb.DuckDBPyConnection, sweep: RecordedSweep) -> Iterator[Finding]:
    """Of a sweep that has ended, every trial has a call on each side that is asked at all."""
    there = set(connection.execute("SELECT DISTINCT trial_id, side FROM calls").fetchall())
    sides = sorted({side for _, side in there}) or [None]
    for condition in sweep.conditions:
        for repetition in range(1, max(sweep.repetitions.values(), default=0) + 1):
            trial = _trial(condition, repetition, sweep.sample_set)
            for side in sides:
                if (trial, side) not in there:
                    yield Finding("missing", "nothing is recorded", trial=trial, side=side)
