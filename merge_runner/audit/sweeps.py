"""Audits of a database: of one sweep, or of everything that it holds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import duckdb
from pydantic import ValidationError

from merge_runner.audit.checks import run_checks
from merge_runner.audit.derived import check_derived
from merge_runner.audit.expected import Spec, SweepConfig
from merge_runner.audit.findings import Audit, Finding, Sharing
from merge_runner.audit.ids import find_ids, meaningless_ids
from merge_runner.audit.replies import (
    USED,
    answers_alike,
    calls_in_common,
    check_hashes,
    shared_calls,
    shared_replies,
)
from merge_runner.audit.slots import check_slots
from merge_runner.audit.traces import GAPS, check_traces, reach_m
from merge_runner.drivers.registry import PROGRAMS
from merge_runner.errors import StoreError, UsageError, unknown_name
from merge_runner.llm.content_hashes import canonical_json
from merge_runner.records import SIDES
from merge_runner.registry import in_use, use
from merge_runner.results.database import append, by_name, read_database
from merge_runner.results.validity import ASKED_DECISIONS, not_judged
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.served_model import other_models
from merge_runner.study.parts import declared_catalogue
from merge_runner.text_safety import first_line

TABLES = """
CREATE OR REPLACE TEMP TABLE rules (spec_hash VARCHAR, timeout_steps INTEGER, restarts BOOLEAN,
    reach_m DOUBLE, tunnel_exit_m DOUBLE, merge_point_m DOUBLE, end_m DOUBLE, branch_sine DOUBLE,
    branch_cosine DOUBLE);
CREATE OR REPLACE TEMP TABLE paces (spec_hash VARCHAR, side VARCHAR, interval_steps INTEGER,
    executed INTEGER, plan_actions INTEGER);
CREATE OR REPLACE TEMP TABLE drivers (spec_hash VARCHAR, side VARCHAR, endpoint VARCHAR,
    body VARCHAR, between_body_and_slot VARCHAR);
CREATE OR REPLACE TEMP TABLE done AS SELECT trial_id, spec_hash FROM trials LIMIT 0;
CREATE OR REPLACE TEMP TABLE sweep_models (name VARCHAR, id VARCHAR, provider VARCHAR);
CREATE OR REPLACE TEMP TABLE other_models (model_requested VARCHAR, model_served VARCHAR);
"""
AUDITED = """
CREATE OR REPLACE TEMP TABLE audited AS
SELECT trial_id, spec_hash, model_left, model_right, condition, rep, sample_set, status,
    merged_first, end_time_s, error, scripted
FROM trials SEMI JOIN (SELECT trial_id, spec_hash FROM sweep_trials WHERE sweep_id = ?)
USING (trial_id, spec_hash) ANTI JOIN done USING (trial_id, spec_hash)
"""
COUNTS = """
SELECT * FROM
    (SELECT count(*) AS decisions, count(*) FILTER (NOT valid) AS invalid
    FROM decisions SEMI JOIN audited USING (trial_id, spec_hash)),
    (SELECT count(DISTINCT call_key) AS calls, count(*) AS attempts,
        count(*) FILTER (scripted) AS "attempts answered by a scripted stand-in"
    FROM calls SEMI JOIN audited USING (trial_id, spec_hash)),
    (SELECT count(DISTINCT reply_id) AS "reply ids"
    FROM reply_ids SEMI JOIN audited USING (trial_id, spec_hash))
"""
# The trials that a sweep did not play, since earlier ones had.
TAKEN_OVER = """
SELECT b.sweep_id, count(*)
FROM (SELECT DISTINCT trial_id, spec_hash FROM sweep_trials WHERE sweep_id = ?)
JOIN (SELECT DISTINCT * FROM sweep_trials) AS b USING (trial_id, spec_hash)
JOIN sweeps ON sweeps.sweep_id = b.sweep_id
    AND started_at < (SELECT started_at FROM sweeps WHERE sweep_id = ?)
GROUP BY ALL ORDER BY ALL
"""
# Rows that belong to nothing: the table, the trial, and how many they are.
LOOSE = """
SELECT 'trials', trial_id, count(*) FROM trials
ANTI JOIN sweep_trials USING (trial_id, spec_hash) WHERE source <> 'human' GROUP BY ALL
UNION ALL SELECT 'states', trial_id, count(*) FROM states
ANTI JOIN trials USING (trial_id, spec_hash) GROUP BY ALL
UNION ALL SELECT 'trial_factors', trial_id, count(*) FROM trial_factors
ANTI JOIN trials USING (trial_id, spec_hash) GROUP BY ALL
UNION ALL SELECT 'decisions', trial_id, count(*) FROM decisions
ANTI JOIN trials USING (trial_id, spec_hash) GROUP BY ALL
UNION ALL SELECT 'calls', trial_id, count(*) FROM calls
ANTI JOIN trials USING (trial_id, spec_hash) GROUP BY ALL
UNION ALL SELECT 'sweep_trials', trial_id, count(*) FROM sweep_trials
ANTI JOIN sweeps USING (sweep_id) GROUP BY ALL
ORDER BY ALL
"""
# Of each driver, prompt and model that was asked how many decisions are invalid.
DECIDED = f"""
SELECT driver || '/' || variant, model, sum(invalid)::BIGINT, sum(asked)::BIGINT
FROM ({ASKED_DECISIONS}) JOIN (SELECT trial_id, spec_hash, variant FROM trials)
    USING (trial_id, spec_hash)
