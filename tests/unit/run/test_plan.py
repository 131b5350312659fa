"""Which trials a sweep has, how they are named, and what their hash covers."""

from __future__ import annotations

from itertools import groupby
from pathlib import Path

import pytest

from merge_runner.errors import UsageError
from merge_runner.records import Usage
from merge_runner.run.estimate import estimate
from merge_runner.run.plan import PROGRAMS, USUAL_GRID, Options, grid_conditions, make_plan


def hashes(plan):
    return {spec.variant: spec.spec_hash for spec in plan.trial_specs()}


def test_the_ablations_are_495_trials_as_the_paper_says():
    plan = make_plan("ablations", "emulator")
    specs = plan.trial_specs()
    assert plan.trials == len(specs) == 110 + 7 * 55
    assert len({spec.trial_id for spec in specs}) == 495
    assert sum(spec.variant == "baseline" for spec in specs) == 110
    assert make_plan("ablations", "emulator", repetitions=10).trials == 880


def test_finished_parts_of_a_sweep_are_balanced_over_conditions_and_variants():
    specs = make_plan("ablations", "emulator").trial_specs()
    assert [spec.order for spec in specs] == list(range(495))
    first = specs[:88]
    assert {spec.repetition for spec in first} == {1}
    assert len({(spec.variant, spec.condition) for spec in first}) == 88


def test_ids_are_readable():
    mixed = make_plan("baseline", "o3+constant", repetitions=3, sample_set=1)
    specs = mixed.trial_specs()
    assert "o3+constant/baseline/L_4_8/rep03/set1" in {spec.trial_id for spec in specs}
    assert (specs[0].model_left, specs[0].model_right) == ("o3", "constant")
    assert make_plan("baseline", "o3+o3").model == "o3"


def places(plan):
    """(repetition, variant, condition) of all trials in their order."""
    return [(s.repetition, s.variant, s.condition) for s in plan.trial_specs()]


def test_the_order_is_random_within_a_repetition_and_balanced_over_them():
    plans = [make_plan("ablations", "emulator", order_seed=seed) for seed in (0, 0, 1)]
    first, again, other = map(places, plans)
    assert first == again != other
    assert sorted(first) == sorted(other)
    assert [repetition for repetition, _, _ in first] == sorted(r for r, _, _ in first)
    blocks = [list(block) for _, block in groupby(first, key=lambda cell: cell[0])]
    assert len(blocks) == max(plans[0].repetitions.values())
    # No block begins with the conditions of another one in the same order.
    assert len({tuple(cell[2] for cell in block[:11]) for block in blocks}) == len(blocks)
    assert [plan.model_dump(mode="json")["order_seed"] for plan in plans] == [0, 0, 1]


def test_the_spec_hash_covers_what_determines_a_result_and_nothing_else(tmp_path):
    plan = make_plan("baseline", "emulator")
    base = hashes(plan)["baseline"]
    assert hashes(make_plan("baseline", "emulator", repetitions=2))["baseline"] == base
    assert hashes(make_plan("baseline", "emulator", conditions=["N_0_0"])) == {"baseline": base}
    changed = {
        hashes(make_plan("baseline", "emulator", sample_set=1))["baseline"],
        hashes(plan.model_copy(update={"endpoints": {"emulator": "http://127.0.0.1:1/v1"}}))[
            "baseline"
        ],
        hashes(make_plan("baseline", "emulator+constant"))["baseline"],
        hashes(make_plan("baseline", "constant+emulator"))["baseline"],
        *hashes(make_plan("baseline", "emulator", 1, variants=["A1", "A7"])).values(),
    }
    for key, value in (
        ("collision_rule", '"rectangle"'),
        ("timeout_s", "20.0"),
        ("straight_after", '"both"'),
        ("fallback", '"restart"'),
    ):
        file = tmp_path / f"{key}.toml"
        file.write_text(f"[repetitions]\nbaseline = 1\n[scenario]\n{key} = {value}\n")
        changed.add(hashes(make_plan(str(file), "emulator"))["baseline"])
    assert base not in changed
    assert len(changed) == 10


def test_the_spec_hash_of_the_baseline_is_pinned():
    # It changes only where the prompt, a parameter or a rule changes: then this is the reminder
    # that results of before and after are told apart, and that the recording is made anew.
    assert hashes(make_plan("baseline", "emulator")) == {"baseline": "60fac55280b8ebe3"}


def test_a_program_is_known_by_the_parameters_of_its_rule(monkeypatch):
    plan = make_plan("baseline", "projected-order")
    before = hashes(plan)
    monkeypatch.setitem(PROGRAMS["projected-order"].parameters, "target_gap_m", 5.0)
    assert hashes(plan) != before


def test_what_is_named_twice_is_played_once():
    plan = make_plan("baseline", "constant", conditions=["N_0_0", "N_0_0"])
    assert plan.trials == len(plan.trial_specs()) == 10


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
    plan = make_plan("baseline", "o3")
    expected = estimate(
        plan,
        Options(Path("m.duckdb"), Path("responses"), **limited),
        trials=plan.trials,
        calls={"baseline": {"o3": plan.trials * 21}},
        facts={},
    )
    assert expected.minutes == pytest.approx(minutes, rel=0.08)
    assert expected.calls == 2310
    each = 2310 * (500 * 2 + 1500 * 8) / 1e6
    assert expected.cost_usd == pytest.approx(each, rel=0.05)


def test_the_estimate_is_by_what_was_measured():
    plan = make_plan("ablations", "o3", 2, variants=["baseline", "A1"])
    options = Options(Path("m.duckdb"), Path("responses"), batch=True)
    expected = estimate(
        plan,
        options,
        trials=40,
        calls={"baseline": {"o3": 210.0}, "A1": {"o3": 630.0}},
        facts={"o3": Usage(input_tokens=500, output_tokens=1_500)},
    )
    each = (500 * 2 + 1500 * 8) / 1e6
    assert (expected.trials, expected.calls) == (40, 840)
    assert expected.singly_usd == pytest.approx(840 * each, abs=0.01)
    assert expected.cost_usd == 5.46


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


@pytest.mark.parametrize(
    ("grid", "said"),
    [
        ("h=1:2", "--grid usual"),
        ("x=1", "'x=1' is no axis"),
        ("h=nan", "'h=nan' is no axis"),
        ("h=2:1:1", "'h=2:1:1' is no axis"),
        ("h=0:1:0", "'h=0:1:0' is no axis"),
        ("h=0:1:-1", "'h=0:1:-1' is no axis"),
        ("h=0:9999:0.01", "is no axis of 1 to 100 values"),
        ("h=0,dv=20", "both vehicles must drive forwards"),
    ],
)
def test_a_grid_that_is_none_is_refused_with_what_to_type(grid, said):
    with pytest.raises(UsageError, match=said):
        make_plan("baseline", "emulator", first=True, grid=grid)


@pytest.mark.parametrize("first", [True, False])
def test_a_study_with_a_budget_pays_for_its_situations_from_it(tmp_path, first):
    (tmp_path / "mine.toml").write_text("repetitions = 1\n[budget]\ntotal_usd = 5\n")
    assert make_plan(str(tmp_path / "mine.toml"), "emulator", first=first).ledger == "mine"
