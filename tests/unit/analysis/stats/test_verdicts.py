"""Drivers beside the humans: one model behind estimate, interval and p, and sentences of states."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy import optimize, stats
from scipy.special import expit, log_expit

from merge_runner.config import ScenarioConfig
from merge_runner_analysis.data.reference_data import human_counts
from merge_runner_analysis.data.study import Study, _published_humans
from merge_runner_analysis.stats.contrasts import corrected
from merge_runner_analysis.stats.intervals import melded
from merge_runner_analysis.stats.regressions import WHO_FIRST_TERMS, who_first_data
from merge_runner_analysis.stats.verdicts import (
    compared,
    human_fit,
    human_gap,
    levels_of,
    of_humans,
)
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
from tests.support.studies import Drive, write_study, yielding

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


def of_collisions(tmp_path, collided: int, n: int):
    """The row of a driver with so many collisions in so many trials of one condition."""
    apart, together = ((0.4,) * 9, (-0.4,) * 9), ((0.1,) * 9, (0.1,) * 9)
    drives = [
        Drive("o3", "baseline", "N_0_0", rep, *(together if rep <= collided else apart))
        for rep in range(1, n + 1)
    ]
    study = Study(write_study(tmp_path / "t.duckdb", drives, BOXES))
    found = compared(study, study.models[0])
    return next(one for one in found if one.measure.name == "collisions")


@pytest.mark.parametrize(("collided", "n"), [(2, 9), (2, 11), (3, 22), (0, 9)])
def test_few_collisions_are_tested_exactly_as_by_fisher(tmp_path, collided, n):
    found = of_collisions(tmp_path, collided, n)
    humans = human_counts()["N_0_0"]
    table = [[collided, n - collided], [humans.collided, sum(humans) - humans.collided]]
    assert found.p == pytest.approx(stats.fisher_exact(table).pvalue)
    assert (found.own.k, found.own.estimate.n) == (collided, n)
    low, high = found.interval
    assert (found.p_holm < 0.05) == (not low <= 0 <= high)


def test_a_melded_interval_agrees_with_fishers_test_at_every_level():
    for (a, n), (b, m) in product([(0, 9), (2, 9), (7, 110), (9, 9)], [(28, 990), (0, 40), (5, 5)]):
        p = stats.fisher_exact([[a, n - a], [b, m - b]]).pvalue
        for level in (0.9, 0.95, 0.99, 1 - 1.01 * p, 1 - 0.99 * p):
            if not 0.5 < level < 1:
                continue
            low, high = melded((a / n, n), (b / m, m), p, level)
            assert -1 <= low <= a / n - b / m + 1e-9, (a, n, b, m, level)
            assert a / n - b / m - 1e-9 <= high <= 1, (a, n, b, m, level)
            assert (low <= 1e-9 and high >= -1e-9) == (p >= 1 - level), (a, n, b, m, level)


@pytest.mark.parametrize("rates", [(0.02, 0.03), (0.3, 0.03), (0.5, 0.5), (0.0, 0.03)])
def test_a_melded_interval_holds_the_true_difference_in_95_percent(rates):
    """Over all outcomes of 9 trials beside 20."""
    n, m, covered = 9, 20, 0.0
    for a in range(n + 1):
        for b in range(m + 1):
            chance = stats.binom.pmf(a, n, rates[0]) * stats.binom.pmf(b, m, rates[1])
            if chance > 1e-6:
                p = stats.fisher_exact([[a, n - a], [b, m - b]]).pvalue
                low, high = melded((a / n, n), (b / m, m), p)
                covered += chance * (low <= rates[0] - rates[1] <= high)
    assert covered > 0.949


def test_the_interval_beside_a_verdict_agrees_with_its_corrected_p_and_names_its_level(rows):
    for name, values in rows.items():
        if values.get("p_holm") is None:
            continue
        assert 90 <= values["level"] < 100
        assert values["p"] <= values["p_holm"]
        differs_by_p = values["p_holm"] < 0.05
        assert (values["state"] in {"weaker", "stronger", "unlike"}) == differs_by_p, name
        margin = MEASURES[values["measure"]].margin
        if margin is not None:
            assert (values["ci"][0] > margin) == differs_by_p
            continue
        low, high = values["difference_ci"]
        assert differs_by_p == (not low <= 0 <= high), name
        assert values["difference"] == pytest.approx(values["estimate"] - values["human"])


def test_holms_levels_are_those_of_its_steps():
    p = {"a": 0.001, "b": 0.04, "c": 0.02, "d": 0.9}
    holm = dict(zip(p, corrected([*p.values()]), strict=True))
    # Of four the smallest is below .05 / 4; the next is not below .05 / 3, and ends it.
    assert levels_of(p, holm) == pytest.approx(
        {"a": 1 - 0.05 / 4, "b": 1 - 0.05 / 3, "c": 1 - 0.05 / 3, "d": 1 - 0.05 / 3}
    )


def gaps(tmp_path, gap_of, reps=3, scatter=0.02):
    """A driver's row of I4, and that of its regression, with gaps of this function of h and dv."""
    study = Study(write_study(tmp_path / "t.duckdb", yielding("o3", reps=reps), BOXES))
    (group,) = study.models
    trials = group.trials.copy()
    headway, velocity = trials[["projected_headway_m", "relative_velocity_mps"]].to_numpy().T
    gap = gap_of(headway, velocity) + scatter * np.random.default_rng(1).standard_normal(
        len(trials)
    )
    trials["gap_m"] = trials["counted_gap_m"] = gap
    found = compared(study, replace(group, trials=trials))
    return next(one for one in found if one.measure.name == "gap-velocity")


