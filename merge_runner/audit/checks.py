"""Audits in SQL (checks.sql): of a sweep, and of orphan rows."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Any

import duckdb

from merge_runner.errors import StoreError
from merge_runner.paths import named_queries
from merge_runner.results.appender import append
from merge_runner.results.database import by_name, read_database
from merge_runner.results.instance import limit_memory
from merge_runner.results.rows import TrialKey
from merge_runner.served_model import other_models
from merge_runner.text_safety import first_line

# Members of a reply that hold the model's answer, over all wire formats.
ANSWER_MEMBERS = ("choices", "output", "candidates", "content")
MOST_INVALID_SHARE = 0.2
# One row per ended trial and called model. An invalid decision is a fallback.
ASKED_DECISIONS = """
SELECT trial_id, spec_hash, if(side = 'left', model_left, model_right) AS model,
    count(*) AS asked, count(*) FILTER (NOT valid) AS invalid
FROM decisions JOIN trials USING (trial_id, spec_hash)
WHERE call_key IS NOT NULL AND status <> 'failed' GROUP BY ALL
"""
# Invalid decisions by driver, prompt and called model.
DECIDED = f"""
SELECT driver || '/' || variant, model, sum(invalid)::BIGINT, sum(asked)::BIGINT
FROM ({ASKED_DECISIONS}) JOIN (SELECT trial_id, spec_hash, variant FROM trials)
    USING (trial_id, spec_hash)
JOIN drivers USING (trial_id, spec_hash) SEMI JOIN audited USING (trial_id, spec_hash)
GROUP BY driver, variant, model, spec_hash ORDER BY ALL
"""  # noqa: S608 # constants
REPLIES = "SELECT rowid, reply::VARCHAR FROM calls WHERE rowid IN (SELECT unnest(?))"
OF_MOCKS = "attempts answered by a mock model"
"""The column of ``counts`` with the replies of mock models."""
FINDINGS_SHOWN = 20
FEW_TRIALS = 16
"""Trials with short replies up to which queries take longer to optimize than to run."""
REPLIES_AT_ONCE = 4_000
LONG_REPLY, PARSED_BYTES = 2**15, 2**25
"""Length above which replies are parsed few at once, and the bytes at once; else 2,048 replies."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Violation of a check, with its place; docs/recordings.md lists the kinds."""

    kind: str
    text: str
    sweep: str | None = None
    trial: str | None = None
    side: str | None = None
    decision: int | None = None

    @property
    def where(self) -> str:
        """Its place, such as ``SWEEP, TRIAL, left, decision 3``; empty for none."""
        number = None if self.decision is None else f"decision {self.decision}"
        return ", ".join(filter(None, (self.sweep, self.trial, self.side, number)))

    def __str__(self) -> str:
        return ": ".join(filter(None, (self.kind, self.where, self.text)))


@dataclass(slots=True)
class Audit:
    """Audit of ``subject``: a sweep, a database, a recording or a cache.

    ``counts`` are the numbers of checked items, in the order of the checks; for a sweep they
    include ``missing`` and ``failed`` trials. The audit passes without a finding.
    """

    subject: str
    counts: dict[str, int] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """True without a finding."""
        return not self.findings

    def as_dict(self) -> dict[str, Any]:
        """Return the audit as JSON values."""
        return {**asdict(self), "ok": self.ok}

    def lines(self) -> Iterator[str]:
        """Yield the audit as lines of text, with the first findings."""
        number = len(self.findings)
        yield f"{self.subject}: " + (f"{number} findings" if number else "all holds")
        yield "  checked: " + ", ".join(f"{n} {name}" for name, n in self.counts.items())
        yield from (f"  note: {text}" for text in self.notes)
        yield from (f"  {finding}" for finding in self.findings[:FINDINGS_SHOWN])
        if number > FINDINGS_SHOWN:
            yield f"  and {number - FINDINGS_SHOWN} more, all of them with --json"


CHECKS, FACTS, REST = (
    named_queries(Path(__file__).with_name(name))
    for name in ("checks.sql", "facts.sql", "rest.sql")
)
OF_CALLS = ("served_findings", "attempt_findings", "exchanged_findings", "shared_findings")


