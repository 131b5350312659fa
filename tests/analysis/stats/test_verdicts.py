"""Drivers beside the humans: one model behind estimate, interval and p, and sentences of states."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize, stats
from scipy.special import expit, log_expit

from merge_runner.config import ScenarioConfig
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.stats.intervals import Estimate, newcombe, wilson
from merge_runner_analysis.stats.regressions import WHO_FIRST_TERMS, who_first_data
from merge_runner_analysis.stats.verdicts import Known, _of_rates, compared, of_humans
from merge_runner_analysis.tables import make_tables
from merge_runner_analysis.verdict_words import (
    MEASURES,
    by_group,
    differs,
    headline,
    sentence,
    sentences,
    told,
)
from tests.analysis.studies import Drive, write_study, yielding

BOXES = ScenarioConfig(collision_rule="rectangle")


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """A driver like the humans, and one that crashes where nobody is ahead."""
    crashes = [
        Drive("wild", "baseline", name, rep, (0.1 * rep,) * 9, (0.1 * rep,) * 9)
        for name in ("N_0_0", "L_4_0", "R_-4_0")
        for rep in range(1, 7)
    ]
    drives = [*yielding("o3", reps=5), *yielding("wild", reps=2), *crashes]
    drives = {(one.driver, one.condition, one.rep): one for one in drives}
    path = tmp_path_factory.mktemp("verdicts") / "t.duckdb"
    return Study(write_study(path, drives.values(), BOXES))


@pytest.fixture(scope="module")
def rows(study):
    (table,) = make_tables(study, ["verdicts"])
    return {row.id: row.values for row in table.rows}


def test_a_row_for_each_measure_of_the_humans_and_of_every_driver_and_prompt(rows):
    assert [*rows] == [
        f"{group}/{name}"
        for group in ("human", "o3/baseline", "wild/baseline")
        for name in MEASURES
    ]


def penalised(design, left, column, value):
    """Firth's penalised log-likelihood, maximal over all terms but one that is held."""

    def loss(free):
        b = np.insert(free, column, value)
        log_odds = design @ b
        p = expit(log_odds)
        information = design.T @ (design * (p * (1 - p))[:, None])
        fit = np.where(left, log_expit(log_odds), log_expit(-log_odds))
        return -(fit.sum() + np.linalg.slogdet(information)[1] / 2)

    how = {"method": "Nelder-Mead", "options": {"xatol": 1e-8, "fatol": 1e-11, "maxiter": 5000}}
    starts = ((0, 0), (-2, -4), (-1, 1))  # from one alone it may stop early
    return -min(optimize.minimize(loss, start, **how).fun for start in starts)


@pytest.mark.parametrize("name", ["headway", "velocity"])
@pytest.mark.parametrize("reps", [1, 5])
def test_a_slope_of_who_goes_first_has_the_interval_of_its_profile(tmp_path, name, reps):
    """Also where one trial of each condition separates them."""
    study = Study(write_study(tmp_path / "t.duckdb", yielding("o3", reps=reps), BOXES))
    found = next(one for one in compared(study, study.models[0]) if one.measure.name == name)
    column = WHO_FIRST_TERMS.index(
        {"headway": "projected_headway", "velocity": "relative_velocity"}[name]
    )
    design, left = who_first_data(study.models[0].outcomes)
    best = penalised(design, left, column, found.own.estimate.value)
    for end in found.own.estimate.bounds():
        lost = 2 * (best - penalised(design, left, column, end))
        assert lost == pytest.approx(stats.chi2.ppf(0.95, 1), rel=1e-3)


def test_a_difference_of_rates_is_newcombes_and_its_p_the_level_that_leaves_0_out():
    def known(k, n):
        low, high = wilson(k / n, n)
        return Known(Estimate(100 * k / n, 100 * low, 100 * high, n, weight=n), k=k)

    found = _of_rates(known(10, 20), known(5, 50))
    low, high = newcombe([(0.5, 20), (0.1, 50)])
    assert found.bounds() == pytest.approx((100 * low, 100 * high))
    z = stats.norm.isf(found.p / 2)
    assert newcombe([(0.5, 20), (0.1, 50)], z)[0] == pytest.approx(0, abs=1e-9)
    assert _of_rates(known(4, 20), known(10, 50)).p == 1


def test_interval_and_p_of_a_difference_agree(rows):
    for name, values in rows.items():
        if values.get("p") is not None:
            low, high = values["difference_ci"]
            assert (values["p"] < 0.05) == (not low <= 0 <= high), name
            assert values["difference"] == pytest.approx(values["estimate"] - values["human"])
            assert values["p"] <= values["p_holm"]


def test_the_humans_are_the_published_ones(study, rows):
    humans = {name: known.estimate for name, known in of_humans(study).items()}
    assert humans["collisions"].value == pytest.approx(100 * 28 / 990)
    assert humans["gap"].bounds() == pytest.approx((2.88, 4.82), abs=0.005)
    assert humans["gap-velocity"].value == pytest.approx(-0.2 * 0.8)
    assert rows["human/headway"]["n"] == 962
    assert humans["velocity"].low < humans["velocity"].value


def test_a_driver_that_yields_shows_what_humans_do_and_one_that_crashes_is_unlike_them(rows):
    assert rows["o3/baseline/headway"]["state"] in {"shown", "weaker"}
    wild = rows["wild/baseline/collisions"]
    assert wild["state"] == "unlike"
    assert wild["k"] / wild["n"] == pytest.approx(wild["estimate"] / 100)


def test_sentences_tell_the_states_of_the_rows_and_the_headline_the_surest_difference(study):
    (table,) = make_tables(study, ["verdicts"])
    first, *rest = sentences(table.rows)
    assert [*table.notes[: len(rest) + 1]] == [first, *rest]
    groups = by_group(table.rows)
    wild = groups["wild/baseline"]
    assert f"ollides in {wild['collisions']['estimate']:.0f} % of trials" in sentence(wild)
    surest = min((one for one in wild.values() if differs(one)), key=lambda one: one["p_holm"])
    assert headline({}) == ("No language model is judged here.", "")
    claim, because = headline({"wild": wild})
    assert claim == "wild does not drive like humans:"
    assert because == f"it {told(surest)}."


def test_undecided_trials_leave_both_worst_cases_and_a_verdict_that_holds_in_both(tmp_path):
    drives = [
        Drive("o3", "baseline", name, rep, (0.1 * rep,) * 9, (0.1 * rep,) * 9)
        for name in ("N_0_0", "L_4_0")
        for rep in range(1, 4)
    ]
    study = Study(write_study(tmp_path / "t.duckdb", drives))
    (table,) = make_tables(study, ["verdicts"])
    row = next(row for row in table.rows if row.id == "o3/baseline/collisions")
    assert row.values["estimate"] is None
    assert row.values["undecided"] == 4
    assert "4 of 6 trials are undecided" in row.note
    low, high = row.values["difference_ci"]
    assert (row.values["state"] == "unlike") == (low > 0)
    assert high > 90


def test_a_replayed_human_is_not_judged(tmp_path):
    asked = {"program": "human-replay", "data": "a hash"}
    study = Study(write_study(tmp_path / "t.duckdb", yielding("human-replay"), asked=asked))
    (table,) = make_tables(study, ["verdicts"])
    assert {row.groups for row in table.rows} == {("human",)}
    assert any("both humans are replayed and do not react" in note for note in table.notes)
