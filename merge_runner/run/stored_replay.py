"""The audit of a database: a sealed replay, whose rows are compared with those that are stored.

The plan comes from the sweep's row, and the replies from the table ``calls`` or from a cache.
"""

from __future__ import annotations

import asyncio
import json
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import duckdb
from pydantic import ValidationError

from merge_runner.audit.checks import audited_database, check_rest, check_sweep
from merge_runner.audit.findings import Audit, Finding
from merge_runner.config import ModelEntry
from merge_runner.drivers.registry import PROGRAMS
from merge_runner.errors import (
    CallFailed,
    MergeRunnerError,
    RecordingError,
    unknown_name,
)
from merge_runner.llm.cache import CachedCall, ResponseCache
from merge_runner.llm.content_hashes import make_request
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.http_outcome import RawReply, judge
from merge_runner.llm.verify import DAMAGED
from merge_runner.prompts.blocks import blocks_of
from merge_runner.records import ANSWERS, SIDES, Attempt, Slot, TrialRecord, TrialSpec, Usage
from merge_runner.registry import in_use, use
from merge_runner.results.comparison import (
    FACTORS,
    LONG,
    PLACES,
    Difference,
    Stored,
    in_order,
    rows_of_trials,
    stored_rows,
)
from merge_runner.results.database import by_name
from merge_runner.results.rows import rows_of
from merge_runner.run.clients import sealed_clients
from merge_runner.run.local_runner import LocalRunner
from merge_runner.run.plan import Plan
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.study.crossing import MOST_TRIALS, Arm
from merge_runner.study.parts import declared_catalogue

TOLERANCE = 1e-9
"""Numbers may differ by this much, as between the arithmetic of two machines."""
SHOWN = 60
# The columns that no replay gives; docs/reference/audit.md says why. A cache has those of
# ``calls``, except ``cached``.
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
OF_THE_PROGRAM = frozenset(
    {"spec_version", "prompt_blocks"}
    | {f"{side}.{name}" for side in SIDES for name in ("source", "data")}
)
HINT = "install the package that registers it, or name the study: --study FILE"
SWEEPS = """
SELECT sweep_id, config::VARCHAR, coalesce(exit_code = 0, false) FROM sweeps
ORDER BY started_at DESC, sweep_id DESC
"""


def audit_database(
    path: Path, sweep_id: str | None = None, cache: Path | None = None
) -> list[Audit]:
    """Audit every sweep, oldest first, and then what belongs to none; or one sweep alone.

    A trial that several sweeps have is audited with the newest of them. With a ``cache``, every
    attempt is compared with its folder, too. Raises UsageError.
    """
    with audited_database(path) as connection:
        rows = connection.execute(SWEEPS).fetchall()
        if sweep_id is not None:
            known = [row for row in rows if row[0] == sweep_id]
            if not known:
                raise unknown_name(
                    "sweep", sweep_id, [row[0] for row in reversed(rows)], f"in {path}"
                )
            rows = known
        kept = Audit(str(cache), {"trials": 0})
        with (
            nullcontext()
            if cache is None
            else closing(ResponseCache(cache, read_only=True)) as replies
        ):
            audits = [
                _audit(connection, name, config, replies, kept, finished=finished)
                for name, config, finished in rows
            ]
        audits.reverse()
        if sweep_id is None:
            audits.append(check_rest(connection, path))
        return [*audits, kept] if cache is not None else audits


