"""Tables and figures that a file beside the database keeps until the results change.

A table is kept as JSON, a figure as SVG in Base64. Where the file cannot be written, as on a
read-only disk, nothing is kept, and the next run computes them again.
"""

from __future__ import annotations

import hashlib
import json
import logging
import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from functools import cache
from importlib.metadata import version
from pathlib import Path

import merge_runner
import merge_runner_analysis
from merge_runner.registry import in_use, plugin_sources, plugins
from merge_runner.results.database import read_database

KEPT = """
CREATE TABLE IF NOT EXISTS finished (
    state TEXT NOT NULL, options TEXT NOT NULL, name TEXT NOT NULL, content TEXT NOT NULL
)
"""
# What tables are made of: all but prompts, texts, requests and replies.
ROWS = {
    "trials": "trials",
    "trial_factors": "trial_factors",
    "states": "states",
    "decisions": "(FROM decisions SELECT * EXCLUDE (prompt, rationale))",
    "calls": "(FROM calls SELECT * EXCLUDE (request, reply, error))",
    "specs": "specs",
    "sweeps": "sweeps",
    "sweep_trials": "sweep_trials",
    "views": "(FROM duckdb_views() SELECT sql WHERE database_name = current_database())",
}
LIBRARIES = ("duckdb", "jinja2", "matplotlib", "numpy", "pandas", "scipy", "statsmodels")
PACKAGES = (Path(merge_runner_analysis.__file__).parent, Path(merge_runner.__file__).parent)
PATIENCE_S = 0.5
LOG = logging.getLogger(__name__)


@cache
def program() -> str:
    """A hash of all that computes: our code, the published values, the libraries, the plug-ins.

    Those of a study are not among them.
    """
    known = [f"{name} {version(name)}" for name in LIBRARIES]
    for point in plugins():
        release = f"{point.dist.name} {point.dist.version}" if point.dist else "of no distribution"
        known.append(f"{release} {point.name} = {point.value}")
    sources = [
        path
        for source in (*PACKAGES, *plugin_sources())
        for path in (sorted(source.rglob("*")) if source.is_dir() else [source])
        if path.suffix in {".py", ".sql", ".csv", ".html"}
    ]
    known += [f"{path.name} {hashlib.sha256(path.read_bytes()).hexdigest()}" for path in sources]
    return hashlib.sha256("\n".join(known).encode()).hexdigest()


def present_state(db: Path) -> str:
    """A hash of all that the tables of a database depend on: its rows and the program."""
    # A sum of hashes does not depend on the order of rows, which DuckDB does not promise.
    sums = " UNION ALL ".join(
        f"SELECT '{name}', count(*), sum(hash(hash(one))::HUGEINT) FROM {rows} AS one"  # noqa: S608 # constants
        for name, rows in ROWS.items()
    )
    with read_database(db) as connection:
        found = sorted(connection.execute(sums).fetchall())
    study = json.dumps([in_use().text, in_use().plugins])
    return hashlib.sha256(f"{program()} {study}{found}".encode()).hexdigest()


def options_text(db: Path, **options: object) -> str:
    """What a table depends on besides the results, as the options of a Study say it.

    The path is among it, since notes name the database.
    """
    given = {name: value for name, value in options.items() if value not in (None, False, "", {})}
    return json.dumps([str(db), given], sort_keys=True)


def finished(db: Path, made_of: str, options: str, names: Sequence[str]) -> dict[str, str]:
    """The tables or figures that are kept of this state, by name."""
    if not Path(f"{db}.derived").exists():
        return {}
    query = "SELECT name, content FROM finished WHERE state = ? AND options = ?"
    rows = _run(db, query, [(made_of, options)])
    return {name: content for name, content in rows if name in names}


def keep_finished(db: Path, made_of: str, options: str, contents: Mapping[str, str]) -> None:
    """Keep tables or figures, unless the results have left the state that these are ``made_of``."""
    rows = [(made_of, options, name, content) for name, content in contents.items()]
    if present_state(db) == made_of:
        _run(db, "DELETE FROM finished WHERE state <> ?", [(made_of,)])
        _run(db, "INSERT INTO finished VALUES (?, ?, ?, ?)", rows)


def _run(db: Path, sql: str, rows: Sequence[tuple[str, ...]]) -> list[tuple[str, str]]:
    """Run a statement for each of these rows, in one transaction; nothing where that fails."""
    try:
        with closing(sqlite3.connect(f"{db}.derived", timeout=PATIENCE_S)) as kept, kept:
            kept.execute(KEPT)
            return [found for row in rows for found in kept.execute(sql, row)]
    except sqlite3.Error as exc:
        say_once(str(exc))
        return []


@cache
def say_once(reason: str) -> None:
    """Log, once for each reason, that nothing is kept."""
    LOG.warning("what was computed is not kept for the next time: %s", reason)