def test_i4_looks_at_one_quantity_the_largest_predicted_difference(tmp_path):
    """The signed product alone moves gaps: none where nobody is ahead, 2.2 m where one is by 4."""
    found = gaps(tmp_path, lambda h, dv: 17 + 0.34 * h * dv)
    assert found.own.estimate.value == pytest.approx(0.34 * 6.4, abs=0.05)
    assert found.state == "unlike"
    assert found.own.estimate.low > 1
    assert found.p_holm < 0.05
    assert found.level >= 0.95
    assert found.human.estimate.value == pytest.approx(6.4 * 0.06)


def test_i4_is_shown_where_its_interval_lies_within_the_margin(tmp_path):
    found = gaps(tmp_path, lambda h, dv: 4 + 0.03 * h * dv)
    low, high = found.own.estimate.bounds()
    assert found.state == "shown"
    assert low <= found.own.estimate.value <= high < 1
    assert found.level == pytest.approx(0.9)


def test_i4_is_open_where_its_interval_holds_the_margin(tmp_path):
    found = gaps(tmp_path, lambda h, dv: 4 + 0.15 * h * dv, scatter=2.0)
    low, high = found.own.estimate.bounds()
    assert found.state == "inconclusive"
    assert low <= 1 <= high


def test_the_published_errors_of_the_gap_follow_from_the_outcomes_and_one_deviation():
    fit = human_fit(_published_humans())
    errors = np.sqrt(np.diag(fit.covariance))
    assert errors == pytest.approx([term.se for term in fit.terms.values()], rel=0.02)


def test_humans_leave_their_gap_in_the_conditions_of_the_drivers_finished_trials(tmp_path):
    """Beside a driver that finished in wide conditions alone, they leave more."""
    study = Study(write_study(tmp_path / "t.duckdb", yielding("o3", reps=3), BOXES))
    (group,) = study.models
    everywhere = human_gap(study.human, study.human).estimate
    assert everywhere.value == pytest.approx(3.85)
    wide = group.part(lambda trials: trials["projected_headway_m"].abs() == 4)
    there = human_gap(study.human, wide).estimate
    regression = 3.54 + 0.17 * 4 - 0.2 * 0.8 * 2 / 3  # h dv cancels
    assert there.value == pytest.approx(regression, abs=0.05)
    assert there.value > human_gap(study.human, group).estimate.value
    # Conditions in which no trial has a gap do not count.
    collided = group.trials["projected_headway_m"].abs() != 4
    lost = group.trials.assign(
        status=group.trials["status"].mask(collided, "collided"),
        counted_gap_m=group.trials["counted_gap_m"].mask(collided),
    )
    assert human_gap(study.human, replace(group, trials=lost)).estimate == there


def test_the_humans_are_the_published_ones(study, rows):
    humans = {name: known.estimate for name, known in of_humans(study).items()}
    assert humans["collisions"].value == pytest.approx(100 * 28 / 990)
    assert humans["gap"].bounds() == pytest.approx((2.88, 4.82), abs=0.005)
    assert humans["gap-velocity"].value == pytest.approx(0.06 * 6.4)  # L_4_-8 and L_4_8
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


