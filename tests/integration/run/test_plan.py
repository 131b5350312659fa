"""Which trials a sweep has, how they are named, and what their hash covers."""

from __future__ import annotations

from itertools import groupby
from pathlib import Path

import pytest

from merge_runner.errors import UsageError
from merge_runner.records import Usage
from merge_runner.run.estimate import estimate
from merge_runner.run.plan import PROGRAMS, Options, make_plan


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


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[repetitions]\nA9 = 1", "unknown variant 'A9'; valid: baseline, A1"),
        ("[repetitions]\nbaseline = 0", "repetitions.baseline"),
        ("[repetitions]\nbaseline = 1.5", "repetitions.baseline"),
        ("[repetitions]", "has no variant"),
        ("conditions = []\n[repetitions]\nbaseline = 1", "no condition is left"),
        ("repetition = 3", "unknown key 'repetition'; valid: description, models, rep"),
        ("[repetitions]\nbaseline = 1\n[scenario]\nstep = 1", "valid: horizon_s"),
        ("[repetitions]\nbaseline = 1\n[scenario]\nstep_s = 0.3", "no whole number"),
        ("conditions = ['L_9_9']\n[repetitions]\nbaseline = 1", "unknown condition 'L_9_9'"),
        ("[repetitions", "Expected ']'"),
    ],
)
def test_a_bad_sweep_file_gets_one_line_with_the_valid_choices(tmp_path, text, says):
    file = tmp_path / "mine.toml"
    file.write_text(text)
    with pytest.raises(UsageError) as caught:
        make_plan(str(file), "emulator")
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


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
