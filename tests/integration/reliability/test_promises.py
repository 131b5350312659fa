"""Each promise in promises.toml is a row of its page, and its tests are there."""

from __future__ import annotations

import re
import tomllib
from collections import Counter

import pytest

from tests.support.harness import PROJECT

PROMISES = tomllib.loads((PROJECT / "tests/promises.toml").read_text())["promise"]


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


@pytest.mark.parametrize("page", sorted({promise["page"] for promise in PROMISES}))
def test_a_page_promises_what_the_tests_hold(page):
    rows, subject = set(), ""
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", (PROJECT / page).read_text())
    for row in re.findall(r"^\|(.*)\|$", text, re.MULTILINE):
        first, *rest = (cell.strip() for cell in row.split(" | "))
        subject = first or subject  # an empty cell stands for the one above
        rows.add(": ".join([subject, *rest]))
    assert {promise["sentence"] for promise in PROMISES if promise["page"] == page} <= rows
