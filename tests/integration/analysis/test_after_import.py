"""What changes in tables, figures and report once the human recordings are imported."""

from __future__ import annotations

from dataclasses import replace

import pytest

from merge_runner.results.store import Store
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.data.intermittency import measure_profiles
from merge_runner_analysis.data.load import SPEEDS
from merge_runner_analysis.data.study import Study, of_trials
from merge_runner_analysis.explain import explain
from merge_runner_analysis.figures.gallery import MAKERS
from merge_runner_analysis.human.archive import open_files
from merge_runner_analysis.human.load import import_trials, sort_files
from merge_runner_analysis.metrics import GAP
from merge_runner_analysis.stats.indicators import Verdict, gains, less_humans, mean_gain, score
from merge_runner_analysis.stats.intervals import mean
from merge_runner_analysis.stats.measures import estimate
from merge_runner_analysis.stats.verdicts import human_gap
from merge_runner_analysis.tables import make_tables
from tests.support.recordings import drive, write_folder
from tests.support.studies import write_study, yielding


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    """Three pairs of humans, two trials each in every condition, beside a driver."""
    folder = tmp_path_factory.mktemp("imported")
    files = {}
    for experiment in (4, 6, 8):
        number = 0
        for played, condition in CONDITIONS.items():
            for rep in range(2):
                number += 1
                ahead = condition.projected_headway_m + 0.1 * experiment - 0.5 + 0.3 * (rep - 1)
                yields = "both" if rep == 1 and experiment == 8 else None
                yields = yields or ("right" if ahead > 0 else "left")
                name = f"experiment_{experiment}/experiment_{experiment}_iter_{number}.csv"
                files[name] = drive(played, yields=yields).csv()
    db = write_study(folder / "t.duckdb", yielding("o3", reps=2))
    with open_files(write_folder(folder / "recordings", files)) as found:
        import_trials(sort_files(found), Store(db))
    return Study(db)


@pytest.mark.slow
def test_human_rows_come_from_the_traces(imported):
    tables = {table.name: table for table in make_tables(imported)}
    human = imported.human
    assert human.measured
    row = next(r for r in tables["ablation-quantitative"].rows if r.id == "human")
    assert (row.values["n"], row.values["driver"]) == (990, "humans (66 of 990 imported)")
    assert row.values["collided_boxes_percent"] == pytest.approx(100 * 28 / 990)
    assert "990 published outcomes; the rest: 66 imported trials, 55 finished" in row.note
    assert row.values["gap_m"] == pytest.approx(human.finished["gap_m"].mean())
    assert "published values" not in row.note
    verdicts = {row.id: row for row in tables["verdicts"].rows}
    assert verdicts["human/headway"].values["n"] == 962
    assert verdicts["human/gap"].values["n"] == len(human.finished)
    assert verdicts["o3/baseline/gap"].values["human"] == pytest.approx(
        human.finished.groupby("pair")["gap_m"].mean().mean()
    )
    assert any("66 of 990 trials" in note for note in tables["who-first"].notes)


def test_a_row_of_humans_names_their_trials_and_the_published_outcomes(imported):
    tables = {table.name: table for table in make_tables(imported)}
    for name, row, trials in (
        ("ablation-quantitative", "human", 66),
        ("who-first", "human/intercept", 55),
        ("who-first", "human/clustered/intercept", 55),
        ("verdicts", "human/collisions", 66),
    ):
        (human,) = explain(imported, tables[name], row).sources
        assert len(human.trials) == trials, (name, row)
        assert "those of 990 published outcomes" in human.text


def test_the_ceiling_of_humans_is_left_out_where_their_indicators_rest_on_both(imported):
    (table,) = make_tables(imported, ["indicators"])
    rows = {row.id: row for row in table.rows}
    assert rows["human/I1"].values["n"] == 962
    assert rows["human/I1"].values["ceiling_paper"] is not None
    for name in ("I3", "I4", "score"):
        assert rows[f"human/{name}"].values["n"] == 55
        assert rows[f"human/{name}"].values.get("ceiling_paper") is None
        assert "990 published outcomes" in rows[f"human/{name}"].note


def test_humans_have_further_rows_with_errors_by_pair(imported):
    for table in make_tables(imported, ["who-first", "gap"]):
        rows = [row for row in table.rows if "/clustered/" in row.id]
        terms = {row.id.rpartition("/")[2] for row in table.rows}
        assert {row.id.rpartition("/")[2] for row in rows} == terms
        assert all(row.values.get("b") is not None or row.note for row in rows)


def test_how_like_the_humans_a_driver_is_in_i5_is_a_number(imported):
    """The driver holds its accelerations; these humans approach their speed exponentially."""
    (group,) = imported.models
    for one, passed in ((group, True), (imported.human, False)):
        found = score(imported, one)
        assert found.robust["I5"] == Verdict(passed)
        assert found.paper["I5"] == Verdict(None)
    human, driver = (mean_gain(imported, one).value for one in (imported.human, group))
    assert human < 0 < driver
    apart = less_humans(imported, group)
    assert apart.low > 0.5
    (table,) = make_tables(imported, ["verdicts"])
    row = next(row.values for row in table.rows if row.id == "o3/baseline/held")
    assert row["estimate"] == apart.value
    # At the level at which Holm tests it, wider than the 95 % by itself.
    assert 0.5 < row["ci"][0] < apart.low < apart.high < row["ci"][1]
    assert row["level"] > 95
    assert row["state"] == "unlike"


def test_the_humans_mean_gap_is_one_number_in_all_tables(imported):
    """Also where pairs have other numbers of trials: never a mean of the pairs' means."""
    human = imported.human
    of_pair = human.trials["pair"] == human.trials["pair"].iloc[0]
    kept = ~of_pair | (of_pair.cumsum() <= 4)
    less = replace(human, trials=human.trials[kept])
    beside, table = human_gap(less, less).estimate, estimate(less, GAP)
    assert beside.value == pytest.approx(less.finished[GAP.column].mean())
    assert (table.value, table.bounds(), table.n) == (beside.value, beside.bounds(), beside.n)


def test_the_human_interval_is_over_pairs(imported):
    trials = gains(imported, imported.human)
    pairs = mean(trials.groupby("pair")["gain"].mean())
    assert pairs.n == 3
    found = mean_gain(imported, imported.human)
    assert (found.value, found.bounds()) == (pairs.value, pairs.bounds())


def test_humans_are_not_compared_with_themselves(imported):
    assert less_humans(imported, imported.human) is None


def test_the_speeds_of_humans_are_judged_without_the_simulators_resistance(imported):
    speeds = imported.read(SPEEDS).assign(resisted=True)
    for group in imported.groups:
        resisted = measure_profiles(of_trials(speeds, group.trials))
        assert len(resisted) == 2 * len(group.trials)
        assert resisted.equals(imported.profiles_of(group)) == (group is imported.human)


def test_nothing_says_any_more_that_recordings_are_missing(imported):
    axes = MAKERS["figure2"](imported).axes
    drawn = [text.get_text() for axis in axes for text in axis.texts]
    assert not any("recordings" in text for text in drawn)
