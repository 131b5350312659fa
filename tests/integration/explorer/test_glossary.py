"""The glossary of the pages is the one of the docs, and none of its marks is left."""

from __future__ import annotations

import re
from html import unescape

import pytest
from starlette.testclient import TestClient

from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.glossary import sections
from merge_runner_analysis.explorer.site import Site
from tests.support.harness import PROJECT

HOST = "127.0.0.1:8700"
ROWS = re.findall(
    r"^\| (.+?) \| (.+) \|$", (PROJECT / "docs/glossary.md").read_text(), re.MULTILINE
)


def test_every_word_of_the_docs_is_on_the_page_once_and_in_their_order():
    terms = [term for term, _ in ROWS if term != "term"]
    assert len(terms) > 70
    assert [term for words in sections().values() for term, _ in words] == terms


@pytest.mark.parametrize("marks", ["**", "](", "`", ".md"])
def test_no_mark_of_the_docs_is_left(marks):
    told = [str(meaning) for words in sections().values() for _, meaning in words]
    assert [text for text in told if marks in text] == []


def test_the_page_says_the_same_as_the_docs(study):
    text = TestClient(explorer(Site(study)), base_url=f"http://{HOST}").get("/glossary").text
    shown = unescape(re.sub(r"<[^>]*>", "", text))
    for _, meaning in ROWS[1:5]:
        plain = re.sub(r" \(\[[^]]+\]\([^)]*\)\)|\*\*|`|\]\([^)]*\)|\[", "", meaning)
        assert plain in shown
    assert "<strong>l</strong>eft one" in text
