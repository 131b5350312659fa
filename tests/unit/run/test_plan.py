"""Which trials a sweep has, how they are named, and what their hash covers."""

from itertools import groupby
from pathlib import Path

import pytest

from merge_runner.errors import UsageError
from merge_runner.records import Usage
from merge_runner.run.estimate import estimate
from merge_runner.run.options import Options
from merge_runner.run.plan import make_plan
from merge_runner.run.selection import USUAL_GRID, grid_conditions
from tests.support.cases import cases

PLACES = (Path("m.duckdb"), Path("responses"))
EACH_USD = (500 * 2 + 1500 * 8) / 1e6


def hashes(plan):
    return {spec.variant: spec.spec_hash for spec in plan.trial_specs()}


def test_the_ablations_are_495_trials_as_the_paper_says_and_what_is_named_twice_is_played_once():
    plan = make_plan("ablations", "emulator")
    specs = plan.trial_specs()
    assert plan.trials == len(specs) == 110 + 7 * 55
    assert len({spec.trial_id for spec in specs}) == 495
    assert sum(spec.variant == "baseline" for spec in specs) == 110
    assert make_plan("ablations", "emulator", repetitions=10).trials == 880
    twice = make_plan("baseline", "constant", conditions=["N_0_0", "N_0_0"])
    assert twice.trials == len(twice.trial_specs()) == 10


def test_ids_are_readable_and_a_study_with_a_budget_pays_for_its_situations_from_it(tmp_path):
    mixed = make_plan("baseline", "o3+constant", repetitions=3, sample_set=1)
    specs = mixed.trial_specs()
    assert "o3+constant/baseline/L_4_8/rep03/set1" in {spec.trial_id for spec in specs}
    assert (specs[0].model_left, specs[0].model_right) == ("o3", "constant")
    assert make_plan("baseline", "o3+o3").model == "o3"
    (tmp_path / "mine.toml").write_text("repetitions = 1\n[budget]\ntotal_usd = 5\n")
    for first in (True, False):
        assert make_plan(str(tmp_path / "mine.toml"), "emulator", first=first).ledger == "mine"


def test_the_order_is_random_within_a_repetition_and_balanced_over_them():
    plans = [make_plan("ablations", "emulator", order_seed=seed) for seed in (0, 0, 1)]
    assert [spec.order for spec in plans[0].trial_specs()] == list(range(495))
    first, again, other = (
        [(spec.repetition, spec.variant, spec.condition) for spec in plan.trial_specs()]
        for plan in plans
    )
    assert first == again != other
    assert sorted(first) == sorted(other)
    assert [repetition for repetition, _, _ in first] == sorted(r for r, _, _ in first)
    assert len(set(first[:88])) == 88, "every variant in every condition once"
    blocks = [list(block) for _, block in groupby(first, key=lambda cell: cell[0])]
    assert len(blocks) == max(plans[0].repetitions.values())
    # No block begins with the conditions of another one in the same order.
    assert len({tuple(cell[2] for cell in block[:11]) for block in blocks}) == len(blocks)
    assert [plan.model_dump(mode="json")["order_seed"] for plan in plans] == [0, 0, 1]


def test_the_spec_hash_covers_what_determines_a_result_and_nothing_else(tmp_path):
    plan = make_plan("baseline", "emulator")
    same = (plan, make_plan("baseline", "emulator", 2, conditions=["N_0_0"]))
    # It changes only where the prompt, a parameter or a rule changes: then this is the reminder
    # that results of before and after are told apart, and that the recording is made anew.
    assert [hashes(each) for each in same] == 2 * [{"baseline": "60fac55280b8ebe3"}]
    changed = [
        make_plan("baseline", "emulator", sample_set=1),
        plan.model_copy(update={"endpoints": {"emulator": "http://127.0.0.1:1/v1"}}),
        make_plan("baseline", "emulator+constant"),
        make_plan("baseline", "constant+emulator"),
        make_plan("baseline", "emulator", 1, variants=["A1", "A7"]),
    ]
    for key, value in (
        ("collision_rule", '"rectangle"'),
        ("timeout_s", "20.0"),
        ("straight_after", '"both"'),
        ("fallback", '"restart"'),
    ):
        file = tmp_path / f"{key}.toml"
        file.write_text(f"[repetitions]\nbaseline = 1\n[scenario]\n{key} = {value}\n")
        changed.append(make_plan(str(file), "emulator"))
    assert len({hash_ for each in (plan, *changed) for hash_ in hashes(each).values()}) == 11


