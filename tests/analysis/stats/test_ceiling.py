"""The human ceiling: data sets fitted at once against single fits, and what it comes to."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.data.reference_data import human_outcomes
from merge_runner_analysis.stats.ceiling import (
    DATA_SETS,
    Ceiling,
    Population,
    ceiling,
    drawn,
    imported_humans,
    published_humans,
)
from merge_runner_analysis.stats.indicators import PAPER, ROBUST, verdicts
from merge_runner_analysis.stats.many_fits import (
    HEADWAYS,
    VELOCITIES,
    Draws,
    firth_fits,
    gap_fits,
    logit_fits,
    passes,
)
from merge_runner_analysis.stats.regressions import (
    Regression,
    gap_ols,
    velocity_contrasts,
    who_first_firth,
    who_first_logit,
)

pytestmark = pytest.mark.filterwarnings("error")

CELLS = [(c.projected_headway_m, c.relative_velocity_mps) for c in CONDITIONS.values()]
HUMANS = published_humans()  # one object: its ceilings are computed once
COMPARED = 40
UNEVEN = (3, 0, 5, 2, 1, 7, 0, 4, 2, 6, 1)
MISSING = Regression(0, {}, "not looked at")
COLUMNS = ["projected_headway_m", "relative_velocity_mps", "status", "merged_first", "gap_m"]


@pytest.fixture
def few(monkeypatch):
    """Draws as many data sets as are compared with single fits."""
    monkeypatch.setattr("merge_runner_analysis.stats.ceiling.DATA_SETS", COMPARED)


def judged(draws):
    """Which data sets pass each indicator, by the paper's rule and by the robust one."""
    ols, hc3 = gap_fits(draws)
    return passes(PAPER, logit_fits(draws), ols), passes(ROBUST, firth_fits(draws), hc3)


def even(n):
    return (n,) * len(CONDITIONS)


def gapped() -> Population:
    """The published outcomes with gaps that spread more where the headway is larger."""
    rng = np.random.default_rng(8)
    left = HUMANS.left
    gaps = [
        np.where(np.isfinite(who), 3.5 + 0.17 * abs(h) - 0.2 * abs(dv)
                 + rng.normal(0, 1 + abs(h) / 3, len(who)), np.nan)
        for who, (h, dv) in zip(left, CELLS, strict=True)
    ]  # fmt: skip
    return Population(left, tuple(gaps))


