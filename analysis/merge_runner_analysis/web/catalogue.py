"""The list of all trials, held in memory and kept up to date with the database."""

from __future__ import annotations

import io
import json
import os
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import duckdb
from pydantic import ValidationError

from merge_runner.config import ScenarioConfig
from merge_runner.errors import MergeRunnerError, StoreLocked
from merge_runner.records import NO_DECISION, SIDES
from merge_runner.results.database import Instance, schema_sql
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.served_model import ALIASES, others_among
from merge_runner.text_safety import csv_writer, quoted
from merge_runner_analysis.cache import ROWS, program
from merge_runner_analysis.drivers import language_models, stand_in, unresponsive
from merge_runner_analysis.web.collision_account import (
    ALONE,
    OTHER_ACCOUNTS,
    Course,
    collision_class,
)
from merge_runner_analysis.web.display_text import csv_cell
from merge_runner_analysis.web.reading import PATIENCE_S, Row, reading, records, stamp_of
from merge_runner_analysis.web.views import condition_text, scenario_of

PAGE = 100
Wanted = Mapping[str, Any]
"""Which trials are wanted, by facet or column; an empty value wants all, and of a list one must be.

``who`` is ``drivers``, ``humans`` or ``stand-ins``, and ``q`` are parts of a name. ``trials`` are
(trial, spec), where those behind a cell of a table are wanted.
"""
Facets = dict[str, list[tuple[str, int]]]
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
# About 24 samples of each vehicle's speed, and the range of all. Of its study's factors
# a trial has a text each, but not of the prompt; a reply is known by its call and attempt, since
# trials may share it. A fallback follows every invalid reply, and nothing else: see the audit.
LISTING = f"""
SELECT nextval('numbers')::INTEGER AS number, trials.trial_id, trials.spec_hash, source,
    CASE WHEN source = 'human' THEN 'humans' WHEN scripted THEN 'stand-ins' ELSE 'drivers' END
        AS who,
    model_left, model_right, if(source = 'human', 'human', driver) AS model, variant, condition,
    projected_headway_m, relative_velocity_mps, rep, pair, status, merged_first, end_time_s, error,
    scripted, stand_in, caution,
    if(status = 'finished', coalesce(merged_first || ' first', 'nobody first'), status) AS outcome,
    CASE WHEN source = 'human' THEN 'human' WHEN decisions IS NULL THEN 'no decision'
        WHEN fallbacks > 0 OR invalid > 0 THEN 'fallbacks'
        ELSE 'all valid' END AS validity,
    time_to_merge_s, gap_m, rmse_mps, joint, min_ttc_s,
    coalesce(collision, {OTHER_ACCOUNTS}) AS account,
    coalesce(decisions, 0) AS decisions, coalesce(asked, 0) AS asked,
    coalesce(invalid, 0) AS invalid, coalesce(fallbacks, 0) AS fallbacks,
    coalesce(no_decision, 0) AS no_decision,
    coalesce(attempts, 0) AS attempts, cost_usd, left_mps, right_mps, left_range_mps,
    right_range_mps, print, flaws, tried, factors,
    [f.factor || '=' || f.level FOR f IN factors IF f.factor <> 'model'] AS levels
FROM trials
JOIN judged USING (trial_id, spec_hash)
JOIN ({PRINTS}) USING (trial_id, spec_hash)
JOIN trial_metrics USING (trial_id, spec_hash)
JOIN trial_drivers USING (trial_id, spec_hash)
LEFT JOIN (
    SELECT trial_id, spec_hash, count(*) AS decisions, count(call_key) AS asked,
        count(*) FILTER (NOT valid) AS invalid, count(*) FILTER (fallback) AS fallbacks,
        count(*) FILTER (failure = '{NO_DECISION}') AS no_decision,
        list(failure) FILTER (failure IS NOT NULL) AS flaws
    FROM decisions GROUP BY ALL
) USING (trial_id, spec_hash)
LEFT JOIN (
    SELECT trial_id, spec_hash, count(*) AS attempts, sum(cost_usd) AS cost_usd,
        list({{requested: model_requested, served: model_served, answered: http_status = 200,
            outcome: outcome, reply: hash(call_key, attempt), usd: cost_usd}}) AS tried
    FROM calls GROUP BY ALL
) USING (trial_id, spec_hash)
LEFT JOIN ({ALONE}) USING (trial_id, spec_hash)
LEFT JOIN (
    SELECT trial_id, spec_hash, list({{factor: factor, level: value}} ORDER BY factor) AS factors
    FROM trial_levels WHERE factor <> 'prompt' GROUP BY ALL
) USING (trial_id, spec_hash)
LEFT JOIN (
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
) USING (trial_id, spec_hash)
"""  # noqa: S608 # constants
FACETS = ("sweep", "who", "model", "variant", "condition", "outcome", "account", "validity",
          "cause", "tag")  # fmt: skip