@pytest.mark.parametrize(
    ("limited", "minutes"),
    [
        # 110 trials of 21 calls at 100 a minute, the slowest of all bounds.
        ({"rpm": 100, "tpm": 10**9}, 2310 / 100),
        # About 25 of 60 s a call counts with its cap of 16000 tokens, then with 1500.
        ({"tpm": 100_000}, 2310 * (0.026 + 16 * 25 / 60 + 1.5 * 35 / 60) / 100),
        # One trial after the other, each prompt 25 s.
        ({"rpm": 10**6, "tpm": 10**9, "in_flight": 1}, 110 * 10.5 * 25 / 60),
    ],
)
def test_the_estimate_takes_the_limits_into_account(limited, minutes):
    plan, options = make_plan("baseline", "o3"), Options(*PLACES, **limited)
    calls = {"baseline": {"o3": plan.trials * 21}}
    expected = estimate(plan, options, trials=plan.trials, calls=calls, facts={})
    assert (expected.minutes, expected.calls) == (pytest.approx(minutes, rel=0.08), 2310)
    assert expected.cost_usd == pytest.approx(2310 * EACH_USD, rel=0.05)


def test_the_time_is_by_the_latency_that_was_measured():
    plan, options = make_plan("baseline", "o3"), Options(*PLACES, in_flight=1, rpm=10**6, tpm=10**9)
    calls = {"baseline": {"o3": 600.0}}
    expected = estimate(plan, options, trials=60, calls=calls, facts={}, latencies_s={"o3": 2.0})
    assert expected.minutes == 600 * 2 / 60 / 2  # both drivers ask at once


def test_the_estimate_is_by_what_was_measured():
    plan = make_plan("ablations", "o3", 2, variants=["baseline", "A1"])
    calls = {"baseline": {"o3": 210.0}, "A1": {"o3": 630.0}}
    facts = {"o3": Usage(input_tokens=500, output_tokens=1_500)}
    options = Options(*PLACES, batch=True)
    expected = estimate(plan, options, trials=40, calls=calls, facts=facts)
    assert (expected.trials, expected.calls, expected.cost_usd) == (40, 840, 5.46)
    assert expected.singly_usd == pytest.approx(840 * EACH_USD, abs=0.01)


def test_a_grid_has_every_pair_of_its_values_in_decimals():
    assert grid_conditions("h=-4:4:4,dv=-0.8:0.4:0.4") == [
        "R_-4_-8", "h-4_dv-0.4", "R_-4_0", "h-4_dv0.4",
        "L_0_-8", "h0_dv-0.4", "N_0_0", "h0_dv0.4",
        "L_4_-8", "h4_dv-0.4", "L_4_0", "h4_dv0.4",
    ]  # fmt: skip
    assert len(grid_conditions("usual")) == len(grid_conditions(USUAL_GRID)) == 7 * 9
    assert grid_conditions("dv=0") == [
        "h-6_dv0", "R_-4_0", "h-2_dv0", "N_0_0", "h2_dv0", "L_4_0", "h6_dv0",
    ]  # fmt: skip


@pytest.mark.parametrize("case", cases("plans", "grids"))
def test_a_grid_that_is_none_is_refused_with_what_to_type(case):
    with pytest.raises(UsageError, match=case["told"]):
        make_plan("baseline", "emulator", first=True, grid=case["grid"])