def _audit(
    connection: duckdb.DuckDBPyConnection,
    sweep_id: str,
    config: str,
    cache: ResponseCache | None,
    kept: Audit,
    *,
    finished: bool,
) -> Audit:
    """Audit a sweep; what its trials lack in a cache is added to ``kept``."""
    problems: list[Finding] = []
    notes: Counter[str] = Counter()
    planned: dict[str, str] = {}
    specs: list[TrialSpec] = []
    try:
        plan = Plan.model_validate_json(config)
        # The stored plug-ins are somebody's code and never run.
        if not in_use().text:
            use(declared_catalogue(plan.study.file))
        stored, members = json.loads(config), plan.model_dump(mode="json").items()
        if wrong := [name for name, value in members if stored.get(name, value) != value]:
            text = f"it disagrees with itself in {', '.join(wrong)}"
            problems.append(Finding("config", text, sweep_id))
        plan, planned, specs = _installed_part(connection, plan, notes)
    except ValidationError as exc:
        error = exc.errors()[0]
        problems.append(
            _unreadable(f"{'.'.join(map(str, error['loc']))}: {error['msg']}", sweep_id)
        )
    except (*DAMAGED, AttributeError, MergeRunnerError) as exc:
        problems.append(_unreadable(exc, sweep_id))
    audit = check_sweep(connection, sweep_id, list(planned.items()), finished=finished)
    audit.findings += problems
    if specs:
        specs = _replayable(connection, plan, specs, audit, notes)
        audit.counts["replayed"] = len(specs)
        stored_replies = StoredReplies(connection, plan)
        audit.findings += _replay(connection, plan, specs, stored_replies, sweep_id)
        if cache is not None:
            kept.counts["trials"] += len(specs)
            kept.findings += _replay(connection, plan, specs, cache, sweep_id)
    audit.notes += [
        f"not replayed: {count} trials, since {why}" for why, count in notes.items() if count
    ]
    return audit


def _unreadable(why: object, sweep_id: str) -> Finding:
    text = f"its configuration cannot be read, so that its trials are not known: {why}"
    return Finding("config", text, sweep_id)


def _installed_part(
    connection: duckdb.DuckDBPyConnection, plan: Plan, notes: Counter[str]
) -> tuple[Plan, dict[str, str], list[TrialSpec]]:
    """Return the part of a plan whose drivers, prompts and conditions are installed.

    Also all its trials, each with the hash of its spec, or none where that cannot be known, and
    the specs of the part. Raises ValueError for a format that there is not.
    """
    if plan.trials > MOST_TRIALS:
        raise ValueError(f"it has {plan.trials} trials")
    arms = []
    conditions = tuple(name for name in plan.conditions if name in CONDITIONS)
    for arm in plan.arms:
        if why := _lacking(connection, arm):
            notes[why] += arm.repetitions * len(plan.conditions)
        else:
            arms.append(arm)
            lacking = len(plan.conditions) - len(conditions)
            notes["their condition is not installed"] += arm.repetitions * lacking
    planned = {
        plan.trial_id_of(arm, condition, repetition): ""
        for arm in plan.arms
        for condition in plan.conditions
        for repetition in range(1, arm.repetitions + 1)
    }
    part = plan.model_copy(update={"arms": tuple(arms), "conditions": conditions})
    specs = part.trial_specs() if part.trials else []
    return part, planned | {spec.trial_id: spec.spec_hash for spec in specs}, specs


def _lacking(connection: duckdb.DuckDBPyConnection, arm: Arm) -> str:
    """Return what is not installed of an arm, empty: nothing; reads the human trials it replays."""
    for name, entry in arm.entries.items():
        if entry.format not in FORMATS:
            raise ValueError(
                f"its model {name} has the format {entry.format!r}, which there is not"
            )
    try:
        if arm.entries:
            blocks_of(arm.variant)
        for name in {*arm.asked.values()} - {*arm.entries}:
            if (humans := PROGRAMS.require(name, HINT).data) is not None:
                humans.read(connection)
    except MergeRunnerError as exc:
        return str(exc)
    return ""


def _replayable(
    connection: duckdb.DuckDBPyConnection,
    plan: Plan,
    specs: Sequence[TrialSpec],
    audit: Audit,
    notes: Counter[str],
) -> list[TrialSpec]:
    """Return the audited trials whose spec is stored as the plan has it today.

    A spec that differs in what follows from the sweep's configuration is a finding; trials that
    another version of the program made are a note.
    """
    rows = connection.execute("SELECT trial_id, spec_hash FROM audited").fetchall()
    hashes = dict(rows)
    stored = dict(connection.execute("SELECT spec_hash, spec::VARCHAR FROM specs").fetchall())
    wanted = plan.specs()
    others: dict[tuple[str, str], list[str]] = {}
    for spec in specs:
        actual = hashes.get(spec.trial_id, spec.spec_hash)
        if actual != spec.spec_hash:
            others.setdefault((actual, spec.spec_hash), []).append(spec.trial_id)
    for (actual, expected), trials in others.items():
        try:
            old, new = _members(stored.get(actual, "{}")), _members(wanted[expected])
            names = {name for name in old.keys() | new.keys() if old.get(name) != new.get(name)}
        except (ValueError, RecursionError, AttributeError):
            names = {"everything"}
        listed = ", ".join(sorted(names))
        if names <= OF_THE_PROGRAM:
            notes[f"they were made by another version or other data: {listed}"] += len(trials)
        else:
            text = f"its spec is not what the sweep says in {listed}"
            audit.findings.append(Finding("spec", text, audit.subject, trials[0]))
    return [spec for spec in specs if hashes.get(spec.trial_id) == spec.spec_hash]


