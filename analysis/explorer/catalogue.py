"""The list of all trials, held in memory and kept up to date with the database."""

from __future__ import annotations

import io
import json
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import duckdb
from pydantic import ValidationError

from merge_runner.config import ScenarioConfig
from merge_runner.errors import MergeRunnerError, StoreLocked
from merge_runner.records import SIDES
from merge_runner.results.database import Instance, schema_sql
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.served_model import ALIASES, others_among
from merge_runner.text_safety import csv_writer
from merge_runner_analysis.accounts.classes import ALONE, OTHER_ACCOUNTS, collision_class
from merge_runner_analysis.accounts.course import Course
from merge_runner_analysis.data.driver_words import language_models, stand_in, unresponsive
from merge_runner_analysis.explorer.details import scenario_of
from merge_runner_analysis.explorer.display_text import csv_cell
from merge_runner_analysis.explorer.reading import PATIENCE_S, Row, reading, records, stamp_of

PAGE = 100
# Equal where the same trials are listed; unlike a stamp it does not change when a table is kept.
State = tuple[int, int]
# Trials of a variant and of its driver's baseline in equal conditions and repetitions; ``fate`` is
# what is compared.
PAIRS = """
SELECT one.condition, one.rep, one.trial_id, one.spec_hash, one.outcome, one.{fate} AS fate,
    base.trial_id AS base_id, base.spec_hash AS base_hash, base.outcome AS base_outcome,
    base.{fate} AS base_fate
FROM listed AS one JOIN listed AS base USING (model, model_left, condition, rep)
WHERE one.model = ? AND one.variant = ? AND base.variant = 'baseline' AND one.source <> 'human'
    AND one.{fate} IS NOT NULL AND base.{fate} IS NOT NULL
ORDER BY one.trial_id, one.spec_hash, base.spec_hash
"""
# ``tried`` are a trial's attempts, counted where they are alike.
BEGUN = """
CREATE SEQUENCE numbers;
{staged}
CREATE TABLE listed AS {listing};
CREATE TABLE levels (number INTEGER, factor VARCHAR, level VARCHAR);
CREATE VIEW tried AS SELECT number, unnest(tried, recursive := true) FROM listed;
CREATE TABLE noted (trial_id VARCHAR, spec_hash VARCHAR, tag VARCHAR);
CREATE VIEW tagged AS SELECT number, tag FROM noted JOIN listed USING (trial_id, spec_hash);
CREATE TABLE planned (sweep VARCHAR, trial_id VARCHAR, spec_hash VARCHAR);
CREATE TABLE others (requested VARCHAR, served VARCHAR);
"""
# The trials of each sweep, and how often what went wrong in a trial. Equal failures are counted
# together: an error is named by its words before the particulars, without numbers and hashes.
GROUPED = """
CREATE OR REPLACE TABLE members AS
    SELECT sweep, number FROM planned JOIN listed USING (trial_id, spec_hash);
CREATE OR REPLACE TABLE causes AS
SELECT number, 'trial: ' || left(regexp_replace(regexp_replace(split_part(
        regexp_replace(coalesce(error, 'no reason is known'), '^(left|right): ', ''), ' (', 1),
        '[0-9a-f]{16,}', '…', 'g'), '(^| )[0-9]+', '\\1…', 'g'), 70) AS cause, 1 AS times
FROM listed WHERE status = 'failed'
UNION ALL SELECT number, 'plan: ' || flaw, count(*)
FROM (SELECT number, unnest(flaws) AS flaw FROM listed) GROUP BY ALL
UNION ALL SELECT number, 'attempt: ' || outcome, sum(times)::BIGINT
FROM tried WHERE outcome <> 'ok' GROUP BY ALL
UNION ALL SELECT number, 'model: ' || requested || ' → ' || served, sum(times)::BIGINT
FROM tried SEMI JOIN others USING (requested, served) WHERE answered GROUP BY ALL;
"""
# A failed trial may be played anew, and fail again; a file may be put in the place of another.
FORGET = """
DELETE FROM memory.listed WHERE status = 'failed' OR (trial_id, spec_hash, status, end_time_s)
    NOT IN (SELECT (trial_id, spec_hash, status, end_time_s) FROM trials);
DELETE FROM memory.levels WHERE number NOT IN (SELECT number FROM memory.listed);
DELETE FROM memory.planned;
INSERT INTO memory.planned SELECT DISTINCT * FROM sweep_trials;
DELETE FROM memory.sweeps;
INSERT INTO memory.sweeps BY NAME FROM sweeps WHERE coalesce(config->>'$.seat', '') = '';
"""
# The next 2,000: the file is not held for longer than that takes. What was only asked is no trial
# to look at.
TAKE = """
INSERT INTO memory.trials BY NAME
    FROM trials ANTI JOIN memory.listed USING (trial_id, spec_hash) WHERE source <> 'seat'
    ORDER BY trial_id, spec_hash LIMIT 2000;
INSERT OR IGNORE INTO memory.specs
    FROM specs SEMI JOIN memory.trials USING (spec_hash);
INSERT INTO memory.trial_factors FROM trial_factors SEMI JOIN memory.trials
    USING (trial_id, spec_hash);
INSERT INTO memory.states BY NAME
    FROM states SEMI JOIN memory.trials USING (trial_id, spec_hash);
"""
# Of their decisions and calls what is listed. Texts and prompts stay in the database.
STAGED = """
CREATE OR REPLACE TABLE memory.decided AS
    SELECT trial_id, spec_hash, count(*) AS decisions, count(call_key) AS asked,
        count(*) FILTER (NOT valid) AS invalid, count(*) FILTER (fallback) AS fallbacks,
        list(failure) FILTER (failure IS NOT NULL) AS flaws
    FROM decisions SEMI JOIN memory.trials USING (trial_id, spec_hash) GROUP BY ALL;
CREATE OR REPLACE TABLE memory.driven AS
    SELECT trial_id, spec_hash, list({side: side, time_s: time_s, fallback: fallback}
        ORDER BY decision) AS made
    FROM decisions SEMI JOIN (FROM memory.decided WHERE fallbacks > 0) USING (trial_id, spec_hash)
        SEMI JOIN (FROM memory.trials WHERE status = 'collided') USING (trial_id, spec_hash)
    GROUP BY ALL;
CREATE OR REPLACE TABLE memory.called AS
    SELECT trial_id, spec_hash, sum(times)::BIGINT AS attempts, sum(cost_usd) AS cost_usd,
        list(DISTINCT side ORDER BY side) FILTER (scripted) AS posed,
        list({requested: requested, served: served, answered: answered, outcome: outcome,
            unpriced: unpriced, times: times}) AS tried
    FROM (
        SELECT trial_id, spec_hash, side, scripted, model_requested AS requested,
            model_served AS served, http_status = 200 AS answered, outcome,
            count(*) FILTER (cost_usd IS NULL) AS unpriced, count(*) AS times,
            sum(cost_usd) AS cost_usd
        FROM calls SEMI JOIN memory.trials USING (trial_id, spec_hash) GROUP BY ALL
    ) GROUP BY ALL;
"""
# A trial as it is listed. A fallback follows every invalid reply, and nothing else: see the audit.
# ``levels`` are those of its study's own factors, ``flaws`` says of each invalid reply what is
# wrong with it, and ``posed`` on which sides a stand-in answered. A sparkline has about 24 points;
# its words give the slowest and the fastest of all samples.
LISTING = f"""
SELECT nextval('numbers')::INTEGER AS number, trials.trial_id, trials.spec_hash, source,
    CASE WHEN source = 'human' THEN 'humans' WHEN scripted THEN 'stand-ins' ELSE 'drivers' END
        AS who,
    model_left, model_right,
    if(source = 'human', 'human', driver) AS model,
    variant, condition, projected_headway_m, relative_velocity_mps, rep, pair, status,
    merged_first, end_time_s, error, scripted,
    NULL::VARCHAR AS stand_in, NULL::VARCHAR AS caution,
    if(status = 'finished', coalesce(merged_first || ' first', 'nobody first'), status) AS outcome,
    CASE WHEN source = 'human' THEN 'human' WHEN decisions IS NULL THEN 'no decision'
        WHEN fallbacks > 0 OR invalid > 0 THEN 'fallbacks'
        ELSE 'all valid' END AS validity,
    time_to_merge_s, gap_m, rmse_mps, joint, min_ttc_s, {OTHER_ACCOUNTS} AS account,
    coalesce(decisions, 0) AS decisions, coalesce(asked, 0) AS asked,
    coalesce(invalid, 0) AS invalid, coalesce(fallbacks, 0) AS fallbacks,
    coalesce(attempts, 0) AS attempts, cost_usd, left_mps, right_mps, left_range_mps,
    right_range_mps, flaws, posed, tried, levels
FROM trials
JOIN trial_metrics USING (trial_id, spec_hash)
JOIN trial_drivers USING (trial_id, spec_hash)
LEFT JOIN decided USING (trial_id, spec_hash)
LEFT JOIN called USING (trial_id, spec_hash)
LEFT JOIN ({ALONE}) USING (trial_id, spec_hash)
LEFT JOIN (
    SELECT trial_id, spec_hash, list(factor || '=' || value ORDER BY factor) AS levels
    FROM trial_factors WHERE factor <> 'prompt' GROUP BY ALL
) USING (trial_id, spec_hash)
LEFT JOIN (
    SELECT trial_id, spec_hash,
        list(velocity_mps::FLOAT ORDER BY step) FILTER (side = 'left' AND drawn) AS left_mps,
        list(velocity_mps::FLOAT ORDER BY step) FILTER (side = 'right' AND drawn) AS right_mps,
        [min(velocity_mps) FILTER (side = 'left'), max(velocity_mps) FILTER (side = 'left')]
            AS left_range_mps,
        [min(velocity_mps) FILTER (side = 'right'), max(velocity_mps) FILTER (side = 'right')]
            AS right_range_mps
    FROM (SELECT *, (step - first) % every = 0 AS drawn
        FROM states JOIN (SELECT trial_id, spec_hash, min(step) AS first,
                1 + (max(step) - min(step)) // 24 AS every FROM states GROUP BY ALL)
            USING (trial_id, spec_hash))
    WHERE time_s >= 0 GROUP BY ALL
) USING (trial_id, spec_hash)
"""  # noqa: S608 # constants
LIST = f"""
INSERT INTO listed BY NAME {LISTING};
INSERT INTO levels SELECT number, factor, value FROM trial_levels
    JOIN listed USING (trial_id, spec_hash) WHERE factor <> 'prompt';
"""  # noqa: S608 # constants
# Of the trials that were listed last, the collisions; those without a fallback need no decisions.
CRASHES = """
SELECT number, listed.source, spec::VARCHAR AS spec, made,
    list(time_s ORDER BY step) FILTER (side = 'left') AS times_s,
    list(position_m ORDER BY step) FILTER (side = 'left') AS left_m,
    list(position_m ORDER BY step) FILTER (side = 'right') AS right_m,
    list(velocity_mps ORDER BY step) FILTER (side = 'left') AS left_mps,
    list(velocity_mps ORDER BY step) FILTER (side = 'right') AS right_mps
FROM trials JOIN listed USING (trial_id, spec_hash) JOIN states USING (trial_id, spec_hash)
LEFT JOIN specs USING (spec_hash) LEFT JOIN driven USING (trial_id, spec_hash)
WHERE trials.status = 'collided' AND time_s >= 0 GROUP BY ALL HAVING len(left_m) = len(right_m)
"""
# What else their specs tell of the trials that were listed last.
DRIVEN_BY = """
SELECT model_left AS left, model_right AS right, spec::VARCHAR AS spec, scripted, posed,
    list(number) AS numbers
FROM listed SEMI JOIN trials USING (trial_id, spec_hash) LEFT JOIN specs USING (spec_hash)
GROUP BY ALL
"""
TAKEN = "TRUNCATE trials; TRUNCATE trial_factors; TRUNCATE states;"
# Before the name of a factor: its facet.
FACTOR = "factor."
# Facets of which a trial may have several values, and the tables that hold these.
SEVERAL = {"sweep": "members", "cause": "causes", "tag": "tagged"}
SORTS = {
    "trial": "trial_id",
    "outcome": "outcome",
    "end": "end_time_s",
    "gap": "gap_m",
    "rmse": "rmse_mps",
    "invalid": "invalid",
    "cost": "cost_usd",
}
COUNTS = """
count(*) AS trials, count(*) FILTER (status <> 'failed') AS ended,
count(*) FILTER (status = 'failed') AS failed, count(*) FILTER (status = 'collided') AS collided,
count(*) FILTER (outcome = 'left first') AS left_first,
count(*) FILTER (outcome = 'right first') AS right_first,
coalesce(sum(decisions), 0)::BIGINT AS decisions, coalesce(sum(asked), 0)::BIGINT AS asked,
coalesce(sum(invalid), 0)::BIGINT AS invalid,
coalesce(sum(fallbacks), 0)::BIGINT AS fallbacks, coalesce(sum(cost_usd), 0) AS cost_usd,
avg(gap_m) AS gap_m, avg(rmse_mps) AS rmse_mps, string_agg(DISTINCT stand_in, '; ') AS stand_in
"""
SHOWN = "* EXCLUDE (flaws, posed, tried)"
SPEEDS = "left_mps, right_mps, left_range_mps, right_range_mps"
EXPORTED = (
    "* EXCLUDE (who, flaws, posed, tried, levels, number, asked, model_left, model_right, "
    f"{SPEEDS})"
)