MISSING = "decision: missing"
# Facets of which a trial may have several values, and the tables that hold these.
SEVERAL = {"sweep": "members", "cause": "causes", "tag": "tagged"}
# Before the name of a factor: its facet.
FACTOR = "factor."
BEGUN = f"""
CREATE SEQUENCE numbers;
CREATE TABLE judged (trial_id VARCHAR, spec_hash VARCHAR, collision VARCHAR, stand_in VARCHAR,
    caution VARCHAR);
CREATE TABLE listed AS FROM ({LISTING}) LIMIT 0;
CREATE TABLE noted (trial_id VARCHAR, spec_hash VARCHAR, tag VARCHAR);
CREATE TABLE others (requested VARCHAR, served VARCHAR);
CREATE TABLE shared (number INTEGER, of_several STRUCT(reply UBIGINT, usd DOUBLE)[]);
CREATE VIEW tried AS SELECT number, unnest(tried, recursive := true) FROM listed;
CREATE VIEW levels AS SELECT number, unnest(factors, recursive := true) FROM listed;
CREATE VIEW tagged AS SELECT number, tag FROM noted JOIN listed USING (trial_id, spec_hash);
CREATE VIEW members AS SELECT DISTINCT sweep_id AS sweep, number
    FROM sweep_trials JOIN listed USING (trial_id, spec_hash);
CREATE VIEW causes AS
    SELECT number, if(flaw = '{NO_DECISION}', '{MISSING}', 'plan: ' || flaw) AS cause,
        count(*) AS times
    FROM (SELECT number, unnest(flaws) AS flaw FROM listed) GROUP BY ALL
    UNION ALL SELECT number, 'attempt: ' || outcome, count(*)
    FROM tried WHERE outcome <> 'ok' GROUP BY ALL
    UNION ALL SELECT number, 'model: ' || requested || ' → ' || served, count(*)
    FROM tried SEMI JOIN others USING (requested, served) WHERE answered GROUP BY ALL;
CREATE VIEW several AS
    SELECT number, '{FACTOR}' || factor AS facet, level AS value FROM levels
    UNION ALL SELECT number, 'sweep', sweep FROM members
    UNION ALL SELECT number, 'cause', cause FROM causes
    UNION ALL SELECT number, 'tag', tag FROM tagged;
CREATE VIEW counted AS FROM listed LEFT JOIN shared USING (number) LEFT JOIN (
    SELECT number, count(*) FILTER (outcome <> 'ok') AS faults,
        count(*) FILTER (answered) AS answers, count(*) FILTER
            (answered AND (requested, served) IN (FROM others)) AS others,
        count(*) FILTER (usd IS NULL) AS unpriced
    FROM tried GROUP BY ALL
) USING (number);
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
COPIED = "trial_factors", "states", "decisions", "calls"
TAKE = """
INSERT INTO memory.trials BY NAME
    FROM trials ANTI JOIN memory.listed USING (trial_id, spec_hash) WHERE source <> 'seat'
    ORDER BY trial_id, spec_hash LIMIT 2000;
