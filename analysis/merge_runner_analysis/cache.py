"""Cache of results: a study's in memory, tables and figures in a file beside the database.

The file keeps a table as JSON, a figure as SVG in Base64, and the digest, until the results change.
Where it cannot be written, as on a read-only disk, nothing is cached, and the next run computes all
again.
"""

from __future__ import annotations

import json
import logging
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from functools import cache, wraps
from importlib.metadata import version
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

import merge_runner
import merge_runner_analysis
from merge_runner.errors import UsageError
from merge_runner.registry import in_use, plugin_sources, plugins

CREATE_TABLE = """
CREATE TABLE IF NOT EXISTS finished (
    state TEXT NOT NULL, options TEXT NOT NULL, name TEXT NOT NULL, content TEXT NOT NULL
)
"""
PACKAGES = (Path(merge_runner_analysis.__file__).parent, Path(merge_runner.__file__).parent)
COMPUTING = {".py", ".sql", ".csv", ".toml"}
PATIENCE_S = 0.5
warn_once = cache(logging.getLogger(__name__).warning)
Owner = TypeVar("Owner")
Others = ParamSpec("Others")
Result = TypeVar("Result")


def stamp_of(db: Path) -> tuple[int, ...]:
    """Return what changes when a database does; raises UsageError where there is none."""
    try:
        stats = [db.stat()]
    except FileNotFoundError:
        raise UsageError(
            f"there is no database {db}; `merge-runner sweep baseline` makes one, --db names "
            "another"
        ) from None
    with suppress(FileNotFoundError):
        stats.append(db.with_name(f"{db.name}.wal").stat())
    return tuple(n for of in stats for n in (of.st_ino, of.st_mtime_ns, of.st_size))


def present_state(db: Path) -> str:
    """Return the state that tables depend on: database, program, study. Raises UsageError."""
    return json.dumps([stamp_of(db), program(), in_use().text, in_use().plugins])


@cache
def program() -> str:
    """Return the versions of package and plug-ins, and the newest time of their files."""
    releases = {point.dist.name: point.dist.version for point in plugins() if point.dist}
    releases["merge-runner"] = version("merge-runner")
    sources = (*PACKAGES, *plugin_sources())
    files = [path for source in sources for path in (source, *source.rglob("*"))]
    times = [path.stat().st_mtime_ns for path in files if path.suffix in COMPUTING]
    return json.dumps([releases, len(times), max(times, default=0)], sort_keys=True)


def finished(db: Path, made_of: str, options: str, names: Sequence[str]) -> dict[str, str]:
    """Return the tables or figures that are cached for this state, by name."""
    if not Path(f"{db}.derived").exists():
        return {}
    query = "SELECT name, content FROM finished WHERE state = ? AND options = ?"
    rows = _run(db, query, [(made_of, options)])
    return {name: content for name, content in rows if name in names}


def cache_finished(db: Path, made_of: str, options: str, contents: Mapping[str, str]) -> None:
    """Keep tables or figures, unless the results have left the state that these are ``made_of``."""
    rows = [(made_of, options, name, content) for name, content in contents.items()]
    if present_state(db) == made_of:
        _run(db, "DELETE FROM finished WHERE state <> ?", [(made_of,)])
        _run(db, "INSERT INTO finished VALUES (?, ?, ?, ?)", rows)


def cached(db: Path, made_of: str, options: str, name: str, make: Callable[[], str]) -> str:
    """Return the cached text of this state under a name; make and cache it if there is none."""
    contents = finished(db, made_of, options, [name])
    if not contents:
        contents = {name: make()}
        cache_finished(db, made_of, options, contents)
    return contents[name]


def digest_of(db: Path, made_of: str) -> str:
    """Return the digest of all results, for which all of them have to be read."""
    # Here, since it imports duckdb, which no cached table needs.
    from merge_runner.results.store import results_digest

    return cached(db, made_of, "", "digest", lambda: results_digest(db)[0])


def _run(db: Path, sql: str, rows: Sequence[tuple[str, ...]]) -> list[tuple[str, str]]:
    """Run a statement for each of these rows, in one transaction; nothing where that fails."""
    try:
        with (
            closing(sqlite3.connect(f"{db}.derived", timeout=PATIENCE_S)) as connection,
            connection,
        ):
            connection.execute(CREATE_TABLE)
            return [result for row in rows for result in connection.execute(sql, row)]
    except sqlite3.Error as exc:
        warn_once("what was computed is not cached for the next time: %s", str(exc))
        return []


def remembered(
    function: Callable[Concatenate[Owner, Others], Result],
) -> Callable[Concatenate[Owner, Others], Result]:
    """Keep a function's results in its first argument: a module's cache would keep every study."""

    @wraps(function)
    def remember(owner: Owner, /, *args: Others.args, **kwargs: Others.kwargs) -> Result:
        results: dict[Any, Result] = vars(owner).setdefault("_remembered", {})
        key = (function, args, *kwargs.items())
        if key not in results:
            results[key] = function(owner, *args, **kwargs)
        return results[key]

    return remember
