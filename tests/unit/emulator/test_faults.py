from __future__ import annotations

import math
from collections import Counter

from tests.support.mock_server import FaultPlan, transient_faults

DRAWS = 5000


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
    plan = FaultPlan(seed=7, rates=rates)
    counts = Counter(plan.fault(f"request {n // 5}", 1 + n % 5) for n in range(DRAWS))
    assert set(counts) == {*rates, None}
    for fault, rate in {**rates, None: 1 - sum(rates.values())}.items():
        standard_error = math.sqrt(rate * (1 - rate) / DRAWS)
        assert abs(counts[fault] / DRAWS - rate) < 4 * standard_error
