"""The list of metrics, to which packages add."""

from dataclasses import replace

import pytest

from merge_runner.errors import UsageError
from merge_runner_analysis.metrics import BOXES, COLLISIONS, GAP, JOINT, RMSE, register, shown_in
from merge_runner_analysis.stats.measures import no_human_value


def test_places_show_the_metrics_in_the_order_of_the_list():
    assert shown_in("tables") == [COLLISIONS, BOXES, GAP, RMSE, JOINT]


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"name": "mean |a|"}, r"'mean \|a\|' needs a name of letters"),
        ({"name": "gap_m"}, "there is a metric 'gap_m' already"),
        (
            {"name": "a_m", "value": "collided", "estimator": "proportion"},
            r"^the metric 'a_m' .*it needs trials='ended'",
        ),
    ],
)
def test_a_metric_that_does_not_fit_is_refused(own_parts, changes, says):
    with pytest.raises(UsageError, match=says):
        register(replace(RMSE, paper_of_humans="", paper_of_drivers="", **changes))


def test_why_humans_have_no_value_is_told_of_collisions_alone_by_their_rule():
    whole = replace(RMSE, name="a_mps", label="a", paper_of_humans="", paper_of_drivers="")
    assert str(no_human_value(COLLISIONS)).endswith(
        "published human collisions are boxes that overlap"
    )
    assert (
        str(no_human_value(whole)) == "a (m/s): no human value is published, and none is imported"
    )