@pytest.mark.parametrize("measure", ["gap-velocity", "held"])
def test_an_interval_beside_a_margin_names_its_level_where_that_is_not_95_percent(measure):
    values = {"measure": measure, "estimate": 2.18, "ci": (1.03, 3.11), "n": 14,
              "human": 0.38, "human_ci": None}  # fmt: skip
    for level, said in ((98.75, "98.75"), (100 * (1 - 0.05 / 7), "99.29"), (90.0, "90")):
        text = told({**values, "level": level})
        assert text.endswith(f"(n = 14; its interval at {said} %)")
    for level in (95.0, 100 * 0.95, None):
        assert told({**values, "level": level}).endswith("(n = 14)")
    assert told({**values, "measure": "gap", "level": 98.75}).endswith("(n = 14)")


def test_of_few_finished_trials_a_headline_says_the_counts_alone(study):
    (table,) = make_tables(study, ["verdicts"])
    wild = by_group(table.rows)["wild/baseline"]

    def few(finished, ended=0, collided=0):
        undecided = max(ended - finished - collided, 0)
        collisions = {"k": collided, "n": finished + collided, "undecided": undecided}
        return wild | {
            "gap": {**wild["gap"], "n": finished},
            "collisions": {**wild["collisions"], **collisions},
        }

    rest = "too few to say whether it drives like humans."
    for of, counts in [
        (few(0, 11), "0 finished trials of 11"),
        (few(1), "1 finished trial"),
        (few(7, 22), "7 finished trials of 22"),
        (few(19), "19 finished trials"),
        (few(7, 22, 3), "7 finished trials of 22"),
    ]:
        assert headline({"gpt": of}) == (f"gpt: {counts}, {rest}", "")
    # Who collides has an outcome, too.
    for of in (few(20), few(16, collided=4), few(0, collided=20)):
        assert headline({"gpt": of})[0] == "gpt does not drive like humans:"
    both = {"gpt": few(7, 22), "o4": few(2)}
    assert headline(both)[0] == (
        "gpt: 7 finished trials of 22 and o4: 2 finished trials, too few to say whether they drive "
        "like humans."
    )
    # Others are judged without them.
    claim, because = headline({"wild": wild, "gpt": few(2)})
    alone = headline({"wild": wild})
    assert (claim, because) == (alone[0], f"{alone[1]} gpt: 2 finished trials, {rest}")
    assert "No language model" not in " ".join(headline({"a": wild, "b": wild, "gpt": few(2)}))
    assert headline({"a": wild, "b": wild})[0] == "No language model here drives like humans:"


def test_with_undecided_trials_there_is_no_p_and_n_is_that_of_the_decided_ones(tmp_path):
    drives = [
        Drive("o3", "baseline", name, rep, (0.1 * rep,) * 9, (0.1 * rep,) * 9)
        for name in ("N_0_0", "L_4_0")
        for rep in range(1, 4)
    ]
    study = Study(write_study(tmp_path / "t.duckdb", drives))
    table, indicators = make_tables(study, ["verdicts", "indicators"])
    row = next(row for row in table.rows if row.id == "o3/baseline/collisions")
    beside = next(r for r in indicators.rows if r.id == "o3/baseline/collided_boxes_percent")
    assert row.values["estimate"] is None
    assert row.values["undecided"] == 4
    assert row.values["n"] == beside.values["n"] == 2
    assert "4 of 6 trials are undecided" in row.note
    untested = ("difference", "difference_ci", "level", "p", "p_holm", "detectable")
    assert {row.values[name] for name in untested} == {None}
    assert row.values["state"] == "inconclusive"
    assert "ollisions (33 to 100 % of trials): inconclusive" in sentence(
        by_group(table.rows)["o3/baseline"]
    )


def test_a_headline_of_several_models_says_how_many_comparisons_it_rests_on(study):
    (table,) = make_tables(study, ["verdicts"])
    groups = by_group(table.rows)
    models = {name: groups[f"{name}/baseline"] for name in ("o3", "wild")}
    every = [one for of in models.values() for one in of.values()]
    tested = sum(one["p_holm"] is not None for one in every)
    found = sum(map(differs, every))
    assert f"{found} of {tested} comparisons" in " ".join(headline(models))
    assert "comparisons" not in " ".join(headline({"wild": models["wild"]}))


def test_a_replayed_human_is_not_judged(tmp_path):
    asked = {"program": "human-replay", "data": "a hash"}
    study = Study(write_study(tmp_path / "t.duckdb", yielding("human-replay"), asked=asked))
    (table,) = make_tables(study, ["verdicts"])
    assert {row.groups for row in table.rows} == {("human",)}
    assert any("both humans are replayed and do not react" in note for note in table.notes)
