"""Tables and figures that a file beside the database keeps until the results change.

A table is kept as JSON, a figure as SVG in Base64. Where the file cannot be written, as on a
read-only disk, nothing is kept, and the next run computes them again.
"""

from __future__ import annotations

import hashlib
import json
import logging
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from functools import cache
from importlib.metadata import version
from pathlib import Path

import duckdb

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
LIBRARIES = (
    "duckdb",
    "jinja2",
    "matplotlib",
    "numpy",
    "pandas",
    "scipy",
    "statsmodels",
)
PACKAGES = (Path(merge_runner_analysis.__file__).parent, Path(merge_runner.__file__).parent)
PATIENCE_S = 0.5
LOG = logging.getLogger(__name__)


@cache
def program() -> str:
    """A hash of all that computes: our code, the published values, the libraries, the plug-ins.

    Those of a study are not among them.
    """
    digest = hashlib.sha256()
    for name in LIBRARIES:
        digest.update(f"{name} {version(name)}\n".encode())
    for point in plugins():
        release = f"{point.dist.name} {point.dist.version}" if point.dist else "of no distribution"
        digest.update(f"{release} {point.name} = {point.value}\n".encode())
    for source in (*PACKAGES, *plugin_sources()):
        for path in sorted(source.rglob("*")) if source.is_dir() else [source]:
            if path.suffix in {".py", ".sql", ".csv", ".html"}:
                digest.update(f"{path.relative_to(source)}\n".encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()


def state(connection: duckdb.DuckDBPyConnection) -> str:
    """A hash of all that the tables of the open database depend on: its rows and the program."""
    # A sum of hashes does not depend on the order of rows, which DuckDB does not promise.
    sums = connection.execute(
        " UNION ALL ".join(
            f"SELECT '{name}', count(*), sum(hash(hash(one))::HUGEINT) FROM {rows} AS one"  # noqa: S608 # constants
            for name, rows in ROWS.items()
        )
    ).fetchall()
    study = json.dumps([in_use().text, in_use().plugins])
    return hashlib.sha256(f"{program()} {study}{sorted(sums)}".encode()).hexdigest()


def options_text(
    db: Path,
    models: Sequence[str] | None = None,
    where: Mapping[str, Sequence[str]] | None = None,
    file: str | None = None,
    by: str | None = None,
    without_fallbacks: bool = False,
    sweep: str = "",
    condition: str = "",
) -> str:
    """What a table depends on besides the results; the path, since its notes name the database."""
    return json.dumps([str(db), models, where, file, by, without_fallbacks, sweep, condition])


def present_state(db: Path) -> str:
    """The state of the results in a database; see ``state``."""
    with read_database(db) as connection:
        return state(connection)


def finished(db: Path, made_of: str, options: str, names: Sequence[str]) -> dict[str, str]:
    """The tables or figures that are kept of this state, by name."""
    if not _beside(db).exists():
        return {}
    query = "SELECT name, content FROM finished WHERE state = ? AND options = ?"
    try:
        with _opened(db) as kept:
            rows = kept.execute(query, [made_of, options])
            return {name: content for name, content in rows if name in names}
    except sqlite3.Error as exc:
        _say_once(str(exc))
        return {}


def keep_finished(db: Path, made_of: str, options: str, contents: Mapping[str, str]) -> None:
    """Keep tables or figures, unless the results have left the state that these are ``made_of``."""
    if present_state(db) != made_of:
        return
    rows = [(made_of, options, name, content) for name, content in contents.items()]
    try:
        with _opened(db) as kept:
            kept.execute("DELETE FROM finished WHERE state <> ?", [made_of])
            kept.executemany("INSERT INTO finished VALUES (?, ?, ?, ?)", rows)
    except sqlite3.Error as exc:
        _say_once(str(exc))


def _beside(db: Path) -> Path:
    return db.with_name(f"{db.name}.derived")


@contextmanager
def _opened(db: Path) -> Iterator[sqlite3.Connection]:
    """Open the file for one transaction; raises sqlite3.Error."""
    with closing(sqlite3.connect(_beside(db), timeout=PATIENCE_S)) as kept, kept:
        kept.execute(KEPT)
        yield kept


@cache
def _say_once(reason: str) -> None:
    LOG.warning("what was computed is not kept for the next time: %s", reason)
