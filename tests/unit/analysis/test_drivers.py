"""What is said of trials in which a mock model answered."""

import pytest

from merge_runner.driver_names import both_sides
from merge_runner_analysis.drivers import stand_in
from tests.support.cases import table


@pytest.mark.parametrize(("model", "sides", "words"), table("pairs", "stand_ins"))
def test_a_stand_in_stands_for_the_models_on_whose_sides_it_answered(model, sides, words):
    models = {side: name for side, name in both_sides(model).items() if name != "constant"}
    assert stand_in(models, sides) == words
