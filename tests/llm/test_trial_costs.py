"""What a trial is expected to cost, as answers come in."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from merge_runner.llm.budget import MARGIN, TrialCalls, TrialCosts

CALLS = TrialCalls(usual=20, most=60, worst_usd=1.0)


def trial_costs():
    return TrialCosts(lambda _: {"o3": CALLS})


def test_before_any_answer_a_trial_is_expected_to_cost_as_much_as_it_can():
    assert trial_costs().usd(1) == 60.0


def test_many_answers_tell_the_cost_but_for_the_margin_and_one_worst_case():
    costs = trial_costs()
    costs.count("o3", 500.0, 5_000)
    assert costs.usd(1) == pytest.approx(MARGIN * 20 * 0.1 + 1.0, rel=0.01)


def test_one_cheap_answer_proves_little():
    costs = trial_costs()
    costs.count("o3", 0.0)
    assert costs.usd(1) == pytest.approx(MARGIN * 20 * 0.5 + 1.0)


@given(st.lists(st.floats(0, 1), max_size=40))
def test_no_trial_is_expected_to_cost_more_than_it_can_or_less_than_one_call(answers):
    costs = trial_costs()
    for usd in answers:
        costs.count("o3", usd)
    assert CALLS.worst_usd <= costs.usd(1) <= CALLS.most * CALLS.worst_usd
