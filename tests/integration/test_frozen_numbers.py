"""The numbers of every table, of the shipped recordings and two odd databases, stay what they are.

``python -m tests.integration.test_frozen_numbers --write`` renews them; what is equal but for noise
keeps its digits.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from tests.support.harness import PROGRAM, PROJECT, asked_to_write, environment
from tests.support.odd_databases import made, replayed
from tests.weekly import test_notebooks

NUMBERS = PROJECT / "tests/golden/numbers.json"
RECORDINGS = ("emulator", "smollm2", "smollm2-free")
STUDY = "two_studies, its study"
DATABASES = (*RECORDINGS, "separated", "two_studies", STUDY)
# Iterative fits differ between machines in the last digits that they converge to.
TOLERANCE, NOISE = 1e-6, 1e-9


def tables_of(name: str, folder: Path) -> dict:
    """By table: its columns but texts, and by row their values."""
    db = folder / "merge.duckdb"
    if name in RECORDINGS:
        replayed(db, name)
    else:
        db = made(folder, name.partition(",")[0])
    options = ["--study", "study.toml"] if name == STUDY else []
    done = subprocess.run(
        [PROGRAM, "tables", "--format", "json", "--db", db.name, *options],
        cwd=db.parent, env=environment(), capture_output=True, check=True,
    )  # fmt: skip
    return {table["name"]: _numbers(table) for table in json.loads(done.stdout)["tables"]}


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


def differences(frozen: dict, found: dict):
    """Every table, row and value that is not as it was."""
    for name in frozen.keys() | found.keys():
        before, now = frozen.get(name), found.get(name)
        if before is None or now is None or before["columns"] != now["columns"]:
            yield f"{name}: another table, or other columns"
            continue
        for row in before["rows"].keys() | now["rows"].keys():
            pair = before["rows"].get(row), now["rows"].get(row)
            if None in pair:
                yield f"{name} {row}: {'gone' if pair[1] is None else 'new'}"
                continue
            for column, old, new in zip(now["columns"], *pair, strict=True):
                if not _same(old, new):
                    yield f"{name} {row} {column}: {old}, now {new}"


@pytest.mark.long
@pytest.mark.parametrize("name", DATABASES)
def test_every_number_of_every_table_is_what_it_was(name, tmp_path):
    frozen = json.loads(NUMBERS.read_text())
    assert [*frozen] == [*DATABASES]
    assert sorted(differences(frozen[name], tables_of(name, tmp_path))) == []


def test_a_changed_a_missing_and_a_new_number_are_told():
    frozen = {"gap": {"columns": ["n", "b"], "rows": {"a": [3, 0.5], "b": [4, None]}}}
    near = {"gap": {"columns": ["n", "b"], "rows": {"a": [3, 0.5 + 1e-9], "b": [4, None]}}}
    off = {"gap": {"columns": ["n", "b"], "rows": {"a": [3, 0.50001], "b": [4, 0.0], "c": [1, 1]}}}
    assert [*differences(frozen, near)] == []
    assert sorted(differences(frozen, off)) == [
        "gap a b: 0.5, now 0.50001", "gap b b: None, now 0.0", "gap c: new",
    ]  # fmt: skip


@pytest.mark.parametrize("arguments", [(), ("--help",), ("-h",), ("--w",), ("all",)])
@pytest.mark.parametrize("module", [sys.modules[__name__], test_notebooks])
def test_nothing_is_renewed_that_nobody_asks_for(module, arguments, monkeypatch, capsys):
    for name in ("DATABASES", "NOTEBOOKS"):
        monkeypatch.setattr(module, name, None, raising=False)  # nothing is read, either
    with pytest.raises(SystemExit):
        module.main(*arguments)
    assert "--write" in "".join(capsys.readouterr())


def _kept(frozen: dict, found: dict) -> dict:
    """What was found, with the digits that are frozen where these are the same number."""
    for name, table in found.items():
        before = frozen.get(name, {"columns": [], "rows": {}})
        for row, values in table["rows"].items():
            old = before["rows"].get(row)
            if old is not None and before["columns"] == table["columns"]:
                values[:] = [o if _same(o, v) else v for o, v in zip(old, values, strict=True)]
    return found


def _text(frozen: dict) -> str:
    """As JSON, a row of a table a line."""

    def block(entries, indent):
        space = "\n" + " " * indent
        return "{" + ",".join(f"{space}{json.dumps(k)}: {v}" for k, v in entries) + "}"

    def table(one):
        rows = block([(row, json.dumps(v)) for row, v in one["rows"].items()], 3)
        return f'{{"columns": {json.dumps(one["columns"])}, "rows": {rows}}}'

    return block(
        [(db, block([(n, table(t)) for n, t in of.items()], 2)) for db, of in frozen.items()], 1
    )


def main(*arguments: str) -> None:
    """Write the numbers of today, where that is asked for."""
    asked_to_write(arguments, f"the numbers of every table into {NUMBERS}")
    frozen = json.loads(NUMBERS.read_text()) if NUMBERS.exists() else {}
    found = {}
    for name in DATABASES:
        with TemporaryDirectory() as folder:
            found[name] = _kept(frozen.get(name, {}), tables_of(name, Path(folder)))
    NUMBERS.write_text(_text(found) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
