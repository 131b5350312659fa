"""Each promise in promises.toml is a row of docs/promises.md, and its tests are there.

``python -m tests.unit.reliability.test_promises --write`` writes the page.
"""

import re
import sys
import tomllib
from collections import Counter

from tests.support.harness import PROJECT, asked_to_write

FILE = tomllib.loads((PROJECT / "tests/promises.toml").read_text())
PROMISES, TABLES = FILE["promise"], FILE["table"]
PAGE = PROJECT / "docs/promises.md"
HEAD = """\
# Promises

Generated from `tests/promises.toml`, which names the tests of each promise.
[Reliability](reliability.md), [SECURITY.md](../SECURITY.md) and [cluster](cluster.md) explain them.
"""


def test_every_promise_has_its_tests():
    defined = Counter(
        name
        for file in (PROJECT / "tests").rglob("test_*.py")
        for name in re.findall(r"^(?:async )?def (test_\w+)", file.read_text(), re.MULTILINE)
    )
    assert all(promise["tests"] for promise in PROMISES)
    named = {name for promise in PROMISES for name in promise["tests"]}
    assert {name for name in named if defined[name] != 1} == set()
    assert len({promise["id"] for promise in PROMISES}) == len(PROMISES)
    assert {promise["table"] for promise in PROMISES} == TABLES.keys()


def test_the_page_has_the_rows_of_the_promises_and_no_others():
    assert PAGE.read_text() == _page()
    for name, table in TABLES.items():
        for promise in PROMISES:
            if promise["table"] == name:
                assert promise["row"].count(" | ") == len(table["columns"]) - 1, promise["id"]


def _page() -> str:
    parts = [HEAD]
    for name, table in TABLES.items():
        columns = table["columns"]
        parts += [f"\n## {table['title']}\n\n| {' | '.join(columns)} |\n{'|---' * len(columns)}|\n"]
        parts += [f"| {each['row']} |\n" for each in PROMISES if each["table"] == name]
    return "".join(parts)


def main(*arguments: str) -> None:
    asked_to_write(arguments, "docs/promises.md anew")
    PAGE.write_text(_page())


if __name__ == "__main__":
    main(*sys.argv[1:])
