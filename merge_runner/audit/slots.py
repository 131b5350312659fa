"""Whether a sweep has the trials that its configuration promises, each once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial

import duckdb

from merge_runner.audit.expected import Cell, Spec, SweepConfig
from merge_runner.audit.findings import Finding
from merge_runner.llm.content_hashes import spec_hash
from merge_runner.records import SIDES

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


@dataclass(frozen=True, slots=True)
class Row:
    """A trial of a sweep as it is stored; ``status`` and what follows is None without a row."""

    trial_id: str
    spec_hash: str
    links: int
    status: str | None
    error: str | None
    variant: str | None
    condition: str | None
    repetition: int | None
    sample_set: int | None
    model_left: str | None
    model_right: str | None
    source: str | None


@dataclass(slots=True)
class Slots:
    """What was found of a sweep's trials."""

    findings: list[Finding] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def check_slots(
    connection: duckdb.DuckDBPyConnection,
    sweep_id: str,
    config: SweepConfig,
    specs: Mapping[str, Spec],
    *,
    finished: bool,
) -> Slots:
    """Compare the trials of a sweep with its configuration.

    Of a sweep that does not claim to be ``finished`` what is missing or failed is a note.
    """
    found = Slots()
    for name, started_at in connection.execute(NAMED, [sweep_id]).fetchall():
        if sweep_id != f"{name}-{config.model}-{started_at:%Y%m%dT%H%M%S%f}":
            text = "its id is not made of its name, its drivers and when it started"
            found.findings.append(Finding("config", text, sweep=sweep_id))
    rows = [Row(*values) for values in connection.execute(TRIALS, [sweep_id]).fetchall()]
    finding = partial(Finding, sweep=sweep_id)
    seen: dict[str, str] = {}
    for row in rows:
        here = partial(finding, trial=row.trial_id)
        first = seen.setdefault(row.trial_id, row.spec_hash)
        problems = _problems(row, config, None if first == row.spec_hash else first)
        found.findings += [here("slot", text) for text in problems]
    found.findings += [
        finding(kind="spec", text=text, trial=row.trial_id)
        for row in {row.spec_hash: row for row in reversed(rows)}.values()
        for text in _spec_problems(row, config, specs)
    ]
    missing = _missing(connection, config, specs, seen, found)
    failed = [row for row in rows if row.status == "failed"]
    found.counts = {
        "trials": len(config.trials),
        "stored": sum(row.status is not None for row in rows),
        "missing": len(missing),
        "failed": len(failed),
    }
    if not finished and (missing or failed):
        found.notes.append(
            f"unfinished: {len(missing)} of {len(config.trials)} trials are missing, "
            f"{len(failed)} failed; the same command again plays them"
        )
        return found
    found.findings += [finding("missing", "it was not played", trial=name) for name in missing]
    found.findings += [
        finding("failed", row.error or "it failed", trial=row.trial_id) for row in failed
    ]
    return found


def _problems(row: Row, config: SweepConfig, other_spec: str | None) -> Iterator[str]:
    if row.links > 1:
        yield f"it is {row.links} times in the sweep"
    if other_spec is not None:
        yield f"it is in the sweep with the specs {other_spec} and {row.spec_hash}"
    cell = config.trials.get(row.trial_id)
    if cell is None:
        yield "the sweep's configuration has no such trial"
    elif row.status is None:
        yield "it is in the sweep and not among the trials"
    else:
        wanted = _told(config, cell)
        differing = [name for name, value in wanted.items() if getattr(row, name) != value]
        if differing:
            yield "its row is another in " + ", ".join(differing)


def _told(config: SweepConfig, cell: Cell) -> dict[str, object]:
    """What the row of a cell's trial says."""
    return {
        "variant": cell.variant,
        "condition": cell.condition,
        "repetition": cell.repetition,
        "sample_set": config.sample_set,
        "model_left": config.sides["left"],
        "model_right": config.sides["right"],
        "source": "llm" if config.models else "driver",
    }


def _spec_problems(row: Row, config: SweepConfig, specs: Mapping[str, Spec]) -> Iterator[str]:
    spec = specs.get(row.spec_hash)
    if spec is None:
        yield f"the spec {row.spec_hash} is not stored"
        return
    if spec_hash(spec.text) != row.spec_hash:
        yield f"the spec stored as {row.spec_hash} has the hash {spec_hash(spec.text)}"
    if spec.scenario is None or spec.track is None:
        yield f"the scenario of the spec {row.spec_hash} cannot be read: its trials are not checked"
    elif None in map(spec.pace, SIDES):
        yield f"the rates of the spec {row.spec_hash} cannot be read: its decisions are not checked"
    cell = config.trials.get(row.trial_id)
    differing = list(spec.disagreements(config, cell.variant)) if cell else []
    if differing:
        yield f"the spec {row.spec_hash} is not what the sweep says in {', '.join(differing)}"


def _missing(
    connection: duckdb.DuckDBPyConnection,
    config: SweepConfig,
    specs: Mapping[str, Spec],
    seen: Mapping[str, str],
    found: Slots,
) -> list[str]:
    """The trials that no sweep has played: what stops is gone on with by another one."""
    missing = [name for name in config.trials if name not in seen]
    if not missing:
        return missing
    same = {
        variant: {
            name for name, spec in specs.items() if not any(spec.disagreements(config, variant))
        }
        for variant in config.repetitions
    }
    hashes = sorted(set().union(*same.values()))
    ended = {name for (name,) in connection.execute(ENDED, [missing, hashes]).fetchall()}
    if ended:
        found.notes.append(f"{len(ended)} of its trials were played by another sweep")
    return [name for name in missing if name not in ended]
