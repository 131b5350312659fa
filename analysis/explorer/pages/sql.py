"""A query, its result, and what can be asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from analysis.explorer.child import NoAnswer
from analysis.explorer.display_text import visible
from analysis.explorer.examples import EXAMPLES
from analysis.explorer.query_process import DOWNLOADED_ROWS, LONGEST, Result
from analysis.explorer.schema import tables, units
from analysis.explorer.site import Site
from merge_runner.errors import MergeRunnerError

UNANSWERED = (NoAnswer, MergeRunnerError)
NUMBERS = ("TINYINT", "SMALLINT", "INTEGER", "BIGINT", "HUGEINT", "UTINYINT", "USMALLINT",
           "UINTEGER", "UBIGINT", "UHUGEINT", "FLOAT", "DOUBLE", "DECIMAL", "BIGNUM")  # fmt: skip


@dataclass(frozen=True, slots=True)
class Cell:
    """A value as it is shown; no text: NULL. ``left_out`` counts characters."""

    text: str | None
    left_out: int = 0
    link: str = ""


def sql_page(
    site: Site, asked: Mapping[str, str], *, run: bool = True, problem: str | None = None
) -> str:
    """The page of a query, with its result if it is to be run and had no problem before."""
    query = query_in(asked)
    is_asked = bool(query.strip())
    result = None
    if is_asked and run and problem is None:
        try:
            result = site.sandbox.result(query)
        except UNANSWERED as exc:
            problem = str(exc)
    return site.render(
        "sql.html",
        here="sql",
        query=query if is_asked else next(iter(EXAMPLES.values())),
        asked=is_asked,
        run=run,
        hides=visible(query) != query,
        longest=LONGEST,
        examples=EXAMPLES,
        tables=tables(),
        units=units(),
        problem=None if problem is None else visible(problem),
        result=result,
        rows=[] if result is None else _cells(site, result),
        is_number=is_number,
        most=DOWNLOADED_ROWS,
    )


def sql_csv(site: Site, asked: Mapping[str, str]) -> bytes:
    """All that a query finds as CSV; raises what is in UNANSWERED."""
    return site.sandbox.csv(query_in(asked))


def query_in(asked: Mapping[str, str]) -> str:
    """The query in an address; a form ends its lines as the web does."""
    return asked.get("q", "").replace("\r\n", "\n")


def is_number(kind: str) -> bool:
    """Whether values of a type stand to the right."""
    return kind.partition("(")[0] in NUMBERS and not kind.endswith("]")


def _cells(site: Site, result: Result) -> list[list[Cell]]:
    """The rows of a result; a column ``trial_id`` leads to the trials, with the spec beside it."""
    names = [name for name, _ in result.columns]
    spec = names.index("spec_hash") if "spec_hash" in names else None

    def shown(row: list[tuple[str, int] | None], place: int) -> Cell:
        value = row[place]
        if value is None:
            return Cell(None)
        text, left_out = value
        link = ""
        if names[place] == "trial_id" and text and not left_out:
            of_spec = None if spec is None else row[spec]
            link = site.at.trial({"trial_id": text, "spec_hash": of_spec and of_spec[0]})
        return Cell(visible(text), left_out, link)

    return [[shown(row, place) for place in range(len(names))] for row in result.rows]