""" + "".join(
    f"INSERT INTO memory.{name} BY NAME "
    f"FROM {ROWS[name]} SEMI JOIN memory.trials USING (trial_id, spec_hash);"
    for name in COPIED
)
TAKEN = "".join(f"TRUNCATE {name};" for name in ("trials", *COPIED, "judged"))
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
TEXTS = "unnest(?::VARCHAR[])"
NOTED = f"TRUNCATE noted; INSERT INTO noted SELECT {TEXTS}, {TEXTS}, {TEXTS}"
NOTE_JUDGED = f"INSERT INTO judged SELECT {TEXTS}, {TEXTS}, {TEXTS}, {TEXTS}, {TEXTS}"
ANSWERED = "SELECT DISTINCT requested, served FROM tried WHERE answered"
# Another model is one by the aliases of all sweeps, and a reply is shared by trials of any.
COMPARED = """
CREATE OR REPLACE TABLE shared AS
    SELECT number, list({reply: reply, usd: usd}) AS of_several
    FROM (FROM tried QUALIFY count(*) OVER (PARTITION BY reply) > 1) GROUP BY ALL;
TRUNCATE others;
INSERT INTO others SELECT unnest(?::VARCHAR[]), unnest(?::VARCHAR[]);
"""
SORTS = {"trial": "trial_id", "outcome": "outcome", "end": "end_time_s", "gap": "gap_m",
         "rmse": "rmse_mps", "invalid": "invalid", "cost": "cost_usd"}  # fmt: skip
SUMMED = ("decisions", "asked", "invalid", "fallbacks", "no_decision", "attempts", "faults",
          "answers", "others", "unpriced")  # fmt: skip
# A reply that several of the trials share counts and costs once. In their last digits sums differ
# from time to time.
COUNTS = f"""
count(*) AS trials, count(*) FILTER (status <> 'failed') AS ended,
count(*) FILTER (status = 'failed') AS failed, count(*) FILTER (status = 'collided') AS collided,
count(*) FILTER (outcome = 'left first') AS left_first,
count(*) FILTER (outcome = 'right first') AS right_first, count(*) FILTER (scripted) AS scripted,
{", ".join(f"coalesce(sum({name}), 0)::BIGINT AS {name}" for name in SUMMED)},
round(avg(gap_m), 9) AS gap_m, round(avg(rmse_mps), 9) AS rmse_mps,
string_agg(DISTINCT stand_in, '; ' ORDER BY stand_in) AS stand_in,
flatten(list(of_several)) AS every, list_distinct(every) AS once,
coalesce(len(once), 0) AS shared,
coalesce(sum(attempts), 0)::BIGINT - coalesce(len(every), 0) + coalesce(len(once), 0) AS replies,
round(coalesce(sum(cost_usd), 0) - coalesce(list_sum([reply.usd FOR reply IN every]), 0)
    + coalesce(list_sum([reply.usd FOR reply IN once]), 0), 9) AS cost_usd
