"""Audits by SQL alone (checks.sql): of one sweep, of what belongs to none, and of a recording."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from datetime import datetime
from importlib.resources import files
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import Any

import duckdb

from merge_runner.errors import RecordingError, StoreError
from merge_runner.llm.store import CachedCall
from merge_runner.records import ANSWERED_FIELD, SIDES, canonical_json
from merge_runner.results.database import (
    SETTINGS,
    append,
    by_name,
    in_memory,
    limit_memory,
    read_database,
    schema_sql,
)
from merge_runner.results.recording import described_sweeps, read_provenance, read_recording
from merge_runner.results.rows import Row, TrialKey, call_row
from merge_runner.served_model import other_models
from merge_runner.text_safety import first_line

AUDITED = """
CREATE OR REPLACE TEMP TABLE audited AS
SELECT trial_id, spec_hash FROM linked SEMI JOIN trials USING (trial_id, spec_hash)
ANTI JOIN done USING (trial_id, spec_hash)
"""
# Where the formats have the answer.
ANSWERS = ("choices", "output", "candidates", "content")
MOST_INVALID_SHARE = 0.2
# One row a trial that ended and a model that was asked in it. An invalid decision is a fallback.
ASKED_DECISIONS = """
SELECT trial_id, spec_hash, if(side = 'left', model_left, model_right) AS model,
    count(*) AS asked, count(*) FILTER (NOT valid) AS invalid
FROM decisions JOIN trials USING (trial_id, spec_hash)
WHERE call_key IS NOT NULL AND status <> 'failed' GROUP BY ALL
"""
# How many decisions of each driver, prompt and model that was asked are invalid.
DECIDED = f"""
SELECT driver || '/' || variant, model, sum(invalid)::BIGINT, sum(asked)::BIGINT
FROM ({ASKED_DECISIONS}) JOIN (SELECT trial_id, spec_hash, variant FROM trials)
    USING (trial_id, spec_hash)
JOIN trial_drivers USING (trial_id, spec_hash) SEMI JOIN audited USING (trial_id, spec_hash)
GROUP BY driver, variant, model, spec_hash ORDER BY ALL
"""  # noqa: S608 # constants
# Of one sweep, or of all.
AUDITED_CALLS = """
calls WHERE ($sweep_id IS NULL OR (trial_id, spec_hash) IN
    (SELECT (trial_id, spec_hash) FROM sweep_trials WHERE sweep_id = $sweep_id))
"""
PLACES = f"SELECT rowid FROM {AUDITED_CALLS} ORDER BY rowid"  # noqa: S608 # constants
REPLIES = f"""
SELECT rowid, reply::VARCHAR FROM {AUDITED_CALLS} AND rowid BETWEEN $first AND $last
"""  # noqa: S608 # constants
OF_CALLS = ("served_findings", "attempt_findings", "exchanged_findings", "shared_findings")
BATCH = 100
SHOWN = 20
REPLIES_AT_ONCE = 4_000
NEVER = datetime(1970, 1, 1)  # noqa: DTZ001 # as the database has all times


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that does not hold, and where; docs/recordings.md lists the kinds."""

    kind: str
    text: str
    sweep: str | None = None
    trial: str | None = None
    side: str | None = None
    decision: int | None = None

    def __str__(self) -> str:
        number = None if self.decision is None else f"decision {self.decision}"
        where = ", ".join(filter(None, (self.sweep, self.trial, self.side, number)))
        return f"{self.kind}: {where}: {self.text}" if where else f"{self.kind}: {self.text}"


