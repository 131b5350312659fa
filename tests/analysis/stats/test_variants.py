"""How variants differ from their baseline, against joint models that are fitted as a whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from statsmodels.discrete.discrete_model import Logit
from statsmodels.regression.linear_model import OLS

from analysis.data.study import Study
from analysis.explain import explain
from analysis.stats.contrasts import corrected
from analysis.stats.group_scores import fits
from analysis.stats.regressions import GAP_TERMS, WHO_FIRST_TERMS, gap_data, who_first_data
from analysis.stats.variants import gap_differences, who_first_differences
from analysis.tables import make_tables
from merge_runner.scenarios.merge.conditions import CONDITIONS
from tests.analysis.studies import Drive, write_study, yielding

NAMES = ("who-first-variants", "gap-variants")


def value(table, row_id, column):
    (row,) = [row for row in table.rows if row.id == row_id]
    return row.values.get(column)


def joint(first, second):
    """Design and outcome of both groups: all terms, and all terms once more for the first alone."""
    (x, y), (u, v) = first, second
    return np.block([[x, x], [u, np.zeros_like(u)]]), np.concatenate([y, v])


@pytest.fixture
def pair(study):
    """o3's baseline and its variant A1."""
    baseline, variant = study.models[:2]
    assert (baseline.id, variant.id) == ("o3/baseline", "o3/A1")
    return variant, baseline


def test_the_gaps_difference_is_the_interaction_of_a_joint_model_with_hc3_errors(pair):
    model = OLS(*joint(*(gap_data(group.trials)[:2] for group in pair))[::-1])
    fit = model.fit().get_robustcov_results("HC3")
    for term, found in gap_differences(*pair).items():
        at = 4 + GAP_TERMS.index(term)
        assert found.value == pytest.approx(fit.params[at])
        one, other = (fits(group).hc3.terms[term].se ** 2 for group in pair)
        freedom = (one + other) ** 2 / (one**2 / (55 - 4) + other**2 / (110 - 4))
        t = stats.t(freedom)
        assert found.high - found.value == pytest.approx(fit.bse[at] * t.ppf(0.975))
        assert found.value - found.low == pytest.approx(fit.bse[at] * t.ppf(0.975))
        assert found.p == pytest.approx(2 * t.sf(abs(found.value) / fit.bse[at]))
        assert found.detectable == pytest.approx(fit.bse[at] * (t.ppf(0.975) + t.ppf(0.8)))
    assert set(gap_differences(*pair)) == set(GAP_TERMS)


def test_the_difference_of_logits_is_the_interaction_of_a_joint_logit(pair):
    design, left = joint(*(who_first_data(group.trials) for group in pair))
    fit = Logit(left, design).fit(disp=0)
    for term, found in who_first_differences(*pair).items():
        at = 3 + WHO_FIRST_TERMS.index(term)
        assert found.by == "logit"
        assert found.value == pytest.approx(fit.params[at], abs=1e-6)
        assert (found.low, found.high) == pytest.approx(tuple(fit.conf_int()[at]), abs=1e-5)
        assert found.p == pytest.approx(fit.pvalues[at], abs=1e-5)
        assert found.detectable == pytest.approx(fit.bse[at] * (1.959964 + 0.841621), rel=1e-4)


@pytest.fixture(scope="module")
def separated(tmp_path_factory):
    """A separated baseline, and a variant in which who is ahead yields."""
    drives = [d for d in yielding("o3", reps=4) if d.condition != "N_0_0"]
    drives += [
        Drive("o3", "A2", d.condition, d.rep, d.right, d.left)
        if d.condition != "N_0_0"
        else replace(d, variant="A2")
        for d in yielding("o3", reps=4)
    ]
    path = tmp_path_factory.mktemp("separated") / "t.duckdb"
    return Study(write_study(path, drives))


