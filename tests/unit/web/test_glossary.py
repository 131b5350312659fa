"""The glossary of the pages is the one of the docs, and none of its marks is left."""

import re

from merge_runner_analysis.web.glossary import sections
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
        assert not re.search(r"\*\*|\]\(|`|\.md", text), term
        assert len(text) <= len(written[term]) + 40, term  # escapes of quotes are longer
    assert "<strong>l</strong>eft vehicle" in "".join(str(meaning) for _, meaning in told)