@dataclass(slots=True)
class Audit:
    """What was checked of ``subject``: a sweep, a database, a recording or a cache.

    The checks add to it. ``counts`` say how much was checked, in the order of checking; of a sweep
    among them ``missing`` and ``failed`` trials. All holds where there is no finding.
    """

    subject: str
    counts: dict[str, int] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether all holds."""
        return not self.findings

    def as_dict(self) -> dict[str, Any]:
        """The audit as JSON values."""
        return {**asdict(self), "ok": self.ok}

    def lines(self) -> Iterator[str]:
        """The audit for a reader, with the first findings."""
        number = len(self.findings)
        yield f"{self.subject}: " + (f"{number} findings" if number else "all holds")
        yield "  checked: " + ", ".join(f"{n} {name}" for name, n in self.counts.items())
        yield from (f"  note: {text}" for text in self.notes)
        yield from (f"  {finding}" for finding in self.findings[:SHOWN])
        if number > SHOWN:
            yield f"  and {number - SHOWN} more, all of them with --json"


@contextmanager
def audited_database(
    path: Path, sweep_id: str | None = None
) -> Iterator[duckdb.DuckDBPyConnection]:
    """Open a database with the views of checks.sql; raises UsageError or StoreError.

    Replies are read of one sweep, or of all.
    """
    try:
        with read_database(path) as connection:
            limit_memory(connection)
            prepare(connection, sweep_id)
            yield connection
    except duckdb.Error as exc:
        raise StoreError(f"{path} cannot be audited: {first_line(exc)}") from exc


def prepare(connection: duckdb.DuckDBPyConnection, sweep_id: str | None = None) -> None:
    """Make the views of checks.sql, and read the ids of the replies of a sweep, or of all."""
    make_views(connection)
    append(connection, "other_models", other_models(connection))
    of = {"sweep_id": sweep_id}
    places = [place for (place,) in connection.execute(PLACES, of).fetchall()]
    for first in range(0, len(places), REPLIES_AT_ONCE):  # what they tell lies in memory meanwhile
        last = min(first + REPLIES_AT_ONCE, len(places)) - 1
        between = {**of, "first": places[first], "last": places[last]}
        some = connection.execute(REPLIES, between).fetchall()
        append(connection, "told", [row for each in some if (row := _told(*each))])
    connection.execute("INSERT INTO reply_ids FROM identified")


def _told(place: int, reply: str | None) -> tuple[int, str | None, str, str] | None:
    """Return what a reply tells: its id, a hash of its answer, and what it says that it answers.

    What is beside the answer, such as a time, may differ in a copy. In an unknown format everything
    counts: else any two of its answers would be equal.
    """
    try:
        body = json.loads(reply or "")
    except (ValueError, RecursionError):
        return None
    if not isinstance(body, dict):
        return None
    found = body.get("id") or body.get("responseId")
    reply_id = found.encode(errors="replace").decode() if isinstance(found, str) else None
    known = (body[name] for name in ANSWERS if body.get(name) is not None)
    answer = json.dumps(next(known, body)).encode()
    content = hashlib.blake2b(answer, digest_size=16).hexdigest()
    return place, reply_id, content, json.dumps(body.get(ANSWERED_FIELD))


def make_views(connection: duckdb.DuckDBPyConnection) -> None:
    """Make the views of checks.sql, of which ``alike`` reads ``audited`` alone."""
    connection.execute(files("merge_runner.audit").joinpath("checks.sql").read_text("utf-8"))


def audit_sweep(path: Path, sweep_id: str, planned: Sequence[TrialKey], *, finished: bool) -> Audit:
    """Audit a sweep that has just been played by its own replies; see ``check_sweep``."""
    with audited_database(path, sweep_id) as connection:
        return check_sweep(connection, sweep_id, planned, finished=finished)


def check_sweep(
    connection: duckdb.DuckDBPyConnection,
    sweep_id: str,
    planned: Sequence[TrialKey],
    *,
    finished: bool,
) -> Audit:
    """Audit the trials of a sweep that were not audited with another one.

    ``planned`` is empty where the sweep's trials are not known. In a sweep that claims to have
    ``finished``, missing and failed trials are findings; in another one they are a note.
    """
    connection.execute("DELETE FROM subject; DELETE FROM planned")
    append(connection, "subject", [(sweep_id, finished, bool(planned))])
    append(connection, "planned", planned)
    connection.execute(AUDITED)
    counts = {"trials": len(planned), **next(by_name(connection.execute("FROM counts")))}
    views = ("list_findings", "state_findings", *OF_CALLS)
    findings = _findings(connection, views, sweep_id)
    audit = Audit(sweep_id, counts, findings, [*_notes(connection)])
    connection.execute("INSERT INTO done FROM audited")
    return audit


def check_rest(connection: duckdb.DuckDBPyConnection, path: Path) -> Audit:
    """Audit what a database holds beside and between its sweeps."""
    connection.execute(
        "CREATE OR REPLACE TEMP TABLE audited AS SELECT trial_id, spec_hash FROM trials"
    )
    sql = """
        FROM (SELECT count(*) AS sweeps FROM sweeps), (SELECT count(*) AS trials,
            count(*) FILTER (source = 'human') AS "human trials" FROM trials)
    """
    counts = next(by_name(connection.execute(sql)))
    shared = connection.execute("FROM calls_in_common").fetchall()
    notes = [f"{first} and {second} share {calls} calls" for first, second, calls in shared]
    return Audit(str(path), counts, _findings(connection, ["orphans"]), notes)


def _findings(
    connection: duckdb.DuckDBPyConnection, views: Iterable[str], sweep_id: str | None = None
) -> list[Finding]:
    """What the views hold, read one by one: as one query they would hold their memory together."""
    selects = (f"SELECT DISTINCT * FROM {view} ORDER BY ALL" for view in views)  # noqa: S608 # constants
    rows = [row for select in selects for row in by_name(connection.execute(select))]
    return [
        Finding(r["kind"], r["text"], sweep_id, r["trial_id"], r.get("side"), r.get("decision"))
        for r in sorted(rows, key=itemgetter("kind"))
    ]


def _notes(connection: duckdb.DuckDBPyConnection) -> Iterator[str]:
    yield from (text for (text,) in connection.execute("FROM notes").fetchall())
    for group, model, invalid, asked in connection.execute(DECIDED).fetchall():
        if why := not_judged(model, invalid, asked):
            yield f"{group}: {why}"


def not_judged(model: str, invalid: int, asked: int) -> str:
    """Why nothing is concluded from a model's trials; empty where few enough are invalid."""
    if invalid <= MOST_INVALID_SHARE * asked:
        return ""
    return (
        f"not judged: {invalid} of the {asked} decisions of {model} are invalid "
        f"({100 * invalid / asked:.1f} %, more than {100 * MOST_INVALID_SHARE:.0f} %)"
    )


