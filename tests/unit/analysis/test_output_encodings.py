"""Results that a terminal or a pipe cannot take in full."""

from __future__ import annotations

import io
import sys

import pytest


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
@pytest.mark.parametrize(
    ("command", "shown"),
    [
        (("tables", "verdicts"), "What drivers show"),
        (("tables", "gap", "--format", "md"), "| driver |"),
        (("sql", "SELECT '× – é' AS sign"), "sign"),
        (("explain", "who-first", "human/intercept"), "who-first human/intercept"),
        (("audit",), "checked"),
        (("--help",), "merge-runner"),
    ],
)
def test_what_an_encoding_cannot_say_is_replaced(
    small, in_process, monkeypatch, encoding, command, shown
):
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding))
    db = () if command == ("--help",) else ("--db", small.db)
    assert in_process(*command, *db) in {0, 1}, "1: the audit finds made trials"
    sys.stdout.flush()
    assert shown in written.getvalue().decode(encoding)