@contextmanager
def audited_database(
    path: Path, sweep_id: str | None = None
) -> Iterator[duckdb.DuckDBPyConnection]:
    """Open a database with the tables of checks.sql and the replies of one sweep, or of all.

    Raises UsageError or StoreError.
    """
    try:
        with read_database(path) as connection:
            longest = limit_memory(connection)
            [(trials,)] = connection.execute("SELECT count(*) FROM trials").fetchall()
            # Without the optimizer, an audit of long replies exceeds the limit of memory.
            if trials <= FEW_TRIALS and longest <= LONG_REPLY:
                connection.execute("PRAGMA disable_optimizer")  # of this connection alone
            prepare(connection, longest, sweep_id)
            yield connection
    except duckdb.Error as exc:
        raise StoreError(f"{path} cannot be audited: {first_line(exc)}") from exc


def prepare(
    connection: duckdb.DuckDBPyConnection, longest: int, sweep_id: str | None = None
) -> None:
    """Create the tables of checks.sql, and read the reply ids of a sweep, or of all.

    Replies whose id is repeated are compared. ``longest`` is the length of the longest reply.
    """
    connection.execute(CHECKS["tables"])
    append(connection, "other_models", other_models(connection))
    connection.execute("SET VARIABLE sweep_id = ?", [sweep_id])
    [(rows,)] = connection.execute("SELECT coalesce(max(rowid), -1) + 1 FROM calls").fetchall()
    step = max(1, PARSED_BYTES // longest if longest > LONG_REPLY else rows)
    for first in range(0, rows, step):
        span = f"SET VARIABLE first_row = {first}; SET VARIABLE last_row = {first + step - 1}"
        connection.execute(f"{span}; {CHECKS['ids']}")
    connection.execute(CHECKS["reply_ids"])
    rowids = [rowid for (rowid,) in connection.execute(CHECKS["repeated_replies"]).fetchall()]
    for first in range(0, len(rowids), REPLIES_AT_ONCE):  # a chunk is in memory at once
        replies = connection.execute(REPLIES, [rowids[first : first + REPLIES_AT_ONCE]]).fetchall()
        append(connection, "contents", [(rowid, _content(reply)) for rowid, reply in replies])
    if rowids:
        connection.execute(CHECKS["repeated_ids"])


def _content(reply: str) -> str:
    """Return a hash of the answer in a reply that is a JSON object.

    Members other than the answer, such as a time, may differ in a copy. In an unknown format the
    hash covers the whole body: else all its answers would be equal.
    """
    body = json.loads(reply)
    known = (body[name] for name in ANSWER_MEMBERS if body.get(name) is not None)
    answer = json.dumps(next(known, body)).encode()
    return hashlib.blake2b(answer, digest_size=16).hexdigest()


def result(connection: duckdb.DuckDBPyConnection, query: str) -> duckdb.DuckDBPyConnection:
    """Run a query, for which the table ``drivers`` is made if it reads that."""
    if "JOIN drivers " in query:
        connection.execute(CHECKS["drivers"])
    return connection.execute(query)


def sweep_facts(connection: duckdb.DuckDBPyConnection, sweep_id: str) -> dict[str, Any]:
    """Count a sweep's trials, decisions and replies in an audited database."""
    connection.execute("SET VARIABLE sweep_id = ?", [sweep_id])
    connection.execute(FACTS["tables"])
    facts = next(by_name(connection.execute(FACTS["decided"])))
    for name in ("outcomes", "failed", "others", "stand_ins", "same_prompts"):
        facts[name] = result(connection, FACTS[name]).fetchall() if facts.get(name, True) else []
    for name in ("levels", "first_looks"):
        facts[name] = (
            list(by_name(result(connection, FACTS[name]))) if facts.get(name, True) else []
        )
    return facts


def counted(connection: duckdb.DuckDBPyConnection) -> tuple[dict[str, int], set[str]]:
    """Return the numbers of checked items, and the names of the blocks that may have a row."""
    counts = dict(connection.execute(CHECKS["counts"]).fetchall())
    possible = {block for (block,) in connection.execute(CHECKS["possible"]).fetchall()}
    if counts["attempts"] > counts["calls"]:
        possible.add("attempt_findings")
    return counts, possible | {"exchanged_findings"}


def of_calls(possible: Collection[str]) -> list[str]:
    """Return the queries for findings about calls, of the ``possible`` blocks."""
    return [CHECKS[name] for name in OF_CALLS if name in possible]


def check_sweep(
    connection: duckdb.DuckDBPyConnection,
    sweep_id: str,
    planned: Sequence[TrialKey],
    *,
    finished: bool,
) -> Audit:
    """Audit the trials of a sweep that were not audited with another sweep before.

    ``planned`` is empty if the sweep's trials are not known. Missing and failed trials are findings
    in a ``finished`` sweep, and a note in an unfinished one.
    """
    connection.execute("DELETE FROM subject; DELETE FROM planned")
    append(connection, "subject", [(sweep_id, finished, bool(planned))])
    append(connection, "planned", planned)
    connection.execute(CHECKS["trials"])
    numbers, possible = counted(connection)
    counts = {"trials": len(planned), **numbers}
    queries = [CHECKS["list_findings"], *of_calls(possible)]
    findings = findings_of(connection, queries, sweep_id)
    notes = [*notes_of(connection, counts, possible)]
    missing, failed = counts["missing"], counts["failed"]
    if not finished and missing + failed:
        text = f"unfinished: {missing} of {len(planned)} trials are missing, {failed} failed"
        notes.insert(0, f"{text}; the same command again plays them")
    connection.execute("INSERT INTO done FROM audited")
    return Audit(sweep_id, counts, findings, notes)


def check_rest(connection: duckdb.DuckDBPyConnection, path: Path) -> Audit:
    """Audit a database for orphan rows, and note calls that sweeps share."""
    connection.execute(
        "CREATE OR REPLACE TEMP TABLE audited AS SELECT trial_id, spec_hash FROM trials"
    )
    sql = """
        FROM (SELECT count(*) AS sweeps FROM sweeps), (SELECT count(*) AS trials,
            count(*) FILTER (source = 'human') AS "human trials" FROM trials)
    """
    counts = next(by_name(connection.execute(sql)))
    shared = result(connection, REST["calls_in_common"]).fetchall()
    notes = [f"{first} and {second} share {calls} calls" for first, second, calls in shared]
    return Audit(str(path), counts, findings_of(connection, [REST["orphans"]]), notes)


def findings_of(
    connection: duckdb.DuckDBPyConnection, queries: Iterable[str], sweep_id: str | None = None
) -> list[Finding]:
    """Return the rows of the queries, one by one: a joint query would need their joint memory."""
    selects = (f"SELECT DISTINCT * FROM ({query}) ORDER BY ALL" for query in queries)  # noqa: S608 # constants
    rows = [row for select in selects for row in by_name(result(connection, select))]
    return [
        Finding(r["kind"], r["text"], sweep_id, r["trial_id"], r.get("side"), r.get("decision"))
        for r in sorted(rows, key=itemgetter("kind"))
    ]


def notes_of(
    connection: duckdb.DuckDBPyConnection, counts: Mapping[str, int], possible: Collection[str]
) -> Iterator[str]:
    """Yield the notes of an audit with these ``counts`` and ``possible`` blocks."""
    if "notes" in possible:
        yield from (text for (text,) in connection.execute(CHECKS["notes"]).fetchall())
    if not counts[OF_MOCKS]:  # the emulator has only a few phrases
        [(answers,)] = connection.execute(CHECKS["alike"]).fetchall()
        if answers:
            yield (
                f"all {answers} replies to prompts that were asked before are word for word as "
                "before: are they samples?"
            )
    decided = result(connection, DECIDED).fetchall() if counts["invalid"] else []
    for group, model, invalid, asked in decided:
        if reason := not_judged(model, invalid, asked):
            yield f"{group}: {reason}"


def not_judged(model: str, invalid: int, asked: int) -> str:
    """Return why a model is not judged; "" for a share of invalid decisions within the limit."""
    if invalid <= MOST_INVALID_SHARE * asked:
        return ""
    return (
        f"not judged: {invalid} of the {asked} decisions of {model} are invalid "
        f"({100 * invalid / asked:.1f} %, more than {100 * MOST_INVALID_SHARE:.0f} %)"
    )
