"""Audits by SQL alone (checks.sql): of one sweep, and of what belongs to none."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path

import duckdb

from merge_runner.audit.findings import Audit, Finding, Sharing
from merge_runner.errors import StoreError
from merge_runner.records import ANSWERED_FIELD
from merge_runner.results.comparison import TrialKey
from merge_runner.results.database import append, by_name, fetched, read_database
from merge_runner.results.validity import ASKED_DECISIONS, not_judged
from merge_runner.served_model import other_models
from merge_runner.text_safety import first_line

AUDITED = """
CREATE OR REPLACE TEMP TABLE audited AS
SELECT trial_id, spec_hash FROM linked SEMI JOIN trials USING (trial_id, spec_hash)
ANTI JOIN done USING (trial_id, spec_hash)
"""
# Where the formats have the answer.
ANSWERS = ("choices", "output", "candidates", "content")
# How many decisions of each driver, prompt and model that was asked are invalid.
DECIDED = f"""
SELECT driver || '/' || variant, model, sum(invalid)::BIGINT, sum(asked)::BIGINT
FROM ({ASKED_DECISIONS}) JOIN (SELECT trial_id, spec_hash, variant FROM trials)
    USING (trial_id, spec_hash)
JOIN trial_drivers USING (trial_id, spec_hash) SEMI JOIN audited USING (trial_id, spec_hash)
GROUP BY driver, variant, model, spec_hash ORDER BY ALL
"""  # noqa: S608 # constants
MANY_REPEATED = 5


@contextmanager
def audited_database(path: Path) -> Iterator[duckdb.DuckDBPyConnection]:
    """Open a database with the views of checks.sql; raises UsageError or StoreError."""
    try:
        with read_database(path) as connection:
            prepare(connection)
            yield connection
    except duckdb.Error as exc:
        raise StoreError(f"{path} cannot be audited: {first_line(exc)}") from exc


def prepare(connection: duckdb.DuckDBPyConnection) -> None:
    """Make the views of checks.sql, and read the ids of all replies."""
    make_views(connection)
    append(connection, "other_models", other_models(connection))
    replies = fetched(connection.execute("SELECT rowid, reply::VARCHAR FROM calls"))
    append(connection, "told", [row for place, reply in replies if (row := _told(place, reply))])
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
    """Audit a sweep that has just been played; see ``check_sweep``."""
    with audited_database(path) as connection:
        audit = check_sweep(connection, sweep_id, planned, finished=finished)
        audit.sharings += calls_in_common(connection)
        return audit


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
    audit = Audit(sweep_id, counts, [*_findings(connection, "findings", sweep_id)])
    audit.notes += _notes(connection, counts, finished=finished)
    for earlier, trials in connection.execute("FROM taken_over").fetchall():
        audit.sharings.append(Sharing("trials", sweep_id, earlier, trials))
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
    orphans = "(SELECT kind, trial_id, NULL AS side, NULL AS decision, text FROM orphans)"
    return Audit(
        str(path),
        counts,
        list(_findings(connection, orphans)),
        calls_in_common(connection),
        [] if counts["sweeps"] else ["there is no sweep in this database"],
    )


def calls_in_common(connection: duckdb.DuckDBPyConnection) -> list[Sharing]:
    """Return the calls that several specs share, since their requests were identical."""
    rows = connection.execute("FROM calls_in_common").fetchall()
    return [Sharing("calls", *row) for row in rows]


def answers_alike(connection: duckdb.DuckDBPyConnection) -> int:
    """Return how many answers to prompts asked before are word for word as before, if all are.

    0 where some differ, or where only a few prompts were asked again.
    """
    ((repeated, alike),) = connection.execute("FROM alike").fetchall()
    return int(alike) if alike == repeated >= MANY_REPEATED else 0


def unclear_ids(connection: duckdb.DuckDBPyConnection) -> list[str]:
    """Return notes on servers whose repeated ids prove nothing."""
    return [
        f"{count} replies of {model} at {endpoint or 'its endpoint'} have an id that the server "
        "gave more than once: its ids do not tell whether an answer was given twice"
        for model, endpoint, count in connection.execute("FROM unclear_ids").fetchall()
    ]


def _findings(
    connection: duckdb.DuckDBPyConnection, view: str, sweep_id: str | None = None
) -> Iterator[Finding]:
    rows = connection.execute(f"SELECT DISTINCT * FROM {view} ORDER BY ALL").fetchall()  # noqa: S608 # constants
    for kind, trial, side, decision, text in rows:
        yield Finding(kind, text, sweep_id, trial, side, decision)


def _notes(
    connection: duckdb.DuckDBPyConnection, counts: dict[str, int], *, finished: bool
) -> Iterable[str]:
    missing, failed = counts["missing"], counts["failed"]
    if not finished and (missing or failed):
        yield (
            f"unfinished: {missing} of {counts['trials']} trials are missing, {failed} failed; "
            "the same command again plays them"
        )
    ((elsewhere, later),) = connection.execute(
        "SELECT (SELECT count(*) FROM unplayed WHERE elsewhere), "
        "(SELECT count(*) FROM linked SEMI JOIN done USING (trial_id, spec_hash))"
    ).fetchall()
    if elsewhere:
        yield f"{elsewhere} of its trials were played by another sweep"
    if later:
        yield f"{later} of its trials are checked with a later sweep that has them too"
    yield from unclear_ids(connection)
    scripted = counts["attempts answered by a scripted stand-in"]
    if (alike := answers_alike(connection)) and not scripted:  # the emulator has a few phrases
        yield (
            f"all {alike} answers to prompts that were asked before are word for word as "
            "before: are they samples?"
        )
    for group, model, invalid, asked in connection.execute(DECIDED).fetchall():
        if why := not_judged(model, invalid, asked):
            yield f"{group}: {why}"
