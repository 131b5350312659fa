"""The program's tables beside those of the recomputation, for any database.

``python -m analysis.research.independent.compare DB [STUDY]`` prints where.
"""

from __future__ import annotations

import csv
import math
import subprocess
import sys
from itertools import groupby
from pathlib import Path

import numpy as np

from analysis.research.independent import recompute

TABLES = (
    "who-first", "gap", "indicators", "ablation-qualitative", "ablation-quantitative", "contrasts",
    "factors", "verdicts",
)  # fmt: skip
# Columns that are found by iteration; all others follow from closed forms.
# What is projected and not what happened, I5, and what calls came to.
NOT_RECOMPUTED = ("/conflict_resolution_s", "/held", "/valid_percent", "/cost_usd")
ITERATED = {"b", "se", "z", "t", "p", "firth_b", "firth_se", "firth_p", "detectable"}
TESTED = ("verdicts", "contrasts", "factors")  # whose intervals are found by iteration, too


def program_tables(db: Path, *options: str) -> dict[str, dict[str, dict[str, str]]]:
    """The tables as the program prints them: by table, row and column."""
    done = subprocess.run(
        [sys.executable, "-m", "merge_runner", "tables", *TABLES,
         "--format", "csv", "--db", db.name, *options],
        cwd=db.parent, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    tables: dict[str, dict[str, dict[str, str]]] = {}
    for is_name, lines in groupby(done.stdout.splitlines(), lambda line: line.startswith("# ")):
        if is_name:
            name = [*lines][-1].removeprefix("# ")
        else:
            tables[name] = {row["row"]: row for row in csv.DictReader(filter(None, lines))}
    return tables


def p_of_i5(program) -> dict[str, float]:
    """The p of I5, which is not recomputed, by row."""
    rows = program["verdicts"].items()
    return {name: float(row["p"]) for name, row in rows if name.endswith("/held") and row["p"]}


def disagreements(program, recomputed, *, imported: bool):
    """Every row and number in which the program and the recomputation differ."""
    for table, rows in recomputed.items():
        printed = {
            name: row
            for name, row in program[table].items()
            if not _of_paper(table, name, imported) and not name.endswith(NOT_RECOMPUTED)
        }
        yield from (f"{table} {name}: in one alone" for name in printed.keys() ^ rows.keys())
        both = {name: (printed[name], row) for name, row in rows.items() if name in printed}
        for name, (cells, row) in both.items():
            for column, value in row.items():
                iterated = column in ITERATED or table in TESTED
                if column in cells and not _equal(cells[column], value, iterated=iterated):
                    yield f"{table} {name} {column}: {cells[column]}, and {value} recomputed"
            if not row and any(cells[c] for c in ("n", "p", "value", "difference") if c in cells):
                yield f"{table} {name}: judged, and not by the recomputation"


def _of_paper(table: str, row: str, imported: bool) -> bool:
    """Return whether a row is the paper's and not computed."""
    # I5 and the numbers beside it are not recomputed.
    if table == "indicators" and row.rpartition("/")[2].startswith(("I5", "score")):
        return True
    outcomes = table in ("who-first", "verdicts") or row.endswith(("/I1", "/I2"))
    return row.partition("/")[0] == "human" and not outcomes and not imported


def _equal(cell: str, value, *, iterated: bool) -> bool:
    if value is None or cell == "":
        return cell == "" and value is None
    if isinstance(value, str):
        return cell == value
    if isinstance(value, bool | np.bool_):
        return cell == str(bool(value))
    tolerance = 1e-4 if iterated else 1e-6
    return math.isclose(float(cell), float(value), rel_tol=tolerance, abs_tol=1e-9)


def compare(db: Path, study: str = "", *, imported: bool = False) -> list[str]:
    """Return the differences of a database's tables, or of a study's, whose file lies beside it.

    ``imported``: all humans are imported, so that their rows are computed from trials, too.
    """
    options = ["--study", f"{study}.toml"] if study else []
    program = program_tables(db, *options)
    recomputed = recompute.tables(str(db), study, p_of_i5(program))
    return [*disagreements(program, recomputed, imported=imported)]


if __name__ == "__main__":
    print(*compare(Path(sys.argv[1]), *sys.argv[2:3]) or ["no number differs"], sep="\n")