def _members(text: str) -> dict[str, object]:
    """Return the members of a spec, those of drivers one by one."""
    spec = json.loads(text)
    drivers = {
        f"{side}.{name}": value for side in SIDES for name, value in spec.get(side, {}).items()
    }
    return {name: value for name, value in spec.items() if name not in SIDES} | drivers


def _replay(
    connection: duckdb.DuckDBPyConnection,
    plan: Plan,
    specs: Sequence[TrialSpec],
    replies: StoredReplies | ResponseCache,
    sweep_id: str,
) -> list[Finding]:
    """Play trials by stored replies or those of a cache, and compare their rows."""
    # An event loop may run in the caller's thread, where no other one can.
    with ThreadPoolExecutor(max_workers=1) as thread:
        played = _compared(connection, plan, specs, replies, sweep_id)
        return thread.submit(asyncio.run, played).result()


async def _compared(
    connection: duckdb.DuckDBPyConnection,
    plan: Plan,
    specs: Sequence[TrialSpec],
    replies: StoredReplies | ResponseCache,
    sweep_id: str,
) -> list[Finding]:
    clients = sealed_clients(plan, cast(ResponseCache, replies))  # of which they only ask ``get``
    runner = LocalRunner(plan, clients, in_flight=1)
    findings: list[Finding] = []
    by_key = {(spec.trial_id, spec.spec_hash): spec for spec in specs}
    for keys, spans in in_order(connection, by_key):
        tables = {name: stored_rows(connection, name, keys, spans[name]) for name in PLACES}
        for key in keys:
            if isinstance(replies, StoredReplies):
                replies.load(by_key[key], spans["calls"])
            record = await runner.play_one(by_key[key])
            findings += _findings(record, tables, replies, sweep_id)
    return findings


@dataclass(slots=True)
class StoredReplies:
    """The replies in the table ``calls``, of one trial at a time, as a client finds them."""

    connection: duckdb.DuckDBPyConnection
    plan: Plan
    _spec: TrialSpec | None = None
    _arm: Arm | None = None
    _calls: dict[str, list[dict[str, Any]]] = field(default_factory=dict)

    def load(self, spec: TrialSpec, span: tuple[int, int]) -> None:
        """Read the calls of a trial, which lie within a span of the table's rows."""
        key = (spec.trial_id, spec.spec_hash)
        arm = self.plan.by_label()[spec.arm]
        self._spec, self._arm, self._calls = spec, arm, {}
        rows = by_name(rows_of_trials(self.connection, "*", "calls", [key], span))
        for row in sorted(rows, key=lambda row: row["attempt"]):
            if arm.asked.get(row["side"]) in arm.entries:
                self._calls.setdefault(row["call_key"], []).append(row)

    def get(self, key: str) -> CachedCall | None:
        """Return the call with this key, each answer read anew; None where there is none.

        Raises RecordingError where its request does not have the key, and CallFailed where it
        ended without an answer.
        """
        spec, arm, rows = self._spec, self._arm, self._calls.get(key)
        if not rows or spec is None or arm is None:
            return None
        first = rows[0]
        name = arm.asked[first["side"]]
        entry = arm.entries[name]
        sent = FORMATS[entry.format].request(entry, "")
        slot = Slot(
            spec.condition, spec.repetition, first["side"], first["decision"], spec.sample_set
        )
        try:
            request = make_request(
                provider=entry.provider,
                endpoint=self.plan.endpoints[name],
                model=entry.id,
                path=sent.path,
                headers=sent.headers,
                body=json.loads(first["request"]),
                slot=slot,
            )
        except (TypeError, ValueError, RecursionError) as exc:
            raise RecordingError(f"its request cannot be read: {exc}") from exc
        if request.key != key:
            raise RecordingError("its request and slot do not have the key")
        attempts = tuple(_attempt(n, row, entry) for n, row in enumerate(rows, 1))
        if attempts[-1].outcome not in ANSWERS:
            message = attempts[-1].error or attempts[-1].outcome
            raise CallFailed(message, request, attempts, len(attempts))
        return CachedCall(request, attempts)


