"""The reliability page and SECURITY.md name a test for each promise, scaling.md for most."""

from __future__ import annotations

import re
from collections import Counter

from tests.harness import PROJECT


def test_every_promise_has_its_test():
    text = (PROJECT / "docs/explanation/reliability.md").read_text()
    others = [
        (PROJECT / page).read_text() for page in ("docs/explanation/scaling.md", "SECURITY.md")
    ]
    named = set(re.findall(r"`(test_\w+)`", "".join([text, *others])))
    defined = Counter(
        name
        for file in (PROJECT / "tests").rglob("test_*.py")
        for name in re.findall(r"^(?:async )?def (test_\w+)", file.read_text(), re.MULTILINE)
    )
    assert {name for name in named if defined[name] != 1} == set()
    rows = [row for row in text.splitlines() if row.startswith("| ") and "|---" not in row]
    headings = [row for row in rows if row.endswith("| test |")]
    assert all("`test_" in row for row in rows if row not in headings)
    assert len(rows) > 30
