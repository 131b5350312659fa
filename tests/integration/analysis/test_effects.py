"""The table of effects: two drivers, families, measures of plug-ins, and its views."""

from dataclasses import replace

import numpy as np
import pytest
from statsmodels.stats.contingency_tables import StratifiedTable
from statsmodels.stats.multitest import multipletests

from merge_runner.errors import UsageError
from merge_runner_analysis.selection import Selection
from merge_runner_analysis.stats.effects import compared, effects, primary
from merge_runner_analysis.study import Study
from tests.support.studies import changed, write_study, yielding
from tests.support.tables import made, values_of


def braking(driver, share, crashes=()):
    """Five repetitions of a driver with another strength, which collides in some of them."""
    drives = []
    for drive in yielding(driver, reps=5):
        sides = {s: tuple(share * x for x in getattr(drive, s)) for s in ("left", "right")}
        if drive.rep in crashes:
            sides = {"left": (0.0,), "right": (0.0,)}
        drives.append(replace(drive, **sides))
    return drives


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """Two models of one prompt, the second of which brakes less and collides more."""
    drives = [*braking("one", 1.0, {5}), *braking("two", 0.8, {3, 4, 5})]
    return Study(write_study(tmp_path_factory.mktemp("two") / "t.duckdb", drives))


def test_two_models_differ_by_an_independent_test_with_one_p_on_every_page(two):
    one, other = two.models
    between = {each.metric.name: each for each in compared(two, other, one)}
    rows = values_of(two, "effects")
    counts = [
        group.ended.groupby("condition")["collided"].agg(["sum", "size"]).astype(int)
        for group in (other, one)
    ]
    tables = [
        np.array([[a, n - a], [b, m - b]])
        for (a, n), (b, m) in zip(*(c.to_numpy() for c in counts), strict=True)
    ]
    p = StratifiedTable(tables).test_null_odds(correction=False).pvalue
    assert between["collided_percent"].difference.p == pytest.approx(p)
    for name, effect in between.items():
        row = rows.get(f"model=two/{name}")
        if row is None:  # a median
            continue
        found = effect.difference
        assert (row["difference"], row["ci"], row["p"]) == (found.value, found.bounds(), found.p)
        assert row["p_corrected"] == effect.p_corrected
        assert (row["estimate"], row["estimate_reference"]) == (
            effect.at_level.value, effect.at_reference.value,
        )  # fmt: skip


def test_every_interval_leaves_0_out_exactly_where_its_p_is_below_5_percent(two, played):
    for study in (two, Study(played.db)):
        tested = [one.difference for one in effects(study) if one.difference.p is not None]
        assert tested
        for one in tested:
            assert (one.p < 0.05) == (one.low > 0 or one.high < 0)


def test_a_primary_measure_is_a_family_of_its_own(played):
    found = effects(Study(played.db))
    for own in (True, False):
        family = [
            one for one in found
            if one.primary is own and one.difference.p is not None and one.difference.se
        ]  # fmt: skip
        corrected = multipletests([one.difference.p for one in family], method="holm")[1]
        assert [one.p_corrected for one in family] == pytest.approx(list(corrected))
    assert {one.level.factor for one in found if one.primary} == {"opponent", "temperature"}
    assert {one.metric.name for one in found if one.primary} == {"left_first_percent"}


def test_a_study_names_its_primary_measure(played, tmp_path):
    text = (played.folder / "mine.toml").read_text()
    (tmp_path / "mine.py").write_text((played.folder / "mine.py").read_text())
    file = tmp_path / "mine.toml"
    for named, expected in (("gap_m", "gap_m"), ("goes_first", "left_first_percent")):
        file.write_text(f'primary = "{named}"\n' + text)
        assert primary(Study(played.db, Selection(file=str(file)))).name == expected
    file.write_text('primary = "mood"\n' + text)
    with pytest.raises(UsageError, match="unknown measure 'mood'; valid: goes_first"):
        primary(Study(played.db, Selection(file=str(file))))


def test_a_plugins_metric_has_effects_too(played):
    out = played.run("tables", "effects", "--study", "mine.toml", "--trust", "--format", "csv").out
    assert "temperature=0.2/duration_s,temperature,0.2,1.0,duration (s)," in out
    out = played.run("tables", "factors", "--study", "mine.toml", "--trust", "--format", "csv").out
    assert "temperature=0.2/duration_s," in out


def test_replies_of_a_trial_count_as_one_observation(tmp_path):
    """The share is that of all replies, its error that of as many trials as there are."""
    drives = [*braking("one", 1.0), *braking("two", 0.9)]
    invalid = (
        "UPDATE decisions SET valid = (decision + length(trial_id)) % 3 > 0 "
        "WHERE trial_id LIKE 'two/%' AND trial_id LIKE '%rep02%'"
    )
    keyed = "UPDATE decisions SET call_key = 'k' || trial_id || side || decision"
    study = changed(write_study(tmp_path / "t.duckdb", drives), keyed, invalid)
    found = {one.metric.name: one for one in effects(study)}["valid_percent"]
    replies = study.frames.trials.groupby("driver")[["valid_replies", "replies"]].sum()
    shares = 100 * replies["valid_replies"] / replies["replies"]
    assert found.at_level.value == pytest.approx(shares["two"])
    assert (found.at_level.k, found.at_level.weight) == tuple(replies.loc["two"])
    assert found.difference.value == pytest.approx(shares["two"] - shares["one"], abs=3)
    assert found.n == 55
    assert found.difference.freedom < 110


def test_a_study_without_factors_says_so(tmp_path):
    study = Study(write_study(tmp_path / "t.duckdb", yielding("o3", reps=1)))
    table = made(study, "effects")
    assert (table.rows, table.notes[0]) == ([], "the trials of judged drivers differ in no factor")
