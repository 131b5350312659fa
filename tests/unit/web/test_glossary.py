"""The glossary of the pages is the one of the docs, and none of its marks is left."""

import re

from merge_runner_analysis.web.glossary import USED, sections, used_terms
from tests.support.harness import PROJECT


def test_every_word_of_the_docs_is_told_once_in_their_order_without_their_marks():
    rows = re.findall(
        r"^\| (.+?) \| (.+) \|$", (PROJECT / "docs/glossary.md").read_text(), re.MULTILINE
    )
    written = {term: meaning for term, meaning in rows if term != "term"}
    told = [word for words in sections().values() for word in words]
    assert 30 < len(told) <= 45
    assert [term for term, _ in told] == [*written]
    for term, meaning in told:
        text = re.sub(r"<[^>]*>", "", str(meaning))
        assert not re.search(r"\*|\]\(|`|\.md", text), term
        assert len(text) <= len(written[term]) + 40, term  # escapes of quotes are longer
    assert "<strong>l</strong>eft vehicle" in "".join(str(meaning) for _, meaning in told)


def test_a_page_explains_the_words_that_it_has_and_no_others():
    shown = used_terms("<p title='the ego'>It left a <b>gap</b> of 3.85 [2.88, 4.82] m.</p>")
    assert [words for words, _ in shown] == ["interval [ ]", "gap at the merge point"]
    every = used_terms(" ".join(pattern.replace("\\b", "") for *_, pattern in USED) + "[")
    assert [words for words, _ in every] == [words for words, *_ in USED]
    assert dict(every)["crash"].startswith("By <strong>people&#39;s rule</strong>: the")
    # Neither columns of tables nor codes of blocks.
    assert not re.search(r"<code>|\bC\d|_", " ".join(meaning for _, meaning in every))