"""
SHOWN = "* EXCLUDE (print, flaws, tried, factors)"
EXPORTED = (
    "trial_id spec_hash source model variant condition projected_headway_m relative_velocity_mps "
    "rep pair status merged_first end_time_s error scripted stand_in caution outcome validity "
    "time_to_merge_s gap_m rmse_mps joint min_ttc_s account decisions invalid fallbacks attempts "
    "cost_usd"
)


def where_of(wanted: Wanted, leave_out: str = "") -> tuple[str, list[Any]]:
    """A filter as SQL with its values; without one facet, to count its alternatives."""
    parts, values = ["true"], list[Any]()
    for name, value in wanted.items():
        if name == leave_out or value in ("", (), None):
            continue
        if name == "q":
            words = value.lower().split()
            parts += ["contains(lower(trial_id), ?)"] * len(words)
            values += words
            continue
        if name == "trials":
            parts.append("[trial_id, spec_hash] IN (SELECT unnest(?::VARCHAR[][]))")
        elif name in SEVERAL or name.startswith(FACTOR):
            parts.append("number IN (SELECT number FROM several WHERE facet = ? AND value = ?)")
            values.append(name)
        else:
            parts.append(f"{name} = ?" if isinstance(value, str) else f"list_contains(?, {name})")
        values.append(value)
    return " AND ".join(parts), values


@dataclass(slots=True)
class Catalogue:
    """All trials of a database. Threads take turns.

    What is measured of a trial is kept in a file beside the database, so that the next program that
    opens it measures the new ones alone. ``held``: another program holds the database, and what is
    listed may be old.
    """

    db: Path
    held: bool = False
    _memory: duckdb.DuckDBPyConnection = field(init=False)
    _instance: Instance = field(default_factory=Instance)
    _stamp: tuple[int, ...] = ()
    """The stamp of the database when it was last read to the end; before that its inode alone."""
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
            if stamp[:1] != self._stamp[:1]:  # another file may have taken the name
                self._begin(stamp[:1])
            try:
                waiting = measured = self._reading(FORGET + TAKE)
                while waiting:
                    # With the file closed: measuring takes longer than copying.
                    judged = zip(*map(_judged, self.ask(JUDGED)), strict=True)
                    self.ask(NOTE_JUDGED, *map(list, judged))
                    self._memory.execute(f"INSERT INTO listed BY NAME {LISTING}; {TAKEN}")
                    waiting = self._reading(TAKE)
            except StoreLocked:
                if self._stamp == stamp[:1]:
                    raise
                self.held = True
            except MergeRunnerError:
                self._stamp = ()  # whatever is there next, begin anew
                raise
            else:
                self._stamp, self.held = stamp, False
                if measured:
                    self._remember()
            answered, aliases = (
                self._memory.execute(sql).fetchall() for sql in (ANSWERED, ALIASES)
            )
            others = others_among(answered, aliases)
            self.ask(COMPARED, [asked for asked, _ in others], [served for _, served in others])
            return not self.held

    def _begin(self, file: tuple[int, ...]) -> None:
        """Forget everything but what was measured before."""
        self._instance.drop()
        self._memory = self._instance.cursor()
        self._memory.execute(schema_sql() + BEGUN)
        self._stamp, self._tags = file, ()
        # Without the file, or where it is damaged, all is measured anew.
        with suppress(duckdb.Error):
            self.ask(RECALL, str(measured_beside(self.db)), program())

    def _reading(self, sql: str) -> int:
        """Run statements on the database and ours; returns how many trials wait to be listed."""
        # A reader that found it held once does not wait again.
        patience_s = 0.0 if self.held else PATIENCE_S
        with reading(self.db, self._instance, patience_s) as connection:
            connection.execute(sql)
        return len(self.ask("FROM trials"))

    def _remember(self) -> None:
        """Keep what was measured; where nothing can be written it is measured again next time."""
        path = measured_beside(self.db)
        made = path.with_name(f"{path.name}.{os.getpid()}")
        with suppress(duckdb.Error, OSError):
            self.ask(
                f"COPY (SELECT * EXCLUDE number, ? AS rules FROM listed) TO {quoted(made)} "  # noqa: S608 # constants
                "(FORMAT parquet)",
                program(),
            )
            made.replace(path)

    def ask(self, sql: str, *values: object) -> list[Row]:
        """Rows of a query of ours on what is in memory."""
        with self._lock:
            return records(self._memory, sql, values)

    def cursor(self) -> duckdb.DuckDBPyConnection:
        """Another connection to what is in memory: its queries keep no page waiting."""
        with self._lock:
            return self._memory.cursor()

    def keep(self, numbers: Sequence[int]) -> None:
        """List no trials but those with these numbers."""
        self.ask("DELETE FROM listed WHERE number NOT IN (SELECT unnest(?))", numbers)

    def tag(self, tags: tuple[tuple[str, str, str], ...]) -> None:
        """Know the tags that readers gave: (trial, spec, tag), each once."""
        with self._lock:
            if tags != self._tags:
                columns = [[tag[i] for tag in tags] for i in range(3)]
                self.ask(NOTED, *columns)
                self._tags = tags

    def factors(self) -> list[str]:
        """The factors of the listed studies, with ``model`` where there is any, but no prompt."""
        rows = self.ask("SELECT DISTINCT factor FROM levels ORDER BY ALL")
        names = [str(row["factor"]) for row in rows]
        return names if names != ["model"] else []

    def facets(self, wanted: Wanted) -> Facets:
        """Each facet's values with how many trials they would leave, the other facets as wanted."""
        names = (*FACETS, *(f"{FACTOR}{name}" for name in self.factors()))
        with self._lock:
            return facets_of(self._memory, "listed", names, wanted)

    def counts(self, wanted: Wanted, *columns: str) -> list[Row]:
        """What a filter's trials come to by columns: counts of all, means of those with a value.

        Without columns it is one row. A trial counts in each ``sweep`` of which it is a member.
        """
        where, values = where_of(wanted)
        table = "counted JOIN members USING (number)" if "sweep" in columns else "counted"
        named = "".join(f"{name}, " for name in columns)
        return self.ask(
            f"SELECT * EXCLUDE (every, once) FROM (SELECT {named}{COUNTS} FROM {table} "  # noqa: S608 # constants
            f"WHERE {where} GROUP BY ALL) ORDER BY ALL",
            *values,
        )

    def every(self, wanted: Wanted, sort: str = "trial", page: int = 0) -> list[Row]:
        """All trials of a filter, or those of a page from 1; ``-gap`` sorts the largest gap first.

        What has no value comes last.
        """
        where, values = where_of(wanted)
        direction = "DESC" if sort.startswith("-") else "ASC"
        order = f"{SORTS[sort.removeprefix('-')]} {direction} NULLS LAST, trial_id, spec_hash"
        limit = f"LIMIT {PAGE} OFFSET {PAGE * (page - 1)}" if page else ""
        # Only the trials of a page are read with their speeds, which take the longest.
        return self.ask(
            f"SELECT {SHOWN} FROM listed SEMI JOIN (SELECT number FROM listed WHERE {where} "  # noqa: S608 # constants
            f"ORDER BY {order} {limit}) USING (number) ORDER BY {order}",
            *values,
        )

    def find(self, trial_id: str, spec_hash: str = "") -> Row | None:
        """One trial; where its name stands for several, the one of that spec, or any."""
        found = self.ask(
            f"SELECT {SHOWN} FROM listed WHERE trial_id = ? AND spec_hash LIKE ? "  # noqa: S608 # constants
            "ORDER BY spec_hash LIMIT 1",
            *(trial_id, spec_hash or "%"),
        )
        return next(iter(found), None)

    def condition_texts(self) -> dict[str, str]:
        """In words: the conditions that humans drove, and those of all trials."""
        numbers = "condition, projected_headway_m, relative_velocity_mps"
        played = self.ask(f"SELECT DISTINCT {numbers} FROM listed")  # noqa: S608 # constants
        return {
            name: condition_text(one.projected_headway_m, one.relative_velocity_mps)
            for name, one in HUMAN_CONDITIONS.items()
        } | {name: condition_text(*of) for name, *of in map(dict.values, played)}

    def state(self) -> Row:
        """What differs where other ``trials`` are listed, or the same otherwise."""
        return self.ask("SELECT count(*) AS trials, bit_xor(print) AS prints FROM listed")[0]

    def export(self, wanted: Wanted, sort: str) -> str:
        """All trials of a filter as CSV, with a column for each factor but the model."""
        factors = [name for name in self.factors() if name != "model"]
        names, lines = EXPORTED.split(), io.StringIO()
        writer = csv_writer(lines)
        writer.writerow(map(csv_cell, [*names, *(f"{FACTOR}{name}" for name in factors)]))
        for row in self.every(wanted, sort):
            levels = dict(level.split("=", 1) for level in row["levels"] or ())
            writer.writerow(map(csv_cell, [*map(row.get, names), *map(levels.get, factors)]))
        return lines.getvalue()


def facets_of(
    cursor: duckdb.DuckDBPyConnection, listed: str, names: Sequence[str], wanted: Wanted
) -> Facets:
    """The values of facets with how many rows of a table they would leave, the others as wanted."""
    counts, values = [], list[Any]()
    for name in names:
        where, wants = where_of(wanted, leave_out=name)
        table, value = listed, name
        if name in SEVERAL or name.startswith(FACTOR):
            table, value = f"{listed} JOIN (FROM several WHERE facet = ?) USING (number)", "value"
            wants = [name, *wants]
        counts.append(
            f"SELECT ? AS facet, {value} AS value, count(*) AS times FROM {table} "  # noqa: S608 # constants
            f"WHERE {where} AND {value} IS NOT NULL GROUP BY ALL"
        )
        values += [name, *wants]
    found: Facets = {name: [] for name in names}
    for facet, value, times in cursor.execute(
        f"{' UNION ALL '.join(counts)} ORDER BY ALL", values
    ).fetchall():
        found[facet].append((value, times))
    return found


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