@dataclass(frozen=True, slots=True)
class Filter:
    """Which trials are wanted; an empty text wants all. ``q`` is part of a name.

    ``who`` is ``drivers``, ``humans`` or ``stand-ins``. ``levels`` are (factor, level). ``trials``
    are (trial, spec), where those behind a cell of a table are wanted.
    """

    sweep: str = ""
    who: str = ""
    model: str = ""
    variant: str = ""
    condition: str = ""
    outcome: str = ""
    account: str = ""
    validity: str = ""
    cause: str = ""
    tag: str = ""
    q: str = ""
    levels: tuple[tuple[str, str], ...] = ()
    trials: tuple[tuple[str, str], ...] | None = None

    def where(self, leave_out: str = "") -> tuple[str, list[Any]]:
        """The filter as SQL with its values; without one facet, to count its alternatives."""
        parts, values = ["true"], list[Any]()
        for name in FACETS:
            if (value := getattr(self, name)) and name != leave_out:
                parts.append(
                    f"number IN (SELECT number FROM {SEVERAL[name]} WHERE {name} = ?)"  # noqa: S608 # constants
                    if name in SEVERAL
                    else f"{name} = ?"
                )
                values.append(value)
        for factor, level in self.levels:
            if f"{FACTOR}{factor}" != leave_out:
                parts.append("number IN (SELECT number FROM levels WHERE factor = ? AND level = ?)")
                values += [factor, level]
        if self.q:
            parts.append("contains(lower(trial_id), lower(?))")
            values.append(self.q)
        if self.trials is not None:
            parts.append("(trial_id, spec_hash) IN (SELECT (unnest(?::VARCHAR[]), "
                         "unnest(?::VARCHAR[])))")  # fmt: skip
            values += [[name for name, _ in self.trials], [spec for _, spec in self.trials]]
        return " AND ".join(parts), values

    @property
    def chosen(self) -> dict[str, str]:
        """What is asked for, by name."""
        named = {name: value for name in (*FACETS, "q") if (value := getattr(self, name))}
        return named | {f"{FACTOR}{factor}": level for factor, level in self.levels}


