"""The table of effects: two drivers, families, measures of plug-ins, and its views."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from statsmodels.stats.contingency_tables import StratifiedTable
from statsmodels.stats.multitest import multipletests

from merge_runner.errors import UsageError
from merge_runner.registry import Catalogue, using
from merge_runner.run.plan import make_plan
from merge_runner.study.file import MEASURES, StudyText
from merge_runner_analysis.frames import load
from merge_runner_analysis.metrics import COLLISIONS, LEFT_FIRST, METRICS
from merge_runner_analysis.selection import Selection
from merge_runner_analysis.stats.effects import driver_effects, effects
from merge_runner_analysis.stats.study_file import primary
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables import effect_notes
from merge_runner_analysis.tables.comparison import comparison
from tests.support.harness import FAST
from tests.support.studies import changed, scaled, write_study, yielding
from tests.support.tables import made, values_of


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """Two models of one prompt, the second of which brakes less and collides more."""
    drives = [
        *scaled(yielding("one", reps=5), 1.0, {5}),
        *scaled(yielding("two", reps=5), 0.8, {3, 4, 5}),
    ]
    return StudyResults(write_study(tmp_path_factory.mktemp("two") / "t.duckdb", drives))


def test_two_models_differ_by_an_independent_test_with_one_p_on_every_page(two):
    one, other = two.models
    between = {each.metric.name: each for each in driver_effects(two, other, one)}
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
        if row is None or row["p"] is None:  # a median; or some trials are undecided
            continue
        found = effect.difference
        assert (row["difference"], row["ci"], row["p"]) == (found.value, found.bounds(), found.p)
        assert row["p_corrected"] == effect.p_corrected
        values = effect.at_level.value, effect.at_reference.value
        assert (row["estimate"], row["estimate_reference"]) == values
        assert values[0] - values[1] == pytest.approx(found.value)


def test_a_comparison_counts_the_tests_that_holm_counts(tmp_path):
    drives = [*yielding("one", reps=5), *scaled(yielding("two", reps=5), 0.8)]
    study = StudyResults(write_study(tmp_path / "t.duckdb", drives))
    table = comparison(study, *(group.id for group in study.models))
    tests = [row.values for row in table.rows if row.values["p"] is not None]
    surest = min(tests, key=lambda of: of["p"])
    counted = round(surest["p_corrected"] / surest["p"])
    (note,) = table.notes
    same = [
        of for of in tests if {round(of["value"]), round(of["value_reference"])} in ({0}, {100})
    ]
    assert (len(tests), len(same)) == (counted + 2, 2)
    assert note == (
        f"Corrected for {counted} tests (Holm), without those in which nothing varies within a "
        "situation."
    )


def test_the_driver_that_is_named_first_is_the_reference(two):
    turned = values_of(StudyResults(two.db, Selection(["two", "one"])), "effects")
    row, same = turned["model=one/gap_m"], values_of(two, "effects")["model=two/gap_m"]
    assert (row["reference"], row["difference"]) == ("two", pytest.approx(-same["difference"]))


def test_every_interval_leaves_0_out_exactly_where_its_p_is_below_5_percent(two, played):
    for study in (two, StudyResults(played.db)):
        tested = [one.difference for one in effects(study) if one.difference.p is not None]
        assert tested
        for one in tested:
            assert (one.p < 0.05) == (one.low > 0 or one.high < 0)


def test_a_primary_measure_is_a_family_of_its_own(played):
    found = effects(StudyResults(played.db))
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
    for name in ("mine.py", "models.toml"):
        (tmp_path / name).write_text((played.folder / name).read_text())
    file = tmp_path / "mine.toml"
    tested = {name: one for name, one in METRICS.items() if one.estimator != "median"}
    expected = {"goes_first": LEFT_FIRST, "collided": COLLISIONS, **tested}
    assert sorted(expected) == sorted(MEASURES)
    for named in ("gap_m", "goes_first", "collided"):
        file.write_text(f'primary = "{named}"\n' + text)
        assert primary(StudyResults(played.db, Selection(file=str(file)))) is expected[named]
        with using(Catalogue(file.read_text())):  # as in the explorer, which chooses no study
            assert primary(StudyResults(played.db)) is expected[named]
    file.write_text('primary = "duration_s"\n' + text)  # the plug-in's own
    assert make_plan(str(file), trust=True).study.file.primary == "duration_s"
    file.write_text('primary = "mood"\n' + text)
    with pytest.raises(UsageError, match="unknown measure 'mood'; valid: goes_first"):
        primary(StudyResults(played.db, Selection(file=str(file))))


def test_a_plugins_metric_has_effects_too(played):
    of_study = ("--study", "mine.toml", "--trust", "--format", "csv")
    out = played.run("tables", "effects", "factors", *of_study).out
    assert "opponent=sleepy/duration_s,opponent,scripted,sleepy,self,duration (s)," in out
    assert "temperature=0.2/duration_s," in out.partition("# factors")[2]


def test_replies_of_a_trial_count_as_one_observation(tmp_path):
    """The share is that of all replies, its error that of as many trials as there are."""
    drives = [*yielding("one", reps=5), *scaled(yielding("two", reps=5), 0.9)]
    invalid = (
        "UPDATE decisions SET valid = (decision + length(trial_id)) % 3 > 0 "
        "WHERE trial_id LIKE 'two/%' AND trial_id LIKE '%rep02%'"
    )
    keyed = "UPDATE decisions SET call_key = 'k' || trial_id || side || decision"
    study = changed(write_study(tmp_path / "t.duckdb", drives), keyed, invalid)
    found = {one.metric.name: one for one in effects(study)}["valid_percent"]
    replies = study.frames.trials.groupby("driver")[["valid_replies", "replies"]].sum()
    shares = 100 * replies["valid_replies"] / replies["replies"]
    assert found.at_level.value == pytest.approx(shares["two"], abs=3)
    assert found.difference.value == pytest.approx(shares["two"] - shares["one"], abs=3)
    assert found.at_level.n == 55
    assert found.difference.freedom < 110


def test_trials_of_unknown_cost_are_left_out_with_a_word(tmp_path):
    drives = [replace(d, said={}) for name in ("one", "two") for d in yielding(name, reps=5)]
    unknown = "UPDATE calls SET cost_usd = NULL WHERE trial_id LIKE 'two/%rep02%'"
    study = changed(write_study(tmp_path / "t.duckdb", drives), unknown)
    row = next(row for row in made(study, "effects").rows if row.id == "model=two/cost_usd")
    assert (row.values["n"], row.values["n_reference"]) == (44, 55)
    assert "11 of 55 ended trials of model=two have no value and are left out" in row.note


HURRY = """
models = ["emulator"]
repetitions = 12
conditions = ["N_0_0", "L_4_0", "R_-4_0"]
mirror = true
[factors]
hurry = ["no", "yes"]
[texts.hurry.yes]
add = [{ after = "C3.human", text = "You are in a hurry." }]
given_to = "ego"
emulator = { own_first = 1.5 }
"""
SHARES = """
SELECT focal, condition, count(*) FILTER (merged_first = 'left') AS k, count(*) AS n
FROM trials WHERE status = 'finished' GROUP BY ALL
"""


def test_the_one_in_a_hurry_is_compared_with_the_one_on_the_same_side(prepare, tmp_path):
    (tmp_path / "hurry.toml").write_text(HURRY)
    done = prepare(tmp_path, "sweep", "hurry.toml", "--db", "t.duckdb", *FAST, code=0)
    # What is planted makes several clients of one model, which share what they asked.
    assert "from the cache" not in done.out
    study = StudyResults(tmp_path / "t.duckdb")
    (found,) = [one for one in effects(study) if one.primary]
    counts = load(SHARES, study.db).fillna({"focal": ""}).set_index(["focal", "condition"])
    apart, weights = [], []
    for condition in ("N_0_0", "L_4_0", "R_-4_0"):
        k_none, m = counts.loc[("", condition)]
        for side in ("left", "right"):
            k, n = counts.loc[(side, condition)]
            own, other = (k, k_none) if side == "left" else (n - k, m - k_none)
            apart.append(own / n - other / m)
            weights.append(n * m / 2 / (n + m / 2))  # each of m stands on both sides
    assert found.difference.value == pytest.approx(100 * np.average(apart, weights=weights))
    assert found.difference.low > 0
    assert found.p_corrected == found.difference.p < 0.001
    assert found.at_level.value - found.at_reference.value == pytest.approx(found.difference.value)
    assert found.at_reference.value == pytest.approx(50, abs=5)
    assert (found.at_level.n, found.at_reference.n) == tuple(
        counts.groupby(counts.index.get_level_values(0) == "")["n"].sum()
    )


def test_a_note_says_which_cells_only_who_goes_first_has(prepare, tmp_path):
    conditions = HURRY.replace('"N_0_0", "L_4_0", "R_-4_0"', '"L_4_0"').replace("12", "2")
    (tmp_path / "hurry.toml").write_text(conditions)
    prepare(tmp_path, "sweep", "hurry.toml", "--db", "t.duckdb", *FAST, code=0)
    study = StudyResults(tmp_path / "t.duckdb")
    note = "every level has the same 2 cells for who goes first, where trials of equal drivers"
    assert (
        f"hurry: {note} also count in the mirrored cell of the other side; for other measures they "
        "share 1" in made(study, "effects").notes
    )
    found = {one.metric.name: one.at_level.n for one in effects(study)}
    assert (found["left_first_percent"], found["collided_percent"]) == (4, 2)


def test_a_planted_gap_is_no_chance_whatever_its_factor_is_named(monkeypatch):
    study = SimpleNamespace(models=[SimpleNamespace(scripted=True)])
    text = StudyText(remove=["C4"], emulator={"gap_m": 2})
    monkeypatch.setattr(effect_notes, "texts_of", lambda _: {"chance": {"high": text}})
    assert effect_notes._planted(study) == ["chance=high adds 2 m to the gap that drivers aim at"]


def test_a_study_without_factors_says_so(tmp_path):
    study = StudyResults(write_study(tmp_path / "t.duckdb", yielding("o3", reps=1)))
    table = made(study, "effects")
    assert (table.rows, table.notes[0]) == ([], "the trials of judged drivers differ in no factor")
