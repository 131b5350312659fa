"""Each promise in promises.toml is a row of its page, and its tests are there.

``python -m tests.unit.reliability.test_promises --write`` writes the rows of the pages.
"""

import re
import sys
import tomllib
from collections import Counter

from tests.support.harness import PROJECT, asked_to_write

PROMISES = tomllib.loads((PROJECT / "tests/promises.toml").read_text())["promise"]
PAGES = [PROJECT / "SECURITY.md", *sorted((PROJECT / "docs/explanation").glob("*.md"))]
TABLE = re.compile(
    r"(?P<head><!-- (?P<name>\w+): from tests/promises.toml -->\n\n\|.*\n\|.*\n)(?:\|.*\n)*"
)


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


def test_the_pages_have_the_rows_of_the_promises_and_no_others():
    texts = [page.read_text() for page in PAGES]
    assert [_with_rows(text) for text in texts] == texts
    tables = [match["name"] for text in texts for match in TABLE.finditer(text)]
    assert sorted(tables) == sorted({promise["table"] for promise in PROMISES})


def _with_rows(page: str) -> str:
    """A page whose tables of promises are written anew."""

    def table(match: re.Match[str]) -> str:
        rows = (promise["row"] for promise in PROMISES if promise["table"] == match["name"])
        return match["head"] + "".join(f"| {row} |\n" for row in rows)

    return TABLE.sub(table, page)


def main(*arguments: str) -> None:
    asked_to_write(arguments, "the rows of SECURITY.md and docs/explanation anew")
    for page in PAGES:
        page.write_text(_with_rows(page.read_text()))


if __name__ == "__main__":
    main(*sys.argv[1:])
