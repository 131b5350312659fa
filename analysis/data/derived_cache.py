"""Tables and figures that the database keeps beside the results, until these change.

Where the file cannot be written, as on a read-only disk or while another program holds it, nothing
is kept, and the next run computes them again.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path

import duckdb

import analysis
import merge_runner
from merge_runner.errors import StoreError
from merge_runner.registry import in_use, plugin_sources, plugins
from merge_runner.results.database import open_database, read_database
from merge_runner.text_safety import first_line

KEPT = """
-- A table as JSON, or a figure as SVG in Base64, of the results in one state.
CREATE TABLE IF NOT EXISTS finished (
    state VARCHAR NOT NULL,
    options VARCHAR NOT NULL,
    name VARCHAR NOT NULL,
    content VARCHAR NOT NULL
);
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
PACKAGES = (Path(analysis.__file__).parent, Path(merge_runner.__file__).parent)
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


def has(connection: duckdb.DuckDBPyConnection, table: str) -> bool:
    """Whether anything was ever kept in this table."""
    found = connection.execute(
        "SELECT 1 FROM duckdb_tables() WHERE table_name = ? AND database_name = current_database()",
        [table],
    )
    return found.fetchone() is not None


def options_text(
    db: Path,
    models: Sequence[str] | None = None,
    where: Mapping[str, Sequence[str]] | None = None,
    file: str | None = None,
    by: str | None = None,
    without_fallbacks: bool = False,
) -> str:
    """What a table depends on besides the results; the path, since its notes name the database."""
    return json.dumps([str(db), models, where, file, by, without_fallbacks])


def present_state(db: Path) -> str:
    """The state of the results in a database; see ``state``."""
    with read_database(db) as connection:
        return state(connection)


def finished(db: Path, made_of: str, options: str, names: Sequence[str]) -> dict[str, str]:
    """The tables or figures that are kept of this state, by name."""
    with read_database(db) as connection:
        if not has(connection, "finished"):
            return {}
        rows = connection.execute(
            "SELECT name, content FROM finished WHERE state = ? AND options = ? "
            "AND list_contains(?, name)",
            [made_of, options, list(names)],
        ).fetchall()
    return dict(rows)


def keep_finished(db: Path, made_of: str, options: str, contents: dict[str, str]) -> None:
    """Keep tables or figures, unless the results have left the state that these are ``made_of``."""
    try:
        with open_database(db, read_only=False, patience_s=PATIENCE_S) as connection:
            connection.begin()
            connection.execute(KEPT)
            if state(connection) == made_of:
                connection.execute("DELETE FROM finished WHERE state <> ?", [made_of])
                connection.executemany(
                    "INSERT INTO finished VALUES (?, ?, ?, ?)",
                    [[made_of, options, name, content] for name, content in contents.items()],
                )
            connection.commit()
    except (StoreError, duckdb.Error) as exc:
        _say_once(first_line(exc))


@cache
def _say_once(reason: str) -> None:
    LOG.warning("what was computed is not kept for the next time: %s", reason)
