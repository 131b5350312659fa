"""Tables as the report shows them."""

import pytest

from merge_runner_analysis.web.report import _without_constant


@pytest.mark.parametrize(
    ("prompts", "places", "heading"),
    [
        (["", "Baseline", "Baseline"], [0], "Gaps; prompt: Baseline"),
        (["", "Baseline", "A1"], [0, 1], "Gaps"),
        (["Baseline"], [0, 1], "Gaps"),
        (["", ""], [0, 1], "Gaps"),
    ],
)
def test_a_prompt_that_all_rows_have_is_said_in_the_heading_alone(prompts, places, heading):
    rows = [{"cells": [{"text": "o3"}, {"text": prompt}]} for prompt in prompts]
    view = {"heading": "Gaps", "columns": [{"heading": "driver"}, {"heading": "prompt"}]}
    shown = _without_constant(view | {"rows": rows})
    assert (shown["places"], shown["heading"]) == (places, heading)
