from __future__ import annotations

import math
import re
from collections import Counter

import pytest

from merge_runner.emulator.faults import (
    FAULTS,
    TRANSIENT,
    BatchPlan,
    FaultPlan,
    load_faults,
    transient_faults,
)
from merge_runner.errors import UsageError
from tests.harness import PROJECT

DRAWS = 5000


def drawn(plan, draws=DRAWS):
    return Counter(plan.fault(f"request {n // 5}", 1 + n % 5) for n in range(draws))


def load(tmp_path, text):
    path = tmp_path / "faults.toml"
    path.write_text(text)
    return load_faults(path)


def test_a_fault_is_a_function_of_seed_request_and_attempt():
    def faults(seed=0, where="request", attempt=0):
        plan = transient_faults(0.5, seed)
        return [plan.fault(f"{where} {n}", attempt) for n in range(100)]

    assert faults() == faults()
    assert (
        len({tuple(f) for f in (faults(), faults(1), faults(0, "other"), faults(0, "request", 1))})
        == 4
    )


def test_each_fault_occurs_at_its_rate():
    rates = {"rate_limit": 0.1, "hang": 0.04, "reset": 0.3, "refused": 0.02, "malformed": 0.2}
    counts = drawn(FaultPlan(seed=7, rates=rates))
    assert set(counts) == {*rates, None}
    for fault, rate in {**rates, None: 1 - sum(rates.values())}.items():
        standard_error = math.sqrt(rate * (1 - rate) / DRAWS)
        assert abs(counts[fault] / DRAWS - rate) < 4 * standard_error


@pytest.mark.parametrize("rate", [0.0, 0.05, 0.5, 1.0])
def test_transient_faults_add_up_to_the_rate_in_equal_parts(rate):
    plan = transient_faults(rate, seed=3)
    assert plan.seed == 3
    assert sum(plan.rates.values()) == pytest.approx(rate)
    assert set(plan.rates) == set(TRANSIENT)
    assert len(set(plan.rates.values())) == 1


def test_a_rate_limit_asks_to_wait_about_the_delay():
    plan = FaultPlan(seed=1, delay_s=4.0)
    waits = [plan.wait_s("request", attempt) for attempt in range(1000)]
    assert waits == [plan.wait_s("request", attempt) for attempt in range(1000)]
    assert 2 <= min(waits) < 2.1
    assert 5.9 < max(waits) <= 6
    assert waits[:9] != [plan.wait_s("other", attempt) for attempt in range(9)]
    assert waits[:9] != [FaultPlan(delay_s=4.0).wait_s("request", attempt) for attempt in range(9)]


@pytest.mark.parametrize("rate", [-0.1, 1.01, math.nan, math.inf])
def test_a_rate_that_is_no_probability_is_refused(rate):
    with pytest.raises(UsageError, match="between 0 and 1"):
        transient_faults(rate, seed=0)


def test_a_file_sets_every_part_of_a_plan(tmp_path):
    plan = load(
        tmp_path,
        "seed = 3\nlatency_s = 0.5\ndelay_s = 2\nhang_s = 7\n[rates]\nreset = 0.25\nempty = 0.1\n",
    )
    assert plan == FaultPlan(
        seed=3,
        rates={"reset": 0.25, "empty": 0.1},
        latency_s=0.5,
        delay_s=2,
        hang_s=7,
    )


def test_the_files_of_the_docs_are_such_and_have_every_fault(tmp_path):
    page = (PROJECT / "docs/reference/emulator.md").read_text(encoding="utf-8")
    example, batches = re.findall(r"^```toml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert set(load(tmp_path, example).rates) == set(FAULTS)
    assert load(tmp_path, batches).batch.model_fields_set == set(BatchPlan.model_fields)


def test_an_unknown_fault_is_refused_with_the_valid_ones(tmp_path):
    with pytest.raises(UsageError, match="resett") as refusal:
        load(tmp_path, "[rates]\nresett = 0.1\n")
    assert all(fault in str(refusal.value) for fault in FAULTS)


def test_faults_that_change_outcomes_are_told_apart_from_those_that_pass():
    plans = [
        FaultPlan(),
        FaultPlan(rates={"refused": 0.1}),
        FaultPlan(rates={"refused": 0.2}),
        FaultPlan(rates={"refused": 0.1}, seed=1),
        FaultPlan(rates={"refused": 0.1, "empty": 0.1}),
    ]
    assert len({plan.identity for plan in plans}) == len(plans)
    passing = FaultPlan(rates={"refused": 0.0, "reset": 0.5}, seed=1)
    assert plans[0].identity == passing.identity == ""


@pytest.mark.parametrize(
    "text",
    [
        "[rates]\nreset = 1.5\n",
        "[rates]\nreset = nan\n",
        "rates = 0.5\n",
        "latency_s = -1\n",
        "[rates\n",
    ],
)
def test_a_bad_file_is_refused_by_name(tmp_path, text):
    with pytest.raises(UsageError, match=r"faults\.toml"):
        load(tmp_path, text)


def test_rates_that_add_up_to_more_than_one_are_refused(tmp_path):
    # One fault at most occurs per attempt, so such rates could not be kept.
    with pytest.raises(UsageError, match=r"faults\.toml: .*rates"):
        load(tmp_path, "[rates]\nreset = 0.8\nhang = 0.8\n")


def test_a_missing_file_is_refused_by_name(tmp_path):
    with pytest.raises(UsageError, match=r"nowhere\.toml"):
        load_faults(tmp_path / "nowhere.toml")


def test_the_file_also_says_what_becomes_of_batches(tmp_path):
    loaded = load(tmp_path, "[batch]\nfailed = 0.1\nenqueued_tokens = 9000\n")
    assert loaded == FaultPlan(batch=BatchPlan(failed=0.1, enqueued_tokens=9000))
    # The replies are those of an emulator without faults.
    assert loaded.identity == ""
    with pytest.raises(UsageError, match=r"'batch\.fails'; valid: delay_s, polls, slow, .*lost"):
        load(tmp_path, "[batch]\nfails = 0.1\n")
