"""Whether a sweep has the trials that its configuration promises, each once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import duckdb

from merge_runner.audit.expected import Spec, SweepConfig
from merge_runner.audit.findings import Audit, Finding
from merge_runner.llm.content_hashes import spec_hash
from merge_runner.records import SIDES
from merge_runner.results.database import by_name

TRIALS = """
SELECT trial_id, spec_hash, links, status, error, variant, condition, rep, sample_set, model_left,
    model_right, source
FROM (SELECT trial_id, spec_hash, count(*) AS links FROM sweep_trials WHERE sweep_id = ?
    GROUP BY ALL)
LEFT JOIN trials USING (trial_id, spec_hash)
ORDER BY trial_id, spec_hash
"""
NAMED = "SELECT name, started_at FROM sweeps WHERE sweep_id = ?"
ENDED = """
SELECT DISTINCT trial_id FROM trials SEMI JOIN sweep_trials USING (trial_id, spec_hash)
JOIN (SELECT unnest(?) AS trial_id) USING (trial_id)
JOIN (SELECT unnest(?) AS spec_hash) USING (spec_hash)
WHERE status <> 'failed'
"""


def check_slots(
    connection: duckdb.DuckDBPyConnection,
    config: SweepConfig,
    specs: Mapping[str, Spec],
    audit: Audit,
    *,
    finished: bool,
) -> None:
    """Compare the trials of a sweep, the audit's subject, with its configuration.

    Of a sweep that does not claim to be ``finished`` what is missing or failed is a note.
    """
    found, sweep_id = audit.findings, audit.subject
    for name, started_at in connection.execute(NAMED, [sweep_id]).fetchall():
        if sweep_id != f"{name}-{config.model}-{started_at:%Y%m%dT%H%M%S%f}":
            text = "its id is not made of its name, its drivers and when it started"
            found.append(Finding("config", text))
    rows = list(by_name(connection.execute(TRIALS, [sweep_id])))
    seen: dict[str, str] = {}
    for row in rows:
        first = seen.setdefault(row["trial_id"], row["spec_hash"])
        for text in _problems(row, config, first):
            found.append(Finding("slot", text, trial=row["trial_id"]))
    # A spec that many trials share is told once, at the first of them.
    for row in {row["spec_hash"]: row for row in reversed(rows)}.values():
        for text in _spec_problems(row, config, specs):
            found.append(Finding("spec", text, trial=row["trial_id"]))
    missing = _missing(connection, config, specs, seen, audit)
    failed = [row for row in rows if row["status"] == "failed"]
    audit.counts |= {
        "trials": len(config.trials),
        "stored": sum(row["status"] is not None for row in rows),
        "missing": len(missing),
        "failed": len(failed),
    }
    if finished:
        found += [Finding("missing", "it was not played", trial=name) for name in missing]
        found += [
            Finding("failed", row["error"] or "it failed", trial=row["trial_id"]) for row in failed
        ]
    elif missing or failed:
        audit.notes.append(
            f"unfinished: {len(missing)} of {len(config.trials)} trials are missing, "
            f"{len(failed)} failed; the same command again plays them"
        )


def _problems(row: dict[str, Any], config: SweepConfig, first_spec: str) -> Iterator[str]:
    if row["links"] > 1:
        yield f"it is {row['links']} times in the sweep"
    if row["spec_hash"] != first_spec:
        yield f"it is in the sweep with the specs {first_spec} and {row['spec_hash']}"
    wanted = config.trials.get(row["trial_id"])
    if wanted is None:
        yield "the sweep's configuration has no such trial"
    elif row["status"] is None:
        yield "it is in the sweep and not among the trials"
    elif differing := [name for name, value in wanted.items() if row[name] != value]:
        yield "its row is another in " + ", ".join(differing)


def _spec_problems(
    row: dict[str, Any], config: SweepConfig, specs: Mapping[str, Spec]
) -> Iterator[str]:
    name = row["spec_hash"]
    spec = specs.get(name)
    if spec is None:
        yield f"the spec {name} is not stored"
        return
    if spec_hash(spec.text) != name:
        yield f"the spec stored as {name} has the hash {spec_hash(spec.text)}"
    if spec.scenario is None:
        yield f"the scenario of the spec {name} cannot be read: its trials are not checked"
    elif None in map(spec.pace, SIDES):
        yield f"the rates of the spec {name} cannot be read: its decisions are not checked"
    arm = config.arm_of.get(row["trial_id"])
    differing = list(spec.disagreements(config, arm)) if arm else []
    if differing:
        yield f"the spec {name} is not what the sweep says in {', '.join(differing)}"


def _missing(
    connection: duckdb.DuckDBPyConnection,
    config: SweepConfig,
    specs: Mapping[str, Spec],
    seen: Mapping[str, str],
    audit: Audit,
) -> list[str]:
    """The trials that no sweep has played: another one may have gone on where this one stopped."""
    missing = [name for name in config.trials if name not in seen]
    if not missing:
        return missing
    hashes = sorted(
        name
        for name, spec in specs.items()
        if any(not any(spec.disagreements(config, arm)) for arm in config.arms)
    )
    ended = {name for (name,) in connection.execute(ENDED, [missing, hashes]).fetchall()}
    if ended:
        audit.notes.append(f"{len(ended)} of its trials were played by another sweep")
    return [name for name in missing if name not in ended]
