"""What of a page must not leave this machine."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import pytest

from merge_runner.errors import UsageError
from merge_runner_analysis.explorer.leaks import refuse_leaks

DB = Path("/data/study/t.duckdb")
BY_PROVIDER = {
    "sk-": "proj-abcdefghijklmnop0123",
    "AIza": "b" * 35,
    "Bearer ": "abcdefgh.ijklmnop",
    **dict.fromkeys(("gho_", "ghp_", "ghs_", "ghu_", "hf_"), "c" * 36),
    "github_pat_": "d" * 30,
    **dict.fromkeys(("xoxa-", "xoxb-", "xoxp-"), "1234567890-abcdef"),
    **dict.fromkeys(("AKIA", "ASIA"), "ABCDEFGHIJKLMNOP"),
}


@pytest.mark.parametrize(
    ("said", "told"),
    [
        *((begin + rest, f"looks like a key: {begin[:6]}") for begin, rest in BY_PROVIDER.items()),
        ("my-dummy-secret", "the value of OPENAI_API_KEY"),
        ("hunter22", "the value of MY_PASSWORD"),
        ("{cwd}/notes.txt", "names the path {cwd}/"),
        ("/scratch/a", "names the path /scratch/"),
        ("/data/study/replies", "names the path /data/study/"),
        ("/home/somebody/notes.txt", "names the path /home/somebody/"),
        ("/Users/somebody/notes.txt", "names the path /Users/somebody/"),
        (r"C:\Users\somebody\a", "names the path C:\\Users\\somebody\\"),
    ],
)
def test_a_key_and_a_path_of_this_machine_are_refused_and_no_key_is_repeated(
    monkeypatch, tmp_path_factory, said, told
):
    monkeypatch.chdir(cwd := tmp_path_factory.mktemp("here"))
    monkeypatch.setattr(tempfile, "tempdir", "/scratch")
    monkeypatch.setenv("OPENAI_API_KEY", "my-dummy-secret")
    monkeypatch.setenv("MY_PASSWORD", "hunter22")
    with pytest.raises(UsageError, match=f"a page .*{re.escape(told.format(cwd=cwd))}") as refused:
        refuse_leaks(DB, "a page", f"It said {said.format(cwd=cwd)} and more")
    assert "names the path" in told or said not in str(refused.value)


def test_words_that_only_look_like_a_secret_are_let_out(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", "short")
    for said in ("a short key", "task-proj-abcdefghijklmnop0123", "sk-8", "see /home and Users"):
        refuse_leaks(DB, "a page", said)
