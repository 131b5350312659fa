"""Texts as HTML, in which nothing is hidden and no name is broken."""

import pytest

from merge_runner_analysis.web.display_text import with_whole_names


@pytest.mark.parametrize(
    ("text", "html"),
    [
        ("plain words", "plain words"),
        ("as gpt-4.1-mini says", 'as <span class="nw">gpt-4.1-mini</span> says'),
        ("a - b, -3 and 2-", "a - b, -3 and 2-"),
        ("<b>a-b</b>", '&lt;b&gt;<span class="nw">a-b</span>&lt;/b&gt;'),
        ("o3-\u202eevil", "o3-[U+202E]evil"),
    ],
)
def test_no_line_breaks_within_a_name_and_markup_and_hidden_characters_show(text, html):
    assert with_whole_names(text) == html
