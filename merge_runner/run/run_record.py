"""The row of a run in the database: its start, its end, and the check of its trials."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from merge_runner.audit.checks import Audit, audited_database, check_sweep, sweep_facts
from merge_runner.errors import MergeRunnerError, NoValidDecision, StoreError
from merge_runner.paths import DEFAULT_DB, command_at
from merge_runner.records import canonical_json
from merge_runner.results.database import in_thread
from merge_runner.results.provenance import versions
from merge_runner.results.store import Store
from merge_runner.run.guard import FirstDecisions
from merge_runner.run.session import Session

SHOWN = 5  # findings


def begin(session: Session, store: Store, commit: str, *, dirty: bool | None) -> str:
    """Store the row of a run that begins, and return its id; for its commit see ``git_state``."""
    plan, options, cap = session.plan, session.options, session.ledger.cap
    started_at = datetime.now(UTC).replace(tzinfo=None)
    sweep_id = f"{plan.name}-{plan.model}-{started_at:%Y%m%dT%H%M%S%f}"
    config = {
        **plan.model_dump(mode="json"),
        "max_cost_usd": cap.usd if cap else None,
        "typed": options.typed,
    }
    if options.name:
        config["run_name"] = options.name
    row = {
        "sweep_id": sweep_id,
        "name": plan.name,
        "started_at": started_at,
        "config": canonical_json(config),
        "git_commit": commit,
        "git_dirty": dirty,
        "versions": canonical_json(versions()),
    }
    store.begin_sweep(row, plan.specs(), session.stored)
    return sweep_id


def end(session: Session, store: Store, sweep_id: str) -> None:
    """Store the end of a run and its exit code in its row."""
    try:
        store.end_sweep(sweep_id, datetime.now(UTC).replace(tzinfo=None), session.exit_code)
    except StoreError as exc:
        session.fail_by(exc)


async def check(
    session: Session, store: Store, sweep_id: str, first: FirstDecisions
) -> tuple[dict[str, Any], Audit] | None:
    """Read the rows of an ended run back from the database, and audit them."""
    ended_with, checked, options = session.exit_code, None, session.options
    keys = [spec.key for spec in (*session.stored, *session.todo)]

    def read() -> tuple[dict[str, Any], Audit]:
        with audited_database(store.path, sweep_id) as connection:
            facts = sweep_facts(connection, sweep_id)
            return facts, check_sweep(connection, sweep_id, keys, finished=ended_with == 0)

    try:
        if not options.replay:
            session.ledger.read()
        checked = await in_thread(read)
        if not (session.exit_code or options.sends_nothing or options.keep_going):
            for line in first.without_a_valid_one():
                session.fail(NoValidDecision.exit_code, line)
        # Answers from another model are reported elsewhere; only --strict-model stops for them.
        findings = [finding for finding in checked[1].findings if finding.kind != "served"]
        if findings:
            audit_it = command_at("merge-runner audit", "--db", store.path, DEFAULT_DB)
            session.fail(1, f"the audit found {len(findings)} faults: `{audit_it}`")
        session.messages += map(str, findings[:SHOWN])
    except MergeRunnerError as exc:
        session.fail_by(exc)
    if session.exit_code != ended_with:
        end(session, store, sweep_id)
    return checked