def _attempt(number: int, row: Mapping[str, Any], entry: ModelEntry) -> Attempt:
    """Read the reply of a row anew.

    A failed attempt is taken as it is stored: its outcome depends on headers, which are not. The
    mark of a stand-in may have been a header too, so that a stored ``scripted`` is believed.
    """
    raw = RawReply(row["http_status"] or 0, {}, _body(row["reply"]))
    outcome = judge(raw, FORMATS[entry.format])
    told: dict[str, Any] = {
        "number": number,
        "http_status": row["http_status"],
        "reply": None if row["reply"] is None else raw.body,
        "scripted": row["scripted"],
    }
    if outcome.action == "accept" or row["outcome"] in ANSWERS:
        reading = outcome.reading
        return Attempt(
            **told,
            outcome=outcome.name,
            error=outcome.message,
            model_served=reading.model_served,
            finish_reason=reading.finish_reason,
            usage=reading.usage,
        )
    tokens = ("input_tokens", "cached_input_tokens", "output_tokens", "reasoning_tokens")
    same = ("outcome", "error", "model_served", "finish_reason")
    usage = Usage(*(row[name] for name in tokens))
    return Attempt(**told, **{name: row[name] for name in same}, usage=usage)


def _body(reply: str | None) -> str:
    """Return the body as it came: one that is no JSON is stored as a JSON string."""
    with suppress(ValueError, RecursionError):
        if reply is not None and isinstance(body := json.loads(reply), str):
            return body
    return reply or ""


def _findings(
    record: TrialRecord,
    tables: Mapping[str, Stored],
    replies: StoredReplies | ResponseCache,
    sweep_id: str,
) -> Iterator[Finding]:
    """Compare a trial as it was played with its stored rows."""
    key = (record.spec.trial_id, record.spec.spec_hash)
    kind = "replay" if isinstance(replies, StoredReplies) else "cache"
    (stored,) = tables["trials"].named(key)
    failed = stored["status"] == "failed"
    if record.failed_calls and (kind == "cache" or not failed):
        if not failed:
            call = record.failed_calls[0]
            text = f"it cannot be replayed: {record.error}"
            yield Finding(kind, text, sweep_id, key[0], call.side, call.number)
        return
    rows = rows_of(record)
    ignored: Collection[str] = ("cached",)
    if kind == "replay":
        ignored = [name.partition(".")[2] for name in NOT_REPLAYED if name.startswith("calls.")]
    if failed:
        ignored = [*ignored, "error"]  # the reason, in words
    for table, there in tables.items():
        if table == FACTORS:  # another study may have others for the same trial
            mine = {row[2] for row in rows[FACTORS]}
            there.rows[key] = [row for row in there.rows.get(key, []) if row[2] in mine]
        for difference in there.differences(key, rows[table], ignored=ignored, tolerance=TOLERANCE):
            yield _finding(kind, difference, key[0], sweep_id)


def _finding(kind: str, difference: Difference, trial_id: str, sweep_id: str) -> Finding:
    place = difference.place
    at = f" at step {place['step']}" if "step" in place else ""
    more = f", and {difference.rows - 1} more in the trial" if difference.rows > 1 else ""
    if difference.column is None:
        text = f"{difference.name} are missing or too many{at}{more}"
    elif difference.column in LONG.get(difference.table, ()):
        text = f"{difference.name} is not what it is replayed{more}"
    else:
        stored, wanted = _short(difference.stored), _short(difference.wanted)
        text = f"{difference.name}{at} is {stored}, and {wanted} replayed{more}"
    return Finding(kind, text, sweep_id, trial_id, place.get("side"), place.get("decision"))


def _short(value: object) -> str:
    text = "NULL" if value is None else str(value)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."