FACETS = tuple(f.name for f in fields(Filter) if f.name not in {"q", "levels", "trials"})


@dataclass(slots=True)
class Catalogue:
    """All trials of a database. Threads take turns.

    ``held``: another program holds the database, and what is listed may be old.
    """

    db: Path
    held: bool = False
    _connection: duckdb.DuckDBPyConnection | None = None
    _instance: Instance = field(default_factory=Instance)
    _file: int | None = None
    """The inode of the file that is listed: another file may take its name."""
    _stamp: tuple[int, ...] | None = None
    """The stamp of the database when it was last read to the end."""
    _lock: threading.RLock = field(default_factory=threading.RLock)
    _tags: tuple[tuple[str, str, str], ...] = ()

    def refresh(self) -> bool:
        """Take in what is new in the database; returns whether anything was.

        The file is opened for 2,000 trials at a time, so that a sweep can write in between.
        Raises UsageError and StoreError, but not where another program holds what is listed.
        """
        with self._lock:
            stamp = stamp_of(self.db)
            if stamp == self._stamp:
                self.held = False
                return False
            if self._connection is None or stamp[0] != self._file:
                self._begin(stamp[0])
            try:
                # What is forgotten is taken again before anybody else can hold the file.
                waiting = self._reading(FORGET + TAKE + STAGED)
                while waiting:
                    # With the file closed: measuring takes longer than copying.
                    self._memory.execute(LIST)
                    self._account_for_collisions()
                    self._name_drivers()
                    self._memory.execute(TAKEN)
                    waiting = self._reading(TAKE + STAGED)
            except StoreLocked:
                if self._stamp is None:
                    raise
                self.held = True
            except MergeRunnerError:
                self._file = self._stamp = None  # whatever is there next, begin anew
                raise
            else:
                self._stamp, self.held = stamp, False
            self._note_others()
            self._memory.execute(GROUPED)
            return not self.held

    def keep(self, numbers: Sequence[int]) -> None:
        """List no trials but those with these numbers."""
        with self._lock:
            for table in ("listed", "levels"):
                self._memory.execute(
                    f"DELETE FROM {table} WHERE number NOT IN (SELECT unnest(?))",  # noqa: S608 # constants
                    [numbers],
                )
            self._memory.execute(GROUPED)

    def facets(self, wanted: Filter) -> dict[str, list[tuple[str, int]]]:
        """Each facet's values with how many trials they would leave, the other facets as wanted."""
        factors = [f"{FACTOR}{name}" for name in self.factors()]
        found: dict[str, list[tuple[str, int]]] = {name: [] for name in (*FACETS, *factors)}
        counts, values = [], list[Any]()
        for name in found:
            where, wants = wanted.where(leave_out=name)
            table, value = "listed", name
            if name in SEVERAL:
                table = f"listed JOIN {SEVERAL[name]} USING (number)"
            elif name in factors:
                table, value = "listed JOIN (FROM levels WHERE factor = ?) USING (number)", "level"
                wants = [name.removeprefix(FACTOR), *wants]
            counts.append(
                f"SELECT ? AS facet, {value} AS value, count(*) AS trials FROM {table} "  # noqa: S608 # constants
                f"WHERE {where} AND {value} IS NOT NULL GROUP BY ALL"
            )
            values += [name, *wants]
        for row in self.ask(f"{' UNION ALL '.join(counts)} ORDER BY ALL", *values):
            found[row["facet"]].append((row["value"], row["trials"]))
        return found

    def factors(self) -> list[str]:
        """The factors of the listed studies, with ``model`` where there is any, but no prompt."""
        rows = self.ask("SELECT DISTINCT factor FROM levels ORDER BY ALL")
        names = [str(row["factor"]) for row in rows]
        return names if names != ["model"] else []

    def totals(self, wanted: Filter) -> dict[str, Row]:
        """What a filter's trials come to: those of ``drivers``, ``humans`` and ``stand-ins``."""
        return {row["who"]: row for row in self.counts(wanted, "who")}

    def counts(self, wanted: Filter, *columns: str) -> list[Row]:
        """What a filter's trials come to by columns: counts of all, means of those with a value."""
        where, values = wanted.where()
        named = ", ".join(columns)
        return self.ask(
            f"SELECT {named}, {COUNTS} FROM listed WHERE {where} GROUP BY {named} "  # noqa: S608 # constants
            f"ORDER BY {named}",
            *values,
        )

    def page(self, wanted: Filter, sort: str, number: int) -> list[Row]:
        """The trials of one page, counted from 1; ``-gap`` sorts the largest gap first."""
        where, values = wanted.where()
        order = order_by(sort)
        # Only the trials of the page are read with their speeds, which take the longest.
        return self.ask(
            f"SELECT {SHOWN} FROM listed SEMI JOIN (SELECT number FROM listed WHERE {where} "  # noqa: S608 # constants
            f"ORDER BY {order} LIMIT {PAGE} OFFSET ?) USING (number) ORDER BY {order}",
            *values,
            PAGE * (number - 1),
        )

    def every(self, wanted: Filter) -> list[Row]:
        """All trials of a filter, by name."""
        where, values = wanted.where()
        return self.ask(
            f"SELECT {SHOWN} FROM listed WHERE {where} ORDER BY trial_id, spec_hash",  # noqa: S608 # constants
            *values,
        )

    def find(self, trial_id: str, spec_hash: str | None = None) -> Row | None:
        """One trial; where its name stands for several, the one of that spec, or any."""
        found = self.ask(
            f"SELECT {SHOWN} FROM listed WHERE trial_id = ? AND spec_hash = coalesce(?, spec_hash) "  # noqa: S608 # constants
            "ORDER BY spec_hash LIMIT 1",
            trial_id,
            spec_hash,
        )
        return found[0] if found else None

    def pairs(self, model: str, variant: str, fate: str) -> list[Row]:
        """Trials of a variant beside those of the baseline; ``fate``: outcome or joint."""
        return self.ask(PAIRS.format(fate=fate), model, variant)

    def state(self) -> State:
        """What is listed now, as a number of trials and a sum over their names and ends."""
        (row,) = self.ask(
            "SELECT count(*) AS trials, coalesce(sum(hash(trial_id, spec_hash, status, end_time_s, "
            "error)), 0) AS sum FROM listed"
        )
        return int(row["trials"]), int(row["sum"])

    @property
    def others(self) -> set[tuple[str, str]]:
        """The models that were asked for, with the other ones that answered."""
        return {(row["requested"], row["served"]) for row in self.ask("FROM others")}

    def ask(self, sql: str, *values: object) -> list[Row]:
        """Rows of a query of ours on what is in memory."""
        with self._lock:
            return records(self._memory, sql, values)

    def cursor(self) -> duckdb.DuckDBPyConnection:
        """Another connection to what is in memory: its queries keep no page waiting."""
        with self._lock:
            return self._memory.cursor()

    def tag(self, tags: tuple[tuple[str, str, str], ...]) -> None:
        """Know the tags that readers gave: (trial, spec, tag), each once."""
        with self._lock:
            if tags != self._tags:
                self._memory.execute("TRUNCATE noted")
                if tags:
                    self._memory.executemany("INSERT INTO noted VALUES (?, ?, ?)", tags)
                self._tags = tags

    def export(self, wanted: Filter, sort: str) -> str:
        """All trials of a filter as CSV, with a column for each factor but the model."""
        where, values = wanted.where()
        factors = [name for name in self.factors() if name != "model"]
        with self._lock:
            found = self._memory.execute(
                f"SELECT {EXPORTED}, levels FROM listed WHERE {where} ORDER BY {order_by(sort)}",  # noqa: S608 # constants
                values,
            )
            names, rows = [name for name, *_ in found.description[:-1]], found.fetchall()
        lines = io.StringIO()
        writer = csv_writer(lines)
        writer.writerow(map(csv_cell, [*names, *(f"{FACTOR}{name}" for name in factors)]))
        for *cells, levels in rows:
            chosen = dict(level.split("=", 1) for level in levels or ())
            writer.writerow(map(csv_cell, [*cells, *map(chosen.get, factors)]))
        return lines.getvalue()

    def _begin(self, file: int) -> None:
        """Forget everything."""
        self._instance.drop()
        self._connection = self._instance.cursor()
        self._connection.execute(schema_sql())
        self._connection.execute(BEGUN.format(staged=STAGED, listing=LISTING) + GROUPED)
        self._file, self._stamp, self._tags = file, None, ()

    def _reading(self, sql: str) -> int:
        """Run statements on the database and ours; returns how many trials wait to be listed."""
        # A reader that found it held once does not wait again.
        patience_s = 0.0 if self.held else PATIENCE_S
        with reading(self.db, self._instance, patience_s) as connection:
            connection.execute(sql)
            (waiting,) = connection.execute("SELECT count(*) FROM memory.trials").fetchall()
        count: int = waiting[0]
        return count

    def _account_for_collisions(self) -> None:
        """Note how each collision among the trials that were listed last came about."""
        crashes = records(self._memory, CRASHES, ())
        self._memory.execute(
            "UPDATE listed SET account = found.account "
            "FROM (SELECT unnest(?::INTEGER[]) AS number, unnest(?::VARCHAR[]) AS account) "
            "AS found WHERE listed.number = found.number",
            [[crash["number"] for crash in crashes], [_how(crash) for crash in crashes]],
        )

    def _name_drivers(self) -> None:
        """Note which model a stand-in stood in for, and that a replayed human does not react."""
        for group in records(self._memory, DRIVEN_BY, ()):
            spec = json.loads(group["spec"] or "{}")
            models = language_models({side: group[side] for side in SIDES}, spec)
            posed = stand_in(models, group["posed"] or SIDES) if group["scripted"] else None
            self._memory.execute(
                "UPDATE listed SET stand_in = ?, caution = ? WHERE number IN (SELECT unnest(?))",
                [posed, unresponsive(spec) or None, group["numbers"]],
            )

    def _note_others(self) -> None:
        """Find out where another model answered, by the aliases of all sweeps."""
        answered = "SELECT DISTINCT requested, served FROM tried WHERE answered"
        pairs, aliases = (self._memory.execute(sql).fetchall() for sql in (answered, ALIASES))
        self._memory.execute("TRUNCATE others")
        if others := others_among(pairs, aliases):
            self._memory.executemany("INSERT INTO others VALUES (?, ?)", others)

    @property
    def _memory(self) -> duckdb.DuckDBPyConnection:
        assert self._connection is not None, "it was never refreshed"
        return self._connection


def _how(crash: Row) -> str | None:
    """The class of a collision; None where its spec cannot be read, which the audit tells."""
    try:
        scenario = _task(crash["source"], crash["spec"] or "{}")
    except ValidationError:
        return None
    course = Course(
        scenario,
        TRACK,
        crash["times_s"],
        {side: crash[f"{side}_m"] for side in SIDES},
        {side: crash[f"{side}_mps"] for side in SIDES},
    )
    return collision_class(course, crash["made"] or [])


@lru_cache
def _task(source: str, spec: str) -> ScenarioConfig:
    """What the trials of a spec were driven by: there are few specs, and many trials."""
    return scenario_of(source, json.loads(spec).get("scenario"))


def order_by(sort: str) -> str:
    """A sort as SQL: what has no value comes last, and equal ones by name."""
    column = SORTS.get(sort.removeprefix("-"), "trial_id")
    direction = "DESC" if sort.startswith("-") else "ASC"
    return f"{column} {direction} NULLS LAST, trial_id, spec_hash"
