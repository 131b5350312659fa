"""The page of the tables lists every table, view and column with its comment in the database.

``python -m tests.integration.results.test_tables_page --write`` writes the lists of the page.
"""

import sys

from merge_runner.results.export import tables
from tests.support.harness import PROJECT, asked_to_write

PAGE = PROJECT / "docs/tables.md"
MARK = "<!-- from schema.sql and measures.sql: test_tables_page.py --write -->\n"


def test_the_page_lists_the_tables_of_a_database():
    text = PAGE.read_text(encoding="utf-8")
    assert text == _with_lists(text)


def _with_lists(page: str) -> str:
    """Return the page with its lists of columns written anew.

    A meaning that an earlier table has for a column of the same name is a reference to that table.
    """
    head, mark, _ = page.partition(MARK)
    first: dict[tuple[str, str], str] = {}
    lines = []
    for table in tables():
        lines += ["", f"## {table.name}", "", table.comment + (" A view." if table.is_view else "")]
        lines += ["", "| column | type | meaning |", "|---|---|---|"]
        for column in table.columns:
            meaning = column.comment.replace("|", "\\|")
            where = first.setdefault((column.name, meaning), table.name)
            if where != table.name:
                meaning = f"as in `{where}`"
            lines.append(f"| `{column.name}` | {column.kind} | {meaning} |")
    return head + mark + "\n".join(lines) + "\n"


def main(*arguments: str) -> None:
    asked_to_write(arguments, f"the lists of {PAGE.name} anew")
    PAGE.write_text(_with_lists(PAGE.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
