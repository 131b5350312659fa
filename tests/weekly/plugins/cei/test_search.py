"""The search can be repeated, and looks where its targets are."""

from dataclasses import asdict, replace

import pytest

from merge_runner_cei.calibration.design import design, experiment
from merge_runner_cei.calibration.search import MISSING, cost, search, targets
from merge_runner_cei.calibration.searches import SEARCHES
from merge_runner_cei.driver import check
from merge_runner_cei.parameters import SETS
from tests.support.cei_trials import scenario, simulated


def test_the_design_has_each_pair_ten_times_in_each_condition_with_the_seeds_of_the_slots():
    trials = design(SETS["K0"], experiment(), 0)
    assert len(trials) == 990
    assert len({seed for one in trials for seed in one.seeds}) == 2 * 990
    assert trials[:90] == [simulated("R_-4_-8", n, scenario()) for n in range(1, 91)]


def test_a_miss_by_its_tolerance_costs_one_and_a_number_without_a_fit_much():
    wanted = targets()
    exact = {(one.measure, one.term): one.value for one in wanted}
    assert cost(exact, wanted) == 0
    assert cost({**exact, ("collisions", "count"): 33.0}, wanted) == pytest.approx(1)
    del exact["who_first", "intercept"]
    assert cost(exact, wanted) == MISSING**2


def test_a_search_looks_only_for_thresholds_that_a_study_may_set():
    edge = replace(SETS["K0"], lower_spread=0.0, upper_spread=0.0, upper_mean=1.0)
    for found in search(
        edge, experiment(), targets(), generations=1, size=6, seed=1, trials_of_a_pair=1
    ):
        check({"pair": 0, **asdict(found.thresholds)})


@pytest.mark.parametrize("name", SETS)
def test_the_search_for_a_set_can_be_repeated(name):
    def last():
        *_, found = replace(SEARCHES[name], generations=1, size=3, trials_of_a_pair=1).run()
        return found

    found = last()
    assert found == last()
    assert found.thresholds != SEARCHES[name].start
