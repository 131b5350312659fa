"""The list of all trials, held in memory and kept up to date with the database."""

from __future__ import annotations

import io
import json
import os
import threading
from collections.abc import Sequence
from contextlib import suppress
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
from merge_runner.text_safety import csv_writer, quoted
from merge_runner_analysis.accounts import ALONE, OTHER_ACCOUNTS, Course, collision_class
from merge_runner_analysis.data.derived_cache import program
from merge_runner_analysis.data.driver_words import language_models, stand_in, unresponsive
from merge_runner_analysis.explorer.details import scenario_of
from merge_runner_analysis.explorer.display_text import csv_cell
from merge_runner_analysis.explorer.reading import PATIENCE_S, Row, reading, records, stamp_of

PAGE = 100
State = tuple[int, int]
"""The number of trials and a sum over them: equal where the same trials are listed."""
# Differs where what was stored of a trial does: another program may have played it anew.
PRINTS = """
SELECT trial_id, spec_hash,
    xor(hash(trials), xor(coalesce(of_decisions, 0), coalesce(of_calls, 0))) AS print
FROM trials LEFT JOIN (
    SELECT trial_id, spec_hash, bit_xor(hash(side, decision, valid, failure, tactical, applied,
        fallback, call_key)) AS of_decisions FROM decisions GROUP BY ALL
) USING (trial_id, spec_hash) LEFT JOIN (
    SELECT trial_id, spec_hash, bit_xor(hash(call_key, side, decision, attempt, http_status,
        model_requested, model_served, outcome, cost_usd, scripted)) AS of_calls
    FROM calls GROUP BY ALL
) USING (trial_id, spec_hash)
"""
# Of each trial its attempts, counted where they are alike.
TRIED = """
SELECT trial_id, spec_hash, sum(times)::BIGINT AS attempts, sum(cost_usd) AS cost_usd,
    list({requested: requested, served: served, answered: answered, outcome: outcome,
        unpriced: unpriced, times: times}) AS tried
FROM (
    SELECT trial_id, spec_hash, model_requested AS requested, model_served AS served,
        http_status = 200 AS answered, outcome, count(*) FILTER (cost_usd IS NULL) AS unpriced,
        count(*) AS times, sum(cost_usd) AS cost_usd
    FROM calls GROUP BY ALL
) GROUP BY ALL
"""
# About 24 samples of each vehicle's speed, and the range of all samples.
SPEEDS = """
SELECT trial_id, spec_hash,
    left_all[1:-1:1 + len(left_all) // 24] AS left_mps,
    right_all[1:-1:1 + len(right_all) // 24] AS right_mps,
    [list_min(left_all), list_max(left_all)] AS left_range_mps,
    [list_min(right_all), list_max(right_all)] AS right_range_mps
FROM (
    SELECT trial_id, spec_hash,
        list(velocity_mps::FLOAT ORDER BY step) FILTER (side = 'left') AS left_all,
        list(velocity_mps::FLOAT ORDER BY step) FILTER (side = 'right') AS right_all
    FROM states WHERE time_s >= 0 GROUP BY ALL
)
"""
# Of the levels of its study's factors a trial has a text each, but not of the prompt; a reply is
# known by its call and attempt, since trials may share it. A fallback follows every invalid reply,
# and nothing else: see the audit.
LISTING = f"""
SELECT nextval('numbers')::INTEGER AS number, trials.trial_id, trials.spec_hash, source,
    CASE WHEN source = 'human' THEN 'humans' WHEN scripted THEN 'stand-ins' ELSE 'drivers' END
        AS who,
    model_left, model_right,
    if(source = 'human', 'human', driver) AS model,
    variant, condition, projected_headway_m, relative_velocity_mps, rep, pair, status,
    merged_first, end_time_s, error, scripted,
    stand_in, caution,
    if(status = 'finished', coalesce(merged_first || ' first', 'nobody first'), status) AS outcome,
    CASE WHEN source = 'human' THEN 'human' WHEN decisions IS NULL THEN 'no decision'
        WHEN fallbacks > 0 OR invalid > 0 THEN 'fallbacks'
        ELSE 'all valid' END AS validity,
    time_to_merge_s, gap_m, rmse_mps, joint, min_ttc_s,
    coalesce(collision, {OTHER_ACCOUNTS}) AS account,
    coalesce(decisions, 0) AS decisions, coalesce(asked, 0) AS asked,
    coalesce(invalid, 0) AS invalid, coalesce(fallbacks, 0) AS fallbacks,
    coalesce(attempts, 0) AS attempts, cost_usd, left_mps, right_mps, left_range_mps,
    right_range_mps, print, flaws, tried, replies, factors,
    [f.factor || '=' || f.level FOR f IN factors IF f.factor <> 'model'] AS levels
FROM trials
JOIN judged USING (trial_id, spec_hash)
JOIN ({PRINTS}) USING (trial_id, spec_hash)
JOIN trial_metrics USING (trial_id, spec_hash)
JOIN trial_drivers USING (trial_id, spec_hash)
LEFT JOIN (
    SELECT trial_id, spec_hash, count(*) AS decisions, count(call_key) AS asked,
        count(*) FILTER (NOT valid) AS invalid, count(*) FILTER (fallback) AS fallbacks,
        list(failure) FILTER (failure IS NOT NULL) AS flaws
    FROM decisions GROUP BY ALL
) USING (trial_id, spec_hash)
LEFT JOIN ({TRIED}) USING (trial_id, spec_hash)
LEFT JOIN (
    SELECT trial_id, spec_hash, list({{reply: hash(call_key, attempt), usd: cost_usd}}) AS replies
    FROM calls GROUP BY ALL
) USING (trial_id, spec_hash)
LEFT JOIN ({ALONE}) USING (trial_id, spec_hash)
LEFT JOIN (
    SELECT trial_id, spec_hash, list({{factor: factor, level: value}} ORDER BY factor) AS factors
    FROM trial_levels WHERE factor <> 'prompt' GROUP BY ALL
) USING (trial_id, spec_hash)
LEFT JOIN ({SPEEDS}) USING (trial_id, spec_hash)
"""  # noqa: S608 # constants
# Facets of which a trial may have several values, and the tables that hold these.
SEVERAL = {"sweep": "members", "cause": "causes", "tag": "tagged"}
# Before the name of a factor: its facet.
FACTOR = "factor."
BEGUN = f"""
CREATE SEQUENCE numbers;
CREATE TABLE judged (trial_id VARCHAR, spec_hash VARCHAR, collision VARCHAR, stand_in VARCHAR,
    caution VARCHAR);
CREATE TABLE listed AS {LISTING};
CREATE TABLE noted (trial_id VARCHAR, spec_hash VARCHAR, tag VARCHAR);
CREATE TABLE others (requested VARCHAR, served VARCHAR);
CREATE VIEW tried AS SELECT number, unnest(tried, recursive := true) FROM listed;
CREATE VIEW replies AS SELECT number, unnest(replies, recursive := true) FROM listed;
CREATE VIEW levels AS SELECT number, unnest(factors, recursive := true) FROM listed;
CREATE VIEW tagged AS SELECT number, tag FROM noted JOIN listed USING (trial_id, spec_hash);
CREATE VIEW members AS SELECT DISTINCT sweep_id AS sweep, number
    FROM sweep_trials JOIN listed USING (trial_id, spec_hash);
CREATE VIEW causes AS
    SELECT number, 'plan: ' || flaw AS cause, count(*) AS times
    FROM (SELECT number, unnest(flaws) AS flaw FROM listed) GROUP BY ALL
    UNION ALL SELECT number, 'attempt: ' || outcome, sum(times)::BIGINT
    FROM tried WHERE outcome <> 'ok' GROUP BY ALL
    UNION ALL SELECT number, 'model: ' || requested || ' → ' || served, sum(times)::BIGINT
    FROM tried SEMI JOIN others USING (requested, served) WHERE answered GROUP BY ALL;
CREATE VIEW several AS
    SELECT number, '{FACTOR}' || factor AS facet, level AS value FROM levels
    UNION ALL SELECT number, 'sweep', sweep FROM members
    UNION ALL SELECT number, 'cause', cause FROM causes
    UNION ALL SELECT number, 'tag', tag FROM tagged;
"""  # noqa: S608 # constants
# What is listed no longer as it is stored goes, and is taken again before anybody else can hold the
# file. What was only asked is no trial to look at.
FORGET = f"""
DELETE FROM memory.listed
    WHERE (trial_id, spec_hash, print) NOT IN (SELECT (trial_id, spec_hash, print) FROM ({PRINTS}));
TRUNCATE memory.sweep_trials;
INSERT INTO memory.sweep_trials FROM sweep_trials;
TRUNCATE memory.sweeps;
INSERT INTO memory.sweeps BY NAME FROM sweeps WHERE coalesce(config->>'$.seat', '') = '';
INSERT OR IGNORE INTO memory.specs FROM specs;
"""  # noqa: S608 # constants
# Of the next 2,000 what is measured: the file is not held for longer than copying takes. Texts and
# prompts stay in the database.
TAKE = """
INSERT INTO memory.trials BY NAME
    FROM trials ANTI JOIN memory.listed USING (trial_id, spec_hash) WHERE source <> 'seat'
    ORDER BY trial_id, spec_hash LIMIT 2000;
INSERT INTO memory.trial_factors
    FROM trial_factors SEMI JOIN memory.trials USING (trial_id, spec_hash);
INSERT INTO memory.states BY NAME
    FROM states SEMI JOIN memory.trials USING (trial_id, spec_hash);
INSERT INTO memory.decisions BY NAME SELECT * EXCLUDE (prompt, rationale, plan)
    FROM decisions SEMI JOIN memory.trials USING (trial_id, spec_hash);
INSERT INTO memory.calls BY NAME SELECT * EXCLUDE (request, reply, error)
    FROM calls SEMI JOIN memory.trials USING (trial_id, spec_hash);
"""
TAKEN = """
TRUNCATE trials; TRUNCATE trial_factors; TRUNCATE states; TRUNCATE decisions; TRUNCATE calls;
TRUNCATE judged;
"""
# What was measured by the rules of this very program.
RECALL = """
INSERT INTO listed BY NAME
    SELECT nextval('numbers') AS number, * EXCLUDE rules FROM read_parquet(?) WHERE rules = ?
"""
# What SQL cannot judge of the trials that were copied last: collisions by both courses and, after a
# fallback, by the decisions; by the spec who drove, and on which sides a stand-in ``posed``.
JUDGED = """
SELECT trial_id, spec_hash, source, status, scripted, model_left AS left, model_right AS right,
    coalesce(spec::VARCHAR, '{}') AS spec, posed, made, times_s, left_m, right_m, left_mps,
    right_mps
FROM trials LEFT JOIN specs USING (spec_hash)
LEFT JOIN (
    SELECT trial_id, spec_hash, list(DISTINCT side ORDER BY side) AS posed
    FROM calls WHERE scripted GROUP BY ALL
) USING (trial_id, spec_hash) LEFT JOIN (
    SELECT trial_id, spec_hash, list({side: side, time_s: time_s, fallback: fallback}
        ORDER BY decision) AS made
    FROM decisions GROUP BY ALL HAVING bool_or(fallback)
) USING (trial_id, spec_hash) LEFT JOIN (
    SELECT trial_id, spec_hash, list(time_s ORDER BY step) FILTER (side = 'left') AS times_s,
        list(position_m ORDER BY step) FILTER (side = 'left') AS left_m,
        list(position_m ORDER BY step) FILTER (side = 'right') AS right_m,
        list(velocity_mps ORDER BY step) FILTER (side = 'left') AS left_mps,
        list(velocity_mps ORDER BY step) FILTER (side = 'right') AS right_mps
    FROM states SEMI JOIN (FROM trials WHERE status = 'collided') USING (trial_id, spec_hash)
    WHERE time_s >= 0 GROUP BY ALL HAVING len(left_m) = len(right_m)
) USING (trial_id, spec_hash)
"""
NOTE_JUDGED = f"INSERT INTO judged SELECT {', '.join(['unnest(?::VARCHAR[])'] * 5)}"
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
COUNTED = "print, flaws, tried, replies, factors"
SHOWN = f"* EXCLUDE ({COUNTED})"
EXPORTED = (
    f"* EXCLUDE ({COUNTED}, who, levels, number, asked, model_left, model_right, "
    "left_mps, right_mps, left_range_mps, right_range_mps)"
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
        for name, value in self.chosen.items():
            if name == leave_out:
                continue
            if name == "q":
                parts.append("contains(lower(trial_id), lower(?))")
            elif name in FACETS and name not in SEVERAL:
                parts.append(f"{name} = ?")
            else:
                parts.append("number IN (SELECT number FROM several WHERE facet = ? AND value = ?)")
                values.append(name)
            values.append(value)
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

    What is measured of a trial is kept in a file beside the database, so that the next program that
    opens it measures the new ones alone. ``held``: another program holds the database, and what is
    listed may be old.
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
                waiting = measured = self._reading(FORGET + TAKE)
                while waiting:
                    # With the file closed: measuring takes longer than copying.
                    judged = [_judged(row) for row in records(self._memory, JUDGED, ())]
                    self._memory.execute(NOTE_JUDGED, [*map(list, zip(*judged, strict=True))])
                    self._memory.execute(f"INSERT INTO listed BY NAME {LISTING}; {TAKEN}")
                    waiting = self._reading(TAKE)
            except StoreLocked:
                if self._stamp is None:
                    raise
                self.held = True
            except MergeRunnerError:
                self._file = self._stamp = None  # whatever is there next, begin anew
                raise
            else:
                self._stamp, self.held = stamp, False
                if measured:
                    self._remember()
            self._note_others()
            return not self.held

    def keep(self, numbers: Sequence[int]) -> None:
        """List no trials but those with these numbers."""
        with self._lock:
            self._memory.execute(
                "DELETE FROM listed WHERE number NOT IN (SELECT unnest(?))", [numbers]
            )

    def facets(self, wanted: Filter) -> dict[str, list[tuple[str, int]]]:
        """Each facet's values with how many trials they would leave, the other facets as wanted."""
        found: dict[str, list[tuple[str, int]]] = {
            name: [] for name in (*FACETS, *(f"{FACTOR}{name}" for name in self.factors()))
        }
        counts, values = [], list[Any]()
        for name in found:
            where, wants = wanted.where(leave_out=name)
            table, value = "listed", name
            if name not in FACETS or name in SEVERAL:
                table = "listed JOIN (FROM several WHERE facet = ?) USING (number)"
                value, wants = "value", [name, *wants]
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

    def every(self, wanted: Filter, sort: str = "trial", limit: str = "") -> list[Row]:
        """All trials of a filter; ``-gap`` sorts the largest gap first."""
        where, values = wanted.where()
        order = order_by(sort)
        # Only the trials of a page are read with their speeds, which take the longest.
        return self.ask(
            f"SELECT {SHOWN} FROM listed SEMI JOIN (SELECT number FROM listed WHERE {where} "  # noqa: S608 # constants
            f"ORDER BY {order} {limit}) USING (number) ORDER BY {order}",
            *values,
        )

    def page(self, wanted: Filter, sort: str, number: int) -> list[Row]:
        """The trials of one page, counted from 1."""
        return self.every(wanted, sort, f"LIMIT {PAGE} OFFSET {PAGE * (number - 1)}")

    def find(self, trial_id: str, spec_hash: str | None = None) -> Row | None:
        """One trial; where its name stands for several, the one of that spec, or any."""
        found = self.ask(
            f"SELECT {SHOWN} FROM listed WHERE trial_id = ? AND spec_hash = coalesce(?, spec_hash) "  # noqa: S608 # constants
            "ORDER BY spec_hash LIMIT 1",
            trial_id,
            spec_hash,
        )
        return found[0] if found else None

    def state(self) -> State:
        """What is listed now."""
        ((trials, prints),) = map(
            dict.values,
            self.ask(
                "SELECT count(*) AS trials, coalesce(bit_xor(print), 0) AS prints FROM listed"
            ),
        )
        return int(trials), int(prints)

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
        """Forget everything but what was measured before."""
        self._instance.drop()
        self._connection = self._instance.cursor()
        self._connection.execute(schema_sql() + BEGUN)
        self._file, self._stamp, self._tags = file, None, ()
        # Without the file, or where it is damaged, all is measured anew.
        with suppress(duckdb.Error):
            self._connection.execute(RECALL, [str(measured_beside(self.db)), program()])

    def _remember(self) -> None:
        """Keep what was measured; where nothing can be written it is measured again next time."""
        path = measured_beside(self.db)
        made = path.with_name(f"{path.name}.{os.getpid()}")
        with suppress(duckdb.Error, OSError):
            self._memory.execute(
                f"COPY (SELECT * EXCLUDE number, ? AS rules FROM listed) TO {quoted(made)} "  # noqa: S608 # constants
                "(FORMAT parquet)",
                [program()],
            )
            made.replace(path)

    def _reading(self, sql: str) -> int:
        """Run statements on the database and ours; returns how many trials wait to be listed."""
        # A reader that found it held once does not wait again.
        patience_s = 0.0 if self.held else PATIENCE_S
        with reading(self.db, self._instance, patience_s) as connection:
            connection.execute(sql)
            (waiting,) = connection.execute("SELECT count(*) FROM memory.trials").fetchall()
        count: int = waiting[0]
        return count

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


def _judged(trial: Row) -> tuple[str, str, str | None, str | None, str | None]:
    """The key of a trial, how it collided, who answered instead of a model, and who cannot react.

    Where its spec cannot be read, which the audit tells, nobody knows how it collided.
    """
    spec = json.loads(trial["spec"])
    models = language_models({side: trial[side] for side in SIDES}, spec)
    posed = stand_in(models, trial["posed"] or SIDES) if trial["scripted"] else None
    collision = None
    if trial["times_s"]:
        with suppress(ValidationError):
            course = Course(
                _task(trial["source"], trial["spec"]),
                TRACK,
                trial["times_s"],
                {side: trial[f"{side}_m"] for side in SIDES},
                {side: trial[f"{side}_mps"] for side in SIDES},
            )
            collision = collision_class(course, trial["made"] or [])
    return trial["trial_id"], trial["spec_hash"], collision, posed, unresponsive(spec) or None


@lru_cache
def _task(source: str, spec: str) -> ScenarioConfig:
    """What the trials of a spec were driven by: there are few specs, and many trials."""
    return scenario_of(source, json.loads(spec).get("scenario"))


def measured_beside(db: Path) -> Path:
    """The file that keeps what was measured of the trials of a database."""
    return db.with_name(f"{db.name}.trials.parquet")


def order_by(sort: str) -> str:
    """A sort as SQL: what has no value comes last, and equal ones by name."""
    column = SORTS.get(sort.removeprefix("-"), "trial_id")
    direction = "DESC" if sort.startswith("-") else "ASC"
    return f"{column} {direction} NULLS LAST, trial_id, spec_hash"
