"""What of a page must not leave this machine."""

import re
import tempfile
from pathlib import Path

import pytest

from merge_runner.errors import UsageError
from merge_runner_analysis.web.leaks import check_leaks
from tests.support.cases import cases

DB = Path("/data/study/t.duckdb")


@pytest.mark.parametrize("case", cases("explorer", "leaks"))
def test_a_key_and_a_path_of_this_machine_are_refused_and_no_key_is_repeated(
    monkeypatch, tmp_path_factory, case
):
    monkeypatch.chdir(cwd := tmp_path_factory.mktemp("here"))
    monkeypatch.setattr(tempfile, "tempdir", "/scratch")
    monkeypatch.setenv("OPENAI_API_KEY", "my-dummy-secret")
    monkeypatch.setenv("MY_PASSWORD", "hunter22")
    said, told = ("".join(case[of]).replace("{cwd}", str(cwd)) for of in ("said", "told"))
    with pytest.raises(UsageError, match=f"a page .*{re.escape(told)}") as refused:
        check_leaks(DB, "a page", f"It said {said} and more")
    assert "names the path" in told or said not in str(refused.value)


def test_words_that_only_look_like_a_secret_are_let_out(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", "short")
    for said in ("a short key", "task-proj-abcdefghijklmnop0123", "sk-8", "see /home and Users"):
        check_leaks(DB, "a page", said)
