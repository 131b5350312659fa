"""The numbers of every table of a database, beside those that are frozen."""

import json
import math
from pathlib import Path

from tests.support import program
from tests.support.harness import PROJECT, environment
from tests.support.odd_databases import made

NUMBERS = PROJECT / "tests/golden/numbers.json"
STUDY = "two_studies, its study"
MORE_DATABASES = ("smollm2", "smollm2-free", "two_studies", STUDY)  # read each week
# Iterative fits differ between machines in the last digits that they converge to.
TOLERANCE, NOISE = 1e-6, 1e-9


def tables_of(name: str, folder: Path) -> dict:
    """By table: its columns but texts, and by row their values."""
    db = made(folder, name.partition(",")[0])
    options = ["--study", "study.toml"] if name == STUDY else []
    tables = ("tables", "--format", "json", "--db", db.name, *options)
    done = program.invoke(tables, cwd=db.parent, env=environment())
    return {table["name"]: _numbers(table) for table in json.loads(done.out)["tables"]}


def _numbers(table: dict) -> dict:
    texts = {c["name"] for c in table["columns"] if c["kind"] == "text"} | {"row", "note"}
    rows = {
        row["row"]: {name: _short(value) for name, value in row.items() if name not in texts}
        for row in table["rows"]
    }
    columns = [*next(iter(rows.values()), {})]
    return {"columns": columns, "rows": {name: [*row.values()] for name, row in rows.items()}}


def _short(value):
    return float(f"{value:.10g}") if isinstance(value, float) else value


def _same(one, other) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=TOLERANCE, abs_tol=NOISE)
    return type(one) is type(other) and one == other


def kept(frozen: dict, found: dict) -> dict:
    """What was found, with the digits that are frozen where these are the same number."""
    for name, table in found.items():
        before = frozen.get(name, {"columns": [], "rows": {}})
        for row, values in table["rows"].items():
            old = before["rows"].get(row)
            if old is not None and before["columns"] == table["columns"]:
                values[:] = [o if _same(o, v) else v for o, v in zip(old, values, strict=True)]
    return found


def check(name: str, folder: Path) -> None:
    """Fail where a number of a database, made in the folder, is not what it was."""
    frozen = json.loads(NUMBERS.read_text())[name]
    assert kept(frozen, tables_of(name, folder)) == frozen
