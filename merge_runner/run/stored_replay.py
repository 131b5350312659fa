"""The audit of a database: a replay, whose rows are compared with the stored ones.

The plan comes from the sweep's row, and the replies from the table ``calls`` or from a cache.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, nullcontext, suppress
from dataclasses import dataclass, field, fields, replace
from itertools import product
from operator import itemgetter
from pathlib import Path
from typing import Any

import duckdb

from merge_runner.audit.checks import Audit, Finding, audited_database, check_rest, check_sweep
from merge_runner.errors import MergeRunnerError, RecordingError, UsageError
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.formats import WireFormat
from merge_runner.llm.http_outcome import RawReply, judge
from merge_runner.llm.store import CachedCall
from merge_runner.records import (
    ANSWERS,
    DAMAGED,
    SIDES,
    Attempt,
    CallFailed,
    ChatRequest,
    Usage,
    canonical_json,
)
from merge_runner.registry import Catalogue, in_use, require, using
from merge_runner.results.database import read_database
from merge_runner.results.replay_misses import leaves
from merge_runner.results.rows import Stored, in_order, rows_of
from merge_runner.run.parts import find_parts
from merge_runner.run.plan import Plan
from merge_runner.run.replay import Replay
from merge_runner.run.spec import trial_id
from merge_runner.study.parts import declared_catalogue
from merge_runner.text_safety import one_line
from merge_runner.trial_records import TrialRecord, TrialSpec

TOLERANCE = 1e-9
"""Numbers may differ by this much, as between the arithmetic of two machines."""
# The columns that no replay gives; docs/recordings.md lists them. Replies in the database are read
# anew, without times, cost and batch. A cache has these columns of ``calls``, except ``cached``.
NOT_REPLAYED = (
    "calls.cached",
    "calls.started_at",
    "calls.latency_s",
    "calls.cost_usd",
    "calls.batch_id",
    "sweeps.ended_at",
    "sweeps.exit_code",
    "sweeps.git_commit",
    "sweeps.git_dirty",
    "sweeps.versions",
)
# Members of a spec that change with the program or its data, not with the sweep's configuration.
OF_THE_PROGRAM = (
    "spec_version",
    "prompt_blocks",
    *(f"{side}.{name}" for side in SIDES for name in ("source", "revision", "data")),
)
HINT = "install the package that registers it, or name the study: --study FILE"
SWEEPS = """
SELECT sweep_id, config::VARCHAR, coalesce(exit_code = 0, false) FROM sweeps
ORDER BY started_at DESC, sweep_id DESC
"""


def audit_database(
    path: Path, sweep_ids: Sequence[str] | None = None, cache: Path | None = None
) -> list[Audit]:
    """Return the audits of all sweeps, oldest first, and of the orphan rows; or of some sweeps.

    A trial that several sweeps have is audited with the newest of them, which is audited first.
    The replies come from the folder ``cache``, if it is named, and are compared with the stored
    ones. Raises UsageError.
    """
    opened = nullcontext() if cache is None else closing(ResponseCache(cache, read_only=True))
    with audited_database(path) as connection, opened as named_cache:
        sweeps = {row[0]: row for row in connection.execute(SWEEPS).fetchall()}
        if sweep_ids is not None:
            oldest_first = dict(reversed(sweeps.items()))
            for sweep_id in sweep_ids:
                require(oldest_first, "sweep", sweep_id, f"in {path}")
            sweeps = {name: row for name, row in sweeps.items() if name in sweep_ids}
        audits = [
            _audit(connection, name, config, named_cache, finished=finished)
            for name, config, finished in sweeps.values()
        ]
        orphans = [check_rest(connection, path)] if sweep_ids is None else []
        return [*reversed(audits), *orphans]


def check_programs(path: Path, plan: Plan, stored: Sequence[TrialSpec]) -> None:
    """Raise UsageError if a program drives differently from a stored trial of its revision.

    One trial of each spec with a program is played, by the stored replies.
    """
    arms = plan.by_label()
    programs = {
        name: sorted({*arm.full_names.values()} - {*arm.entries}) for name, arm in arms.items()
    }
    firsts = {spec.spec_hash: spec for spec in reversed(stored) if programs[spec.arm]}
    if not firsts:
        return
    with read_database(path) as connection:
        for record, tables in _played(connection, plan, firsts.values()):
            key, driven, states = record.spec.key, rows_of(record)["states"], tables["states"]
            if record.failed_calls:  # a model saw another situation, and no stored reply is to that
                step = states.names.index("step")
                last = max((row[step] for row in driven), default=-1)
                known = [row for row in states.rows.get(key, ()) if row[step] <= last]
                states = states._replace(rows={key: known})
            differences = states.differences(key, driven, tolerance=TOLERANCE)
            if difference := next(iter(differences), None):
                raise UsageError(
                    f"{' or '.join(programs[record.spec.arm])} drives otherwise than in the trial "
                    f"{key[0]} of {path} ({difference.text}): give its class another `revision`, "
                    "so that its trials are played anew, or name another --db"
                )


def _audit(
    connection: duckdb.DuckDBPyConnection,
    sweep_id: str,
    config: str,
    cache: ResponseCache | None,
    *,
    finished: bool,
) -> Audit:
    problems: list[Finding] = []
    notes: Counter[str] = Counter()
    planned: dict[str, str] = {}
    specs: list[TrialSpec] = []
    try:
        plan = Plan.model_validate_json(config)
        stored, members = json.loads(config), plan.model_dump(mode="json").items()
        if wrong := [name for name, value in members if stored.get(name, value) != value]:
            text = f"it disagrees with itself in {', '.join(wrong)}"
            problems.append(Finding("config", text, sweep_id))
        planned = {
            trial_id(plan, arm, condition, repetition): ""
            for arm, condition in product(plan.arms, plan.conditions)
            for repetition in range(1, arm.repetitions + 1)
        }
        # The stored plug-ins are somebody's code and never run.
        known = in_use() if in_use().text else declared_catalogue(plan.study.file)
        plan = _installed_part(connection, plan, known, notes)
        specs = plan.trial_specs()
        planned |= {spec.trial_id: spec.spec_hash for spec in specs}
    except (*DAMAGED, AttributeError, MergeRunnerError) as exc:
        why = f"its configuration cannot be read, so that its trials are not known: {exc}"
        problems.append(Finding("config", one_line(why), sweep_id))
    audit = check_sweep(connection, sweep_id, list(planned.items()), finished=finished)
    audit.findings += problems
    if specs:
        specs = _replayable(connection, plan, specs, audit, notes)
        audit.counts["replayed"] = len(specs)
        with using(plan.parts.catalogue):
            for record, tables in _played(connection, plan, specs, cache):
                kind = "replay" if cache is None else "cache"
                audit.findings += _findings(record, tables, kind, sweep_id)
    audit.notes += [f"not replayed: {count} trials, since {why}" for why, count in notes.items()]
    return audit


def _installed_part(
    connection: duckdb.DuckDBPyConnection, plan: Plan, known: Catalogue, notes: Counter[str]
) -> Plan:
    """Return the arms of a plan that are installed or ``known``; the notes count other trials.

    Reads the human trials that the arms replay.
    """
    arms = []
    for arm in plan.arms:
        try:
            find_parts([arm], plan.conditions, known, HINT)
        except MergeRunnerError as exc:
            notes[str(exc)] += arm.repetitions * len(plan.conditions)
        else:
            arms.append(arm)
    parts = find_parts(arms, plan.conditions if arms else (), known).with_humans(connection)
    return plan.model_copy(update={"arms": tuple(arms), "parts": parts})


def _replayable(
    connection: duckdb.DuckDBPyConnection,
    plan: Plan,
    specs: Sequence[TrialSpec],
    audit: Audit,
    notes: Counter[str],
) -> list[TrialSpec]:
    """Return the audited trials whose stored spec equals the planned one.

    A spec that differs only in OF_THE_PROGRAM comes from another version of the program or other
    data, and adds to a note. Any other difference is a finding.
    """
    hashes = dict(connection.execute("SELECT trial_id, spec_hash FROM audited").fetchall())
    stored = dict(connection.execute("SELECT spec_hash, spec::VARCHAR FROM specs").fetchall())
    planned = plan.specs()
    for spec in specs:
        actual = hashes.get(spec.trial_id, spec.spec_hash)
        if actual == spec.spec_hash:
            continue
        texts = (stored.get(actual, "{}"), planned[spec.spec_hash])
        old, new = (dict(leaves(json.loads(text))) for text in texts)
        names = sorted(name for name in {**old, **new} if old.get(name) != new.get(name))
        if all(name.startswith(OF_THE_PROGRAM) for name in names):
            notes[f"they were made by another version or other data: {', '.join(names)}"] += 1
        else:
            text = f"its spec is not what the sweep says in {', '.join(names)}"
            audit.findings.append(Finding("spec", text, audit.subject, spec.trial_id))
    return [spec for spec in specs if hashes.get(spec.trial_id) == spec.spec_hash]


def _played(
    connection: duckdb.DuckDBPyConnection,
    plan: Plan,
    specs: Iterable[TrialSpec],
    cache: ResponseCache | None = None,
) -> Iterator[tuple[TrialRecord, Mapping[str, Stored]]]:
    """Play trials by the replies of a cache, or else the stored ones; yield them and their rows."""
    stored = StoredReplies(plan)
    replay = Replay(plan, cache or stored)
    by_key = {spec.key: spec for spec in specs}
    for key, tables in in_order(connection, by_key):
        stored.spec, stored.rows = by_key[key], [*tables["calls"].named(key)]
        yield replay.play_one(stored.spec), tables


@dataclass
class StoredReplies:
    """The replies in the table ``calls``: ``rows`` of one trial."""

    plan: Plan
    spec: TrialSpec = field(init=False)
    rows: list[dict[str, Any]] = field(init=False)

    def __post_init__(self) -> None:
        self.arms = self.plan.by_label()

    def in_recording(self, _: str) -> bool:
        """Return False: a database is no recording."""
        return False

    def get(self, key: str, request: ChatRequest) -> CachedCall | None:
        """Return the call with this key, its replies read anew, or None.

        Raises RecordingError where its request does not have the key, and CallFailed where it
        ended without an answer.
        """
        rows = sorted((r for r in self.rows if r["call_key"] == key), key=itemgetter("attempt"))
        if not rows:
            return None
        try:
            body = canonical_json(json.loads(rows[0]["request"]))
        except DAMAGED as exc:
            raise RecordingError(f"its request cannot be read: {exc}") from exc
        slot = request.slot
        if (body, rows[0]["side"], rows[0]["decision"]) != (request.body, slot.side, slot.decision):
            raise RecordingError("its request and slot do not have the key")
        arm = self.arms[self.spec.arm]
        form = self.plan.parts.formats[arm.entries[arm.full_names[slot.side]].format]
        attempts = tuple(_attempt(n, row, form) for n, row in enumerate(rows, 1))
        if attempts[-1].outcome not in ANSWERS:
            message = attempts[-1].error or attempts[-1].outcome
            raise CallFailed(message, request, attempts, len(attempts))
        return CachedCall(request, attempts)


def _attempt(number: int, row: Mapping[str, Any], form: WireFormat) -> Attempt:
    """Read the reply of a row anew.

    A failed attempt keeps its stored outcome, which depends on headers that are not stored. For the
    same reason the stored ``scripted`` is kept.
    """
    body = row["reply"]
    with suppress(TypeError, ValueError, RecursionError):
        if isinstance(text := json.loads(body), str):
            body = text  # a body that is no JSON is stored as a JSON string
    names = ("outcome", "http_status", "model_served", "finish_reason", "error", "scripted")
    usage = Usage(*(row[count.name] for count in fields(Usage)))
    attempt = Attempt(number, **{name: row[name] for name in names}, usage=usage, reply=body)
    outcome = judge(RawReply(attempt.http_status or 0, {}, body or ""), form)
    if outcome.action != "accept" and attempt.outcome not in ANSWERS:
        return attempt
    reading = outcome.reading
    return replace(
        attempt,
        outcome=outcome.name,
        error=outcome.message,
        model_served=reading.model_served,
        finish_reason=reading.finish_reason,
        usage=reading.usage,
    )


def _findings(
    record: TrialRecord, tables: Mapping[str, Stored], kind: str, sweep_id: str
) -> Iterator[Finding]:
    """Compare a trial as it was played with its stored rows, unless it lacks a reply."""
    key = record.spec.key
    (stored,) = tables["trials"].named(key)
    failed = stored["status"] == "failed"
    if record.failed_calls and not failed:
        text, missing = f"it cannot be replayed: {record.error}", record.failed_calls[0]
        yield Finding(kind, text, sweep_id, key[0], missing.side, missing.number)
        return
    if record.failed_calls and kind == "cache":
        return  # the cache's ``get`` returns answered calls alone: a failed one is not found
    ignored = {"cached"} | ({"error"} if failed else set())  # the reason of a failure, in words
    if kind == "replay":
        ignored |= {name.removeprefix("calls.") for name in NOT_REPLAYED}
    for table, rows in rows_of(record).items():
        stored_rows = tables[table]
        for difference in stored_rows.differences(key, rows, ignored=ignored, tolerance=TOLERANCE):
            place = (difference.place.get(name) for name in ("side", "decision"))
            yield Finding(kind, difference.text, sweep_id, key[0], *place)