def with_sums(n, total, squares):
    """Some ``n`` values of this sum and sum of squares."""
    mean = total / n
    spread = np.sqrt(max(squares / n - mean**2, 0.0))
    if n % 2 == 0:
        return [mean - spread, mean + spread] * (n // 2)
    wider = spread * np.sqrt(n / max(n - 1, 1))
    return [mean, *[mean - wider, mean + wider] * (n // 2)]


def rows(draws, number) -> pd.DataFrame:
    """One data set as trials, with gaps of the same sums and sums of squares per condition."""
    trials = []
    for i, (h, dv) in enumerate(CELLS):
        n, left = int(draws.n[number, i]), int(draws.left[number, i])
        if n:
            gaps = with_sums(n, draws.gap[number, i], draws.squared_gap[number, i])
            firsts = ["left"] * left + ["right"] * (n - left)
            trials += [(h, dv, "finished", *pair) for pair in zip(firsts, gaps, strict=True)]
    return pd.DataFrame(trials, columns=COLUMNS)


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize(
    "sizes", [even(5), even(10), UNEVEN], ids=["5 each", "10 each", "0 to 7 each"]
)
def test_who_first_verdicts_equal_those_of_single_fits(sizes):
    draws = drawn(HUMANS, sizes)
    wald, firth = judged(draws)
    outcomes = set()
    for number in range(COMPARED):
        trials = rows(draws, number)
        paper = verdicts(PAPER, who_first_logit(trials), MISSING)
        robust = verdicts(ROBUST, who_first_firth(trials), MISSING)
        for name in ("I1", "I2"):
            assert wald[name][number] == bool(paper[name].passed)
            assert firth[name][number] == bool(robust[name].passed)
            outcomes.add((name, bool(paper[name].passed)))
    assert {("I1", True), ("I1", False), ("I2", False)} <= outcomes


@st.composite
def data_sets(draw):
    """Outcomes and gaps of 0 to 4 finished trials in each condition."""
    gap_m = st.floats(0.1, 20).map(lambda gap: round(gap, 3))
    trial = st.tuples(st.sampled_from(["left", "right"]), gap_m)
    return [
        (h, dv, "finished", *drawn_trial)
        for h, dv in CELLS
        for drawn_trial in draw(st.lists(trial, max_size=4))
    ]


def summed(trials: pd.DataFrame) -> Draws:
    """One data set of these trials."""
    n, left, gap, squared_gap = np.zeros((4, 1, len(CELLS)))
    for i, (h, dv) in enumerate(CELLS):
        own = trials[(trials["projected_headway_m"] == h) & (trials["relative_velocity_mps"] == dv)]
        n[0, i], left[0, i] = len(own), (own["merged_first"] == "left").sum()
        gap[0, i], squared_gap[0, i] = own["gap_m"].sum(), (own["gap_m"] ** 2).sum()
    return Draws(n, left, gap, squared_gap)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(data_sets())
def test_of_any_trials_the_fits_at_once_are_those_one_by_one(trials):
    table = pd.DataFrame(trials, columns=COLUMNS)
    draws = summed(table)
    ols, hc3 = gap_fits(draws)
    for at_once, alone in (
        (logit_fits(draws), who_first_logit(table)),
        (firth_fits(draws), who_first_firth(table)),
        (ols, gap_ols(table)),
        (hc3, gap_ols(table, robust=True)),
    ):
        for i, (name, term) in enumerate(alone.terms.items()):
            assert at_once.sound[0]
            assert at_once.terms[i] == name
            assert at_once.b[0, i] == pytest.approx(term.b, rel=1e-3, abs=1e-4)
            if i:  # Firth's intercept is not tested
                assert at_once.p[0, i] == pytest.approx(term.p, rel=2e-2, abs=1e-4)
        if alone.apart:
            more, less, _ = velocity_contrasts(HEADWAYS, VELOCITIES)
            pairs = [
                (HEADWAYS[i], VELOCITIES[i], VELOCITIES[j]) for i, j in zip(more, less, strict=True)
            ]
            played = at_once.apart.played[0]
            assert {pair for pair, there in zip(pairs, played, strict=True) if there} == set(
                alone.apart
            )
            for pair, b, se in zip(pairs, at_once.apart.b[0], at_once.apart.se[0], strict=True):
                if pair in alone.apart:
                    assert b == pytest.approx(alone.apart[pair].b, rel=1e-3, abs=1e-4)
                    assert se == pytest.approx(alone.apart[pair].se, rel=1e-3, abs=1e-4)


@pytest.mark.usefixtures("few")
def test_penalised_verdicts_equal_those_of_single_fits_also_where_they_fail():
    draws = drawn(HUMANS, even(2))
    _, firth = judged(draws)
    found = [
        verdicts(ROBUST, who_first_firth(rows(draws, number)), MISSING)["I2"].passed
        for number in range(COMPARED)
    ]
    assert list(firth["I2"][:COMPARED]) == [bool(passed) for passed in found]
    assert 5 < sum(map(bool, found)) < COMPARED - 5


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize(
    ("humans", "sizes"),
    [(gapped(), even(5)), (gapped(), even(10)), (gapped(), (9, 0, 8, 4, 6, 7, 0, 4, 2, 6, 12)),
     (HUMANS, even(10)), (HUMANS, even(20))],
    ids=["5 each", "10 each", "0 to 12 each", "published", "published, 20 each"],
)  # fmt: skip
def test_gap_verdicts_equal_those_of_single_fits(humans, sizes):
    draws = drawn(humans, sizes)
    classic, robust = judged(draws)
    outcomes = set()
    for number in range(COMPARED):
        trials = rows(draws, number)
        both = (
            (classic, verdicts(PAPER, MISSING, gap_ols(trials))),
            (robust, verdicts(ROBUST, MISSING, gap_ols(trials, robust=True))),
        )
        for rule, (found, each) in enumerate(both):
            for name in ("I3", "I4"):
                assert found[name][number] == bool(each[name].passed)
                outcomes.add((rule, name, bool(each[name].passed)))
    assert {(rule, "I3", passed) for rule in (0, 1) for passed in (True, False)} <= outcomes
    assert {(0, "I4", True), (1, "I4", False)} <= outcomes


def test_drawn_data_sets_are_sums_over_human_trials_that_did_not_collide():
    left = HUMANS.left
    gaps = tuple(np.where(who == 1, 3.0, np.where(who == 0, 5.0, np.nan)) for who in left)
    draws = drawn(Population(left, gaps), even(10))
    assert draws.n.shape == (DATA_SETS, len(CONDITIONS))
    assert (draws.n <= 10).all()
    assert (draws.gap == 3 * draws.left + 5 * (draws.n - draws.left)).all()
    assert (draws.squared_gap == 9 * draws.left + 25 * (draws.n - draws.left)).all()
    for i, who in enumerate(left):
        # 1000 data sets of 10 draws each.
        assert draws.n[:, i].mean() / 10 == pytest.approx(np.isfinite(who).mean(), abs=0.01)
        assert draws.left[:, i].mean() / 10 == pytest.approx((who == 1).mean(), abs=0.03)
    assert len(np.unique(draws.left[:, 5])) > 5


def test_the_published_population_is_the_human_counts():
    left = HUMANS.left
    assert [len(who) for who in left] == [90] * 11
    assert sum(np.isnan(who).sum() for who in left) == 28
    assert sum(np.nansum(who) for who in left) == 465
    assert (np.nansum(left[0]), np.isnan(left[0]).sum()) == (8, 3)  # R_-4_-8


def test_published_gaps_scatter_about_the_papers_regression():
    draws = drawn(HUMANS, even(20))
    for i, (h, dv) in enumerate(CELLS):
        n, expected = draws.n[:, i].sum(), 3.54 + 0.17 * abs(h) - 0.2 * abs(dv) + 0.06 * h * dv
        mean = draws.gap[:, i].sum() / n
        assert mean == pytest.approx(expected, abs=0.06)
        assert draws.squared_gap[:, i].sum() / n - mean**2 == pytest.approx(1.82**2, rel=0.05)


def test_a_human_clone_of_110_trials_passes_the_papers_four_tests_in_a_quarter_of_data_sets():
    found = ceiling(HUMANS, even(10))
    assert found.paper["I1-I4"] == pytest.approx(0.28, abs=0.04)
    assert found.robust["I1"] == found.robust["I2"] == 1.0


def test_the_ceiling_rises_with_the_number_of_trials():
    found = [ceiling(HUMANS, even(n)) for n in (5, 10, 50)]
    for shares in ([c.paper["I1-I4"] for c in found], [c.robust["I1-I4"] for c in found]):
        assert shares == sorted(shares)
        assert shares[0] < 0.15
        assert shares[-1] > 0.5


@pytest.mark.parametrize("n", [5, 10, 20])
def test_the_power_of_the_gap_tests_is_that_of_noncentral_t(n):
    """As if 962 of 990 trials had finished in every condition alike."""
    h, dv = np.array(CELLS).T
    x = np.column_stack([np.ones(11), abs(h), abs(dv), h * dv])
    per_condition = n * 962 / 990
    errors = 1.82 * np.sqrt(np.diag(np.linalg.inv(x.T @ x)) / per_condition)
    freedom = 11 * per_condition - 4
    critical = stats.t.isf(0.025, freedom)
    grows = stats.nct.sf(critical, freedom, 0.17 / errors[1])
    shift = -0.2 / errors[2]
    within = stats.nct.cdf(critical, freedom, shift) - stats.nct.cdf(-critical, freedom, shift)
    found = ceiling(HUMANS, even(n))
    assert found.paper["I3"] == pytest.approx(grows, abs=0.05)
    assert found.paper["I4"] == pytest.approx(within, abs=0.04)
    # Two one-sided tests at 1 m of each pair that differs in relative velocity alone.
    apart = np.array(
        [x[i] - x[j] for i in range(11) for j in range(11) if h[i] == h[j] and dv[i] > dv[j]]
    )
    covariance = 1.82**2 * np.linalg.inv(x.T @ x) / per_condition
    drawn_b = np.random.default_rng(1).multivariate_normal(
        [3.54, 0.17, -0.2, 0.06], covariance, 4000
    )
    half = stats.t.isf(0.05, freedom) * np.sqrt(np.einsum("cj,jk,ck->c", apart, covariance, apart))
    inside = (np.abs(drawn_b @ apart.T) + half < 1).all(axis=1).mean()
    assert found.robust["I4"] == pytest.approx(inside, abs=0.06)


def test_the_ceiling_is_the_same_every_time():
    found, again = ceiling(HUMANS, even(10)), ceiling(published_humans(), even(10))
    assert found == again
    assert found.paper == pytest.approx(
        {"I1": 0.81, "I2": 0.81, "I3": 0.388, "I4": 0.93, "I1-I4": 0.296}, abs=0.002
    )
    assert found.robust == pytest.approx(
        {"I1": 1.0, "I2": 1.0, "I3": 0.381, "I4": 0.032, "I1-I4": 0.015}, abs=0.002
    )


@pytest.mark.parametrize(
    "sizes",
    [(10, *[0] * 10), (1, *[0] * 10), (5, 5, *[0] * 9)],
    ids=["one condition", "one trial", "two conditions"],
)
def test_too_few_conditions_pass_nothing(sizes):
    found = ceiling(HUMANS, sizes)
    nothing = dict.fromkeys(("I1", "I2", "I3", "I4", "I1-I4"), 0.0)
    assert (found.paper, found.robust) == (nothing, nothing)


def test_without_a_trial_there_is_no_share():
    assert ceiling(HUMANS, even(0)) == Ceiling({}, {})


def test_four_trials_are_too_few_for_the_four_coefficients_of_the_gap():
    four = {"N_0_0", "L_0_-8", "L_4_0", "L_4_8"}
    draws = drawn(gapped(), [int(name in four) for name in CONDITIONS])
    for found in judged(draws):
        assert not (found["I3"] | found["I4"]).any()


@pytest.mark.usefixtures("few")
def test_opposite_effects_pass_no_signed_indicator():
    """The humans with their sides exchanged, and with gaps that shrink as far as they grew."""
    humans = gapped()
    shrinking = [
        8 - 0.5 * abs(h) + (gap - 4) / 3 for gap, (h, _) in zip(humans.gap_m, CELLS, strict=True)
    ]
    opposite = Population(tuple(1 - who for who in humans.left), tuple(shrinking))
    draws = drawn(opposite, even(20))
    for found in judged(draws):
        assert not (found["I1"] | found["I2"] | found["I3"]).any()
    draws = drawn(gapped(), even(20))
    paper, _ = judged(draws)
    assert paper["I1"].mean() > 0.9
    assert paper["I3"].mean() > 0.3


@pytest.mark.usefixtures("few")
def test_a_condition_without_human_trials_is_left_out():
    left, gaps = list(HUMANS.left), list(gapped().gap_m)
    left[0], gaps[0] = left[0][:0], gaps[0][:0]
    draws = drawn(Population(tuple(left), tuple(gaps)), even(10))
    assert (draws.n[:, 0] == 0).all()
    assert (draws.n[:, 1:] > 0).all()
    assert judged(draws)[1]["I1"].mean() > 0.9


def test_equal_gaps_disturb_no_ceiling():
    """All residuals are rounding then, some below 0."""
    for gap in (3.7, 8.37):
        gaps = tuple(np.where(np.isfinite(who), gap, np.nan) for who in HUMANS.left)
        for found in judged(drawn(Population(HUMANS.left, gaps), even(2))):
            assert not found["I3"].all()


@pytest.mark.usefixtures("few")
def test_one_trial_per_condition_has_a_ceiling():
    found = ceiling(gapped(), even(1))
    assert found.paper["I1-I4"] == 0
    assert 0 < found.robust["I1"] < 1


def test_i1_to_i4_together_pass_where_each_does():
    found = ceiling(HUMANS, even(10)).paper
    each = [found[name] for name in ("I1", "I2", "I3", "I4")]
    assert sum(each) - 3 <= found["I1-I4"] <= min(each)
    draws = drawn(HUMANS, even(10))
    paper, _ = judged(draws)
    together = [all(paper[name][k] for name in paper) for k in range(DATA_SETS)]
    assert found["I1-I4"] == np.mean(together)


def test_i5_is_a_comparison_with_humans_and_has_no_ceiling():
    found = ceiling(HUMANS, even(10))
    assert set(found.paper) == set(found.robust) == {"I1", "I2", "I3", "I4", "I1-I4"}


def finished_humans() -> pd.DataFrame:
    """The published outcomes that did not collide, with gaps."""
    trials = human_outcomes().query("status == 'finished'")
    return trials.assign(gap_m=np.random.default_rng(1).normal(4, 1.8, len(trials)))


def test_imported_humans_are_their_trials_by_condition():
    rows = [
        ("N_0_0", "finished", "left", 3.0),
        ("N_0_0", "finished", "right", 4.0),
        ("N_0_0", "collided", None, np.nan),
        ("N_0_0", "timeout", "left", np.nan),
        ("L_4_8", "finished", "left", 5.0),
    ]
    trials = pd.DataFrame(rows, columns=["condition", "status", "merged_first", "gap_m"])
    found = imported_humans(trials)
    at = list(CONDITIONS).index("N_0_0")
    assert found.left[at] == pytest.approx([1, 0, np.nan, np.nan], nan_ok=True)
    assert found.gap_m[at] == pytest.approx([3, 4, np.nan, np.nan], nan_ok=True)
    last = list(CONDITIONS).index("L_4_8")
    assert [list(part[last]) for part in (found.left, found.gap_m)] == [[1], [5]]
    assert sum(map(len, found.left)) == 5


@pytest.mark.usefixtures("few")
def test_imported_gaps_are_drawn_with_the_outcome_of_the_same_trial():
    """Who merged first on the left kept 3 m, on the right 5 m."""
    trials = finished_humans()
    trials["gap_m"] = trials["merged_first"].map({"left": 3.0, "right": 5.0})
    draws = drawn(imported_humans(trials), even(3))
    assert (draws.n == 3).all()
    assert (draws.gap == 15 - 2 * draws.left).all()