def test_a_difference_of_separated_fits_is_not_estimable_and_has_no_number(separated):
    baseline, variant = separated.models
    assert "separation" in fits(baseline).logit.problem
    assert who_first_differences(variant, baseline) == {}
    (table,) = make_tables(separated, NAMES[:1])
    rows = [row for row in table.rows if row.id.startswith(f"{variant.id}/")]
    assert len(rows) == 3
    for row in rows:
        assert "difference" not in row.values
        assert "no difference from o3/baseline: separation: no finite estimate" in row.note


def test_swapped_groups_differ_by_as_much_the_other_way(separated, pair):
    for compare, (one, other) in (
        (gap_differences, pair),
        (gap_differences, tuple(separated.models)),
        (who_first_differences, pair),
    ):
        ahead, back = compare(one, other), compare(other, one)
        assert ahead
        for term, found in ahead.items():
            assert back[term].value == pytest.approx(-found.value, abs=1e-3)
            assert back[term].p == pytest.approx(found.p, abs=1e-3)
            assert back[term].low == pytest.approx(-found.high, abs=2e-3)


@pytest.mark.parametrize("name", NAMES)
def test_every_group_has_a_row_a_term_and_only_variants_a_difference(study, tables, name):
    table = tables[name]
    terms = WHO_FIRST_TERMS if name == NAMES[0] else GAP_TERMS
    assert [row.id for row in table.rows] == [f"{g.id}/{t}" for t in terms for g in study.groups]
    for row in table.rows:
        assert (row.values.get("difference") is not None) == ("/A" in row.id)
        assert row.references == (("o3/baseline",) if "/A" in row.id else ())


@pytest.mark.parametrize(("name", "paper"), [*zip(NAMES, ("who-first", "gap"), strict=True)])
def test_coefficients_are_those_of_tables_iii_and_iv_with_their_intervals(tables, name, paper):
    for row in tables[paper].rows:
        for column in ("n", "b", "se", "p", "firth_b", "firth_p", "hc3_se", "hc3_p"):
            assert value(tables[name], row.id, column) == row.values.get(column)
        interval = value(tables[name], row.id, "ci")
        if interval is not None:
            width = (interval[1] - interval[0]) / 2 / row.values["se"]
            assert 1.95 < width < 2.03
            assert sum(interval) / 2 == pytest.approx(row.values["b"])


def test_a_term_over_the_variants_of_a_driver_is_a_family(tables):
    for name, terms in zip(NAMES, (WHO_FIRST_TERMS, GAP_TERMS), strict=True):
        for term in terms:
            rows = [f"o3/{setting}/{term}" for setting in ("A1", "A2")]
            holm, bh = corrected([value(tables[name], row, "difference_p") for row in rows])
            assert [value(tables[name], row, "p_holm") for row in rows] == list(holm)
            assert [value(tables[name], row, "p_bh") for row in rows] == list(bh)


def test_a_difference_explains_both_groups_and_a_coefficient_its_own(study, tables):
    for column, expected in (("b", ["o3/A2"]), ("difference_p", ["o3/baseline", "o3/A2"])):
        found = explain(study, tables["gap-variants"], f"o3/A2/intercept:{column}")
        assert [source.group for source in found.sources] == expected


WORDS = {
    "no baseline": (
        [*yielding("o3", "A1"), *yielding("other", reps=1)],
        "no difference: its driver has no baseline prompt to compare with",
    ),
    "a baseline of two trials": (
        [*yielding("o3", "A1"), *yielding("o3", reps=1)[3:5]],
        "no difference from o3/baseline: 2 finished trials",
    ),
    "a variant of collisions": (
        [
            *yielding("o3"),
            *(Drive("o3", "A1", name, 1, (0.0,), (0.0,)) for name in CONDITIONS),
        ],
        "no finished trial",
    ),
}


@pytest.mark.parametrize("case", WORDS)
def test_where_there_is_no_difference_the_table_says_why(case, tmp_path):
    drives, words = WORDS[case]
    for table in make_tables(Study(write_study(tmp_path / "t.duckdb", drives)), NAMES):
        rows = [row for row in table.rows if row.id.startswith("o3/A1/")]
        assert all("difference" not in row.values and row.note for row in rows)
        assert any(words in row.note for row in rows)