def audit_recording(file: Path) -> Audit:
    """Audit a recording; one that is damaged is a finding. Raises UsageError without a file.

    Its calls become those of a database in memory, and the checks of a database read them.
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
        append(connection, "sweeps", rows)  # of which the aliases of models are read
        prepare(connection)
        connection.execute("INSERT INTO audited SELECT trial_id, spec_hash FROM trials")
        columns = 'calls, attempts, "reply ids"'
        counts = next(by_name(connection.execute(f"SELECT {columns} FROM counts")))  # noqa: S608 # constants
        findings = _findings(connection, OF_CALLS)
        return Audit(str(file), counts, findings, notes=[*_notes(connection)])


def _fill(connection: duckdb.DuckDBPyConnection, entries: Iterator[CachedCall]) -> None:
    """Fill the tables with the calls of a recording.

    A spec stands for an endpoint, and a trial for a repetition of a condition: a recording does not
    say which prompt variant a call was made for.
    """
    specs: dict[str, str] = {}
    trials: dict[TrialKey, Row] = {}
    while batch := list(islice(entries, BATCH)):
        rows: list[Row] = []
        for entry in batch:
            slot, endpoint = entry.request.slot, entry.request.endpoint
            specs[endpoint] = canonical_json({side: {"endpoint": endpoint} for side in SIDES})
            set_ = f"/set{slot.sample_set}" if slot.sample_set else ""
            key = (f"{slot.condition}/rep{slot.repetition:02d}{set_}", endpoint)
            trials[key] = (
                *(*key, None, "llm", None, None, None, slot.condition, 0.0, 0.0),
                *(slot.repetition, slot.sample_set, "finished", None, 0.0, None, False, None),
            )
            rows += [call_row(key, entry.request, each, cached=True) for each in entry.attempts]
        append(connection, "calls", rows)
    append(connection, "specs", specs.items())
    append(connection, "trials", trials.values())
