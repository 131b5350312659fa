"""What changes in tables and figures once human recordings are imported."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from merge_runner_analysis.explain import explain
from merge_runner_analysis.frames import SPEEDS
from merge_runner_analysis.grouping import humans_of, of_trials
from merge_runner_analysis.metrics import GAP
from merge_runner_analysis.stats.held import measure_profiles
from merge_runner_analysis.stats.human_reference import human_gap, of_humans
from merge_runner_analysis.stats.indicators import (
    Judgement,
    less_humans,
    mean_gain,
    profiles,
    score,
)
from merge_runner_analysis.stats.measures import estimate
from merge_runner_analysis.tables import make_tables
from tests.support.tables import by_id, notes_with


@pytest.fixture(scope="module")
def after(imported):
    """All tables of the imported humans and a driver, by name."""
    return {table.name: table for table in make_tables(imported)}


def test_human_rows_come_from_the_traces(imported, after):
    human = imported.human
    row = by_id(after["ablation-quantitative"])["human"]
    assert (row.values["n"], row.values["driver"]) == (990, "humans (66 of 990 imported)")
    assert row.values["collided_boxes_percent"] == pytest.approx(100 * 28 / 990)
    assert row.values["gap_m"] == pytest.approx(human.finished["gap_m"].mean())
    assert "990 published outcomes; the rest: 66 imported trials, 55 finished" in row.note
    assert "published values" not in row.note
    verdicts = {row.id: row.values for row in after["verdicts"].rows}
    assert verdicts["human/headway"]["n"] == 962
    assert verdicts["human/gap"]["n"] == len(human.finished)
    assert verdicts["o3/baseline/gap"]["human"] == pytest.approx(
        human.finished.groupby("pair")["gap_m"].mean().mean()
    )
    assert notes_with(after["who-first"], "66 of 990 trials")


def test_two_imported_trials_leave_published_values_as_they_are(imported):
    trials = imported.human.trials
    few, published = (
        of_humans(SimpleNamespace(human=humans_of(rows))) for rows in (trials[:2], trials[:0])
    )
    assert published["gap"].value == pytest.approx(3.85)
    assert all(few[name].value == value.value for name, value in published.items())
    assert all(few[name].bounds() == value.bounds() for name, value in published.items())


@pytest.mark.parametrize(
    ("name", "row", "trials"),
    [
        ("ablation-quantitative", "human", 66),
        ("who-first", "human/intercept", 55),
        ("who-first", "human/clustered/intercept", 55),
        ("verdicts", "human/collisions", 66),
    ],
)
def test_a_row_of_humans_names_their_trials_and_the_published_outcomes(
    imported, after, name, row, trials
):
    (human,) = explain(imported, after[name], row).sources
    assert len(human.trials) == trials
    assert "come from 990 published outcomes" in human.text


def test_the_ceiling_of_humans_is_left_out_where_their_indicators_rest_on_both(after):
    rows = by_id(after["indicators"])
    assert rows["human/I1"].values["n"] == 962
    assert rows["human/I1"].values["ceiling_paper"] is not None
    for name in ("I3", "I4", "score"):
        assert rows[f"human/{name}"].values["n"] == 55
        assert rows[f"human/{name}"].values.get("ceiling_paper") is None
        assert "990 published outcomes" in rows[f"human/{name}"].note


def test_humans_have_further_rows_with_errors_by_pair(after):
    for table in (after["who-first"], after["gap"]):
        rows = [row for row in table.rows if "/clustered/" in row.id]
        terms = {row.id.rpartition("/")[2] for row in table.rows}
        assert {row.id.rpartition("/")[2] for row in rows} == terms
        assert all(row.values.get("b") is not None or row.note for row in rows)


def test_how_like_the_humans_a_driver_is_in_i5_is_a_number(imported, after):
    """The driver holds its accelerations; these humans approach their speed exponentially."""
    (group,), human = imported.models, imported.human
    for one, passed in ((group, True), (human, False)):
        found = score(imported, one)
        assert (found.robust["I5"], found.paper["I5"]) == (Judgement(passed), Judgement(None))
    assert mean_gain(imported, human).value < 0 < mean_gain(imported, group).value
    assert less_humans(imported, human) is None
    apart = less_humans(imported, group)
    row = by_id(after["verdicts"])["o3/baseline/held"].values
    assert row["estimate"] == apart.value
    # At the level at which Holm tests it, wider than the 95 % by itself.
    assert 0.5 < row["ci"][0] < apart.low < apart.high < row["ci"][1]
    assert row["level"] > 95
    assert row["state"] == "unlike"


def test_the_humans_mean_gap_is_one_number_in_all_tables(imported):
    """Also where pairs have other numbers of trials: never a mean of the pairs' means."""
    human = imported.human
    of_pair = human.trials["pair"] == human.trials["pair"].iloc[0]
    less = replace(human, trials=human.trials[~of_pair | (of_pair.cumsum() <= 4)])
    beside, table = human_gap(less, less), estimate(less, GAP)
    assert beside.value == pytest.approx(less.finished[GAP.column].mean())
    assert (table.value, table.bounds(), table.n) == (beside.value, beside.bounds(), beside.n)


def test_the_speeds_of_humans_are_judged_without_the_simulators_resistance(imported):
    speeds = imported.read(SPEEDS).assign(resisted=True)
    for group in imported.groups:
        resisted = measure_profiles(of_trials(speeds, group.trials))
        assert len(resisted) == 2 * len(group.trials)
        assert resisted.equals(profiles(imported, group)) == (group is imported.human)
