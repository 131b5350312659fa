"""What is stored, in the words of a page."""

import pytest

from merge_runner_analysis.web.phrases import causes_text


@pytest.mark.parametrize(
    ("causes", "text"),
    [
        ([("plan: no_array", 1)], "1 reply without a valid plan: no plan in the reply"),
        (
            [("model: a → b", 1), ("plan: out_of_range", 1), ("plan: wrong_length", 2)],
            "3 replies without a valid plan: plan out of range, plan of a wrong length; "
            "wrong model: a → b",
        ),
        ([("decision: missing", 3)], "no decision in the reply, 3 times"),
    ],
)
def test_errors_of_a_trial_are_told_in_one_sentence(causes, text):
    assert causes_text(causes) == text