JOIN trial_drivers USING (trial_id, spec_hash) SEMI JOIN audited USING (trial_id, spec_hash)
GROUP BY driver, variant, model, spec_hash ORDER BY ALL
"""  # noqa: S608 # constants
LOOSE_TEXTS = {
    "trials": "no sweep has this trial",
    "sweep_trials": "it is a trial of a sweep that is not stored",
}


def audit_sweep(
    path: Path, sweep_id: str, *, finished: bool | None = None, derive: bool = True
) -> Audit:
    """Audit one sweep of a database.

    ``finished`` says whether the sweep claims to have played everything, so that a missing or
    failed trial is a finding; without it a sweep that has ended claims so. ``derive`` says whether
    its trials are driven anew, which takes the longest by far. Raises UsageError.
    """
    with _reading(path) as connection:
        known = _sweeps(connection)
        if sweep_id not in known:
            raise unknown_name("sweep", sweep_id, known, f"in {path}")
        specs = _prepare(connection)
        config, ended = known[sweep_id]
        claims = ended if finished is None else finished
        audit = _audit(connection, sweep_id, config, specs, finished=claims, derive=derive)
        audit.sharings += calls_in_common(connection)
        return audit


def audit_database(path: Path) -> list[Audit]:
    """Audit every sweep, oldest first, and then what belongs to none.

    A trial that several sweeps have is audited with the newest of them. Raises UsageError.
    """
    with _reading(path) as connection:
        specs = _prepare(connection)
        audits = []
        for sweep_id, (config, ended) in reversed(_sweeps(connection).items()):
            audits.append(_audit(connection, sweep_id, config, specs, finished=ended))
            connection.execute("INSERT INTO done SELECT trial_id, spec_hash FROM audited")
        connection.execute("CREATE OR REPLACE TEMP TABLE audited AS FROM trials")
        return [*reversed(audits), _whole(connection, path, bool(audits))]


@contextmanager
def _reading(path: Path) -> Iterator[duckdb.DuckDBPyConnection]:
    try:
        with read_database(path) as connection:
            yield connection
    except duckdb.Error as exc:
        raise StoreError(f"{path} cannot be audited: {first_line(exc)}") from exc


def _audit(
    connection: duckdb.DuckDBPyConnection,
    sweep_id: str,
    config_text: str,
    specs: Mapping[str, Spec],
    *,
    finished: bool,
    derive: bool = True,
) -> Audit:
    connection.execute(AUDITED, [sweep_id])
    audit = Audit(sweep_id)
    config = _config(config_text, audit)
    if config is not None:
        check_slots(connection, config, specs, audit, finished=finished)
    connection.execute("DELETE FROM sweep_models")
    append(connection, "sweep_models", sorted(_models(config)) if config else [])
    audit.counts |= _counts(connection, COUNTS)
    audit.findings += run_checks(connection)
    audit.findings += check_traces(connection, specs)
    audit.findings += check_hashes(connection)
    audit.findings += shared_calls(connection)
    audit.findings += shared_replies(connection)
    audit.sharings += _taken_over(connection, sweep_id)
    audit.notes += _checked_elsewhere(connection, sweep_id)
    audit.notes += meaningless_ids(connection)
    audit.notes += _alike_notes(connection)
    audit.notes += _not_judged(connection)
    if derive and config is not None:
        if any("data" in spec.driver(side) for spec in specs.values() for side in SIDES):
            for program in PROGRAMS.values():
                if program.data is not None:
                    program.data.read(connection)
        _use_stored(config)
        check_derived(connection, specs, config, audit)
    audit.findings = [replace(finding, sweep=sweep_id) for finding in audit.findings]
    return audit


def _use_stored(config: SweepConfig) -> None:
    """Use the prompts and conditions of a sweep's study, unless a user named a study.

    The stored plug-ins are somebody's code and never run; trials that need them are not derived,
    and neither are those of a study that cannot be read here.
    """
    if config.study is not None and not in_use().text:
        with suppress(UsageError):
            use(declared_catalogue(config.study.text))


def _models(config: SweepConfig) -> set[tuple[str, str, str]]:
    """The models by their names in the registry, each with its id and provider."""
    return {
        (arm.sides[side], model.id, model.provider)
        for arm in config.arms
        for side in SIDES
        if (model := config.models.get(arm.asked[side])) is not None
    }


def _config(text: str, audit: Audit) -> SweepConfig | None:
    """The configuration of a sweep; one that cannot be read is a finding."""
    try:
        return SweepConfig.model_validate_json(text)
    except ValidationError as exc:
        error = exc.errors()[0]
        first = f"{'.'.join(map(str, error['loc']))}: {error['msg']}"
        told = f"its configuration cannot be read, so that its trials are not known: {first}"
        audit.findings.append(Finding("config", told))
        return None


def _whole(connection: duckdb.DuckDBPyConnection, path: Path, sweeps: bool) -> Audit:
    """What a database holds beside and between its sweeps."""
    loose = connection.execute(LOOSE).fetchall()
    counts = """
        SELECT * FROM (SELECT count(*) AS sweeps FROM sweeps),
            (SELECT count(*) AS trials, count(*) FILTER (source = 'human') AS "human trials"
            FROM trials)
    """
    return Audit(
        subject=str(path),
        counts=_counts(connection, counts),
        findings=[
            Finding(
                "loose",
                LOOSE_TEXTS.get(table, f"{rows} rows of {table} belong to no trial"),
                trial=trial_id,
            )
            for table, trial_id, rows in loose
        ],
        sharings=list(calls_in_common(connection)),
        notes=[] if sweeps else ["there is no sweep in this database"],
    )


def _sweeps(connection: duckdb.DuckDBPyConnection) -> dict[str, tuple[str, bool]]:
    """The sweeps, oldest first: the configuration of each, and whether it ended."""
    rows = connection.execute(
        "SELECT sweep_id, config, coalesce(exit_code = 0, false) FROM sweeps "
        "ORDER BY started_at, sweep_id"
    ).fetchall()
    return {sweep_id: (config, ended) for sweep_id, config, ended in rows}


def _prepare(connection: duckdb.DuckDBPyConnection) -> dict[str, Spec]:
    """Make the temporary tables that the checks read; returns the stored specs."""
    specs = {
        name: Spec(name, text)
        for name, text in connection.execute("SELECT spec_hash, spec FROM specs").fetchall()
    }
    connection.execute(TABLES)
    append(
        connection,
        "rules",
        (
            (
                spec.spec_hash,
                scenario.timeout_steps,
                scenario.fallback == "restart",
                reach_m(scenario),
                TRACK.tunnel_exit_m,
                TRACK.merge_point_m,
                TRACK.end_m,
                TRACK.branch_sine,
                TRACK.branch_cosine,
            )
            for spec in specs.values()
            if (scenario := spec.scenario) is not None
        ),
    )
    append(
        connection,
        "paces",
        (
            (spec.spec_hash, side, pace.interval_steps, pace.executed_actions, pace.plan_actions)
            for spec in specs.values()
            for side in SIDES
            if (pace := spec.pace(side)) is not None
        ),
    )
    append(
        connection,
        "drivers",
        (
            (
                spec.spec_hash,
                side,
                spec.driver(side).get("endpoint"),
                canonical_json(spec.driver(side).get("body")) if spec.asks(side) else None,
                spec.between_body_and_slot(side),
            )
            for spec in specs.values()
            for side in SIDES
        ),
    )
    append(connection, "other_models", other_models(connection))
    find_ids(connection)
    connection.execute(USED)
    connection.execute(GAPS)
    return specs


def _taken_over(connection: duckdb.DuckDBPyConnection, sweep_id: str) -> Iterable[Sharing]:
    for other, count in connection.execute(TAKEN_OVER, [sweep_id, sweep_id]).fetchall():
        yield Sharing("trials", sweep_id, other, count)


def _checked_elsewhere(connection: duckdb.DuckDBPyConnection, sweep_id: str) -> Iterable[str]:
    """A note that later sweeps have its trials too, with which they are counted and checked."""
    (count,) = connection.execute(
        "SELECT count(*) FROM sweep_trials SEMI JOIN done USING (trial_id, spec_hash) "
        "WHERE sweep_id = ?",
        [sweep_id],
    ).fetchall()[0]
    if count:
        yield f"{count} of its trials are checked with a later sweep that has them too"


def _alike_notes(connection: duckdb.DuckDBPyConnection) -> Iterable[str]:
    """A note on answers that may be no samples; the emulator's are not: it has a few phrases."""
    scripted = _counts(connection, "SELECT count(*) AS trials FROM audited WHERE scripted")
    if (repeated := answers_alike(connection)) and not scripted["trials"]:
        yield (
            f"all {repeated} answers to prompts that were asked before are word for word as "
            "before: are they samples?"
        )


def _not_judged(connection: duckdb.DuckDBPyConnection) -> Iterable[str]:
    """Notes on drivers and prompts from whose trials nothing is concluded."""
    for group, model, invalid, asked in connection.execute(DECIDED).fetchall():
        if why := not_judged(model, invalid, asked):
            yield f"{group}: {why}"


def _counts(connection: duckdb.DuckDBPyConnection, sql: str) -> dict[str, int]:
    """A query's only row, numbers by name."""
    return next(by_name(connection.execute(sql)))
