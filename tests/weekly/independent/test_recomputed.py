"""The program's tables are those that independent code makes of the same database."""

from __future__ import annotations

import ast
import csv
import math
import subprocess
from itertools import groupby
from pathlib import Path

import numpy as np
import pytest

from tests.support.harness import PROGRAM, environment
from tests.support.odd_databases import made, replayed
from tests.weekly.independent import recompute
from tests.weekly.independent.recompute_trials import overlap

ALLOWED = {"__future__", "json", "numpy", "scipy", "statsmodels", "pandas", "duckdb"}
OWN = "tests.weekly.independent"
TABLES = (
    "who-first", "gap", "indicators", "ablation-qualitative", "ablation-quantitative", "contrasts",
    "factors", "verdicts",
)  # fmt: skip
# Columns that are found by iteration; all others follow from closed forms.
# What is projected and not what happened, and I5.
NOT_RECOMPUTED = ("/conflict_resolution_s", "/held")
ITERATED = {"b", "se", "z", "t", "p", "firth_b", "firth_se", "firth_p", "detectable"}
TESTED = ("verdicts", "contrasts", "factors")  # whose intervals are found by iteration, too
RECORDINGS = ("emulator", "smollm2", "smollm2-free")
KINDS = (
    "two_studies", "crossed_programs", "mirrored_chance", "no_valid_reply", "separated", "all_tied",
    "complete_import",
)  # fmt: skip


def test_the_recomputation_imports_nothing_of_the_project():
    files = sorted(Path(__file__).parent.glob("recompute*.py"))
    assert len(files) == 4
    for file in files:
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [f"{node.module}.{a.name}" if node.module == OWN else node.module
                         for a in node.names]  # fmt: skip
            else:
                continue
            for name in names:
                own = name.startswith(f"{OWN}.recompute")
                assert own or name.partition(".")[0] in ALLOWED, (file.name, name)


@pytest.mark.parametrize(
    ("left", "low", "high"),
    [(91, 90.61, 95.51), (95, 90.61, 99.64), (97, 92.45, 101.60), (102, 97.39, 106.49)],
)
def test_its_boxes_overlap_where_those_of_the_human_experiment_did(left, low, high):
    assert [overlap(left, low + at) for at in (-0.01, 0.01)] == [False, True]
    assert [overlap(left, high + at) for at in (-0.01, 0.01)] == [True, False]


def program_tables(db: Path, *options: str) -> dict[str, dict[str, dict[str, str]]]:
    """The tables as the program prints them: by table, row and column."""
    done = subprocess.run(
        [PROGRAM, "tables", *TABLES, "--format", "csv", "--db", db.name, *options],
        cwd=db.parent, env=environment(), capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found: dict[str, dict[str, dict[str, str]]] = {}
    for is_name, lines in groupby(done.stdout.splitlines(), lambda line: line.startswith("# ")):
        if is_name:
            name = [*lines][-1].removeprefix("# ")
        else:
            found[name] = {row["row"]: row for row in csv.DictReader(filter(None, lines))}
    return found


def held(program) -> dict[str, float]:
    """The p of I5, which is not recomputed, by row."""
    rows = program["verdicts"].items()
    return {name: float(row["p"]) for name, row in rows if name.endswith("/held") and row["p"]}


def disagreements(program, own, *, imported: bool):
    """Every row and number in which the program and the recomputation differ."""
    for table, rows in own.items():
        printed = {
            name: row
            for name, row in program[table].items()
            if not _of_paper(table, name, imported) and not name.endswith(NOT_RECOMPUTED)
        }
        yield from (f"{table} {name}: in one alone" for name in printed.keys() ^ rows.keys())
        both = {name: (printed[name], row) for name, row in rows.items() if name in printed}
        recompute.correct(rows)
        for name, (said, row) in both.items():
            for column, value in row.items():
                iterated = column in ITERATED or table in TESTED
                if column in said and not _equal(said[column], value, iterated=iterated):
                    yield f"{table} {name} {column}: {said[column]}, and {value} recomputed"
            if not row and any(said[c] for c in ("n", "p", "value", "difference") if c in said):
                yield f"{table} {name}: judged, and not by the recomputation"


def _of_paper(table: str, row: str, imported: bool) -> bool:
    """Whether a row holds what the paper prints, and is not computed."""
    # I5 and the numbers beside it are not recomputed.
    if table == "indicators" and row.rpartition("/")[2].startswith(("I5", "score")):
        return True
    outcomes = table in ("who-first", "verdicts") or row.endswith(("/I1", "/I2"))
    return row.partition("/")[0] == "human" and not outcomes and not imported


def _equal(said: str, value, *, iterated: bool) -> bool:
    if value is None or said == "":
        return said == "" and value is None
    if isinstance(value, str):
        return said == value
    if isinstance(value, bool | np.bool_):
        return said == str(bool(value))
    tolerance = 1e-4 if iterated else 1e-6
    return math.isclose(float(said), float(value), rel_tol=tolerance, abs_tol=1e-9)


def test_a_number_that_differs_or_is_in_one_alone_is_told():
    own = {"gap": {"a/baseline/x": {"n": 3, "se": 0.5, "hc3_se": None}, "b/baseline/x": {}}}
    same = {"n": "3", "se": "0.50000001", "hc3_se": ""}
    for said, expected in [
        (same, []),
        (same | {"se": "0.5002"}, ["gap a/baseline/x se: 0.5002, and 0.5 recomputed"]),
        (same | {"hc3_se": "1"}, ["gap a/baseline/x hc3_se: 1, and None recomputed"]),
    ]:
        program = {"gap": {"a/baseline/x": said, "b/baseline/x": dict.fromkeys(same, "")}}
        assert [*disagreements(program, own, imported=False)] == expected
    program["gap"] |= {"a/baseline/x": same, "b/baseline/x": same, "c": same}
    assert [*disagreements(program, own, imported=False)] == [
        "gap c: in one alone",
        "gap b/baseline/x: judged, and not by the recomputation",
    ]


@pytest.fixture(params=[*RECORDINGS, *KINDS])
def database(request, tmp_path):
    if request.param in KINDS:
        return made(tmp_path, request.param)
    db = tmp_path / "merge.duckdb"
    replayed(db, request.param)
    return db


@pytest.mark.long
def test_independent_code_finds_the_numbers_of_the_tables(database):
    imported = database.parent.name == "complete_import"
    program = program_tables(database)
    own = recompute.tables(str(database), held=held(program))
    assert [*disagreements(program, own, imported=imported)] == []
    if (study := database.with_name("study.toml")).exists():
        program = program_tables(database, "--study", study.name)
        own = recompute.tables(str(database), study.stem, held(program))
        assert [*disagreements(program, own, imported=False)] == []
