"""A study by its factors: its groups, its tables, its audit, and what its plug-in adds."""

import json
from dataclasses import replace

import duckdb
import pytest
from statsmodels.stats.multitest import multipletests

from merge_runner.errors import UsageError
from merge_runner_analysis.commands import drivers
from merge_runner_analysis.explain import explain
from merge_runner_analysis.selection import Selection
from merge_runner_analysis.stats.levels import levels_by_factor
from merge_runner_analysis.study import StudyResults
from tests.support.crossed_study import PLUGIN
from tests.support.studies import changed, write_study, yielding
from tests.support.tables import by_id, made, notes_with, values_of

CHEAP_COLD = "cheap+sleepy [temperature=0.2]"


@pytest.fixture(scope="module")
def study(played, tmp_path_factory):
    """The study as if language models had answered, and no mock model."""
    db = tmp_path_factory.mktemp("factors") / "t.duckdb"
    db.write_bytes(played.db.read_bytes())
    return changed(db, "UPDATE trials SET scripted = false", "UPDATE calls SET scripted = false")


@pytest.fixture(scope="module")
def factors(study):
    return made(study, "factors")


@pytest.fixture(scope="module")
def rows(factors):
    return {row.id: row.values for row in factors.rows}


@pytest.fixture
def copy(played, tmp_path):
    (tmp_path / "t.duckdb").write_bytes(played.db.read_bytes())
    return tmp_path / "t.duckdb"


def test_the_summary_of_a_sweep_counts_by_model_and_by_each_factor(played):
    (played.folder / "again.duckdb").write_bytes(played.db.read_bytes())
    again = played.run("sweep", "mine.toml", "--yes", "--trust", "--json", db="again.duckdb")
    outcomes = again.summary["outcomes_by_level"]
    trials = {(one["factor"], one["level"]): one["trials"] for one in outcomes}
    counted = {
        ("model", "cheap"): 24, ("model", "dear"): 12,
        ("temperature", "1.0"): 18, ("temperature", "0.2"): 18,
        ("opponent", "self"): 24, ("opponent", "sleepy"): 12,
    }  # fmt: skip
    assert counted.items() <= trials.items()


def test_conditions_of_another_mean_speed_stay_in_the_group_of_their_driver(study):
    names = {f"{model} [temperature={t}]" for model in ("cheap", "dear") for t in ("0.2", "1.0")}
    names |= {CHEAP_COLD, "cheap+sleepy [temperature=1.0]"}
    assert {group.driver for group in study.models} == names
    for group in study.models:
        assert set(group.trials["condition"]) == {"N_0_0", "L_4_0", "X_0_15"}
        assert group.trials["spec_hash"].nunique() == 2


def test_two_mean_speeds_of_one_condition_are_never_pooled(copy):
    study = changed(
        copy,
        *(
            f"INSERT INTO {table} SELECT * REPLACE ('again/' || trial_id AS trial_id, "
            f"'faster' AS spec_hash) FROM {table} WHERE trial_id LIKE '%X_0_15%'"
            for table in ("trials", "states", "decisions", "calls", "trial_factors")
        ),
        "INSERT INTO specs SELECT 'faster', json_merge_patch(spec, '{\"mean_speed_mps\": 12}') "
        "FROM specs WHERE spec->>'$.mean_speed_mps' IS NOT NULL LIMIT 1",
    )
    for group in study.models:
        assert (group.trials.groupby("condition")["spec_hash"].nunique() == 1).all(), group.id


def test_where_keeps_the_trials_of_these_levels_and_names_the_valid_ones(played):
    kept = StudyResults(played.db, Selection(where={"temperature": ["0.2"], "model": ["cheap"]}))
    assert [group.driver for group in kept.models] == ["cheap [temperature=0.2]", CHEAP_COLD]
    assert kept.groups[0].id == "human"
    for where, says in (
        ({"mood": ["good"]}, "unknown factor 'mood'; valid: model, prompt, opponent, "),
        ({"temperature": ["0.3"]}, "unknown level of temperature '0.3'; valid: 1.0, 0.2"),
        ({"model": ["dear"], "opponent": ["sleepy"]}, "no trial with model=dear and opponent="),
    ):
        with pytest.raises(UsageError, match=says):
            StudyResults(played.db, Selection(where=where))
    for level, other in (("0.2", "1.0"), ("1.0", "0.2")):  # the first is kept, and not shown
        out = played.run("tables", "ablation-quantitative", "--where", f"temperature={level}").out
        assert f"cheap [temperature={level}]" in out
        assert f"temperature={other}" not in out


def test_a_driver_whose_name_has_commas_and_brackets_can_be_chosen(played):
    assert drivers("human, a [x=1, y=2],b") == ["human", "a [x=1, y=2]", "b"]
    found = played.run("tables", "attempts", "--models", CHEAP_COLD, "--format", "json")
    (table,) = json.loads(found.out)["tables"]
    assert [row["row"] for row in table["rows"]] == [f"{CHEAP_COLD}/baseline"]


def test_a_levels_row_pools_its_trials_and_is_compared_with_the_first_level(played, rows):
    with duckdb.connect(str(played.db), read_only=True) as connection:
        counts = connection.execute(
            "SELECT value, count(*) FILTER (status = 'collided'), count(*) FROM trials JOIN "
            "trial_factors USING (trial_id, spec_hash) WHERE factor = 'opponent' GROUP BY ALL"
        ).fetchall()
    rates = {level: 100 * collided / trials for level, collided, trials in counts}
    found = {level: rows[f"opponent={level}/collided_percent"] for level in rates}
    assert {level: row["value"] for level, row in found.items()} == pytest.approx(rates)
    apart = rates["sleepy"] - rates["self"]
    low, high = found["sleepy"]["difference_ci"]
    assert found["sleepy"]["difference"] == pytest.approx(apart)
    assert low < apart < high
    assert found["self"]["trials"] == 24
    levels = [row["level"] for name, row in rows.items() if name.endswith("/gap_m")]
    assert levels == ["cheap", "dear", "self", "sleepy", "1.0", "0.2"]


def test_a_level_is_compared_with_the_reference_of_the_study(played, study, rows, tmp_path):
    text = (played.folder / "mine.toml").read_text()
    (tmp_path / "mine.py").write_text(PLUGIN)
    file = tmp_path / "mine.toml"
    file.write_text('reference = { temperature = 0.2, model = "dear" }\n' + text)
    chosen = values_of(StudyResults(study.db, Selection(file=str(file))), "factors")
    assert rows["temperature=0.2/gap_m"]["difference"] == pytest.approx(
        -chosen["temperature=1.0/gap_m"]["difference"]
    )
    assert chosen["temperature=0.2/gap_m"].get("difference") is None
    levels = [row["level"] for name, row in chosen.items() if name.endswith("/gap_m")]
    assert levels == ["dear", "cheap", "self", "sleepy", "0.2", "1.0"]


def test_a_comparison_has_one_corrected_p_wherever_it_is_printed(tmp_path):
    """Also of a level that lacks a condition, since the test is one within shared conditions."""
    drives = [d for d in yielding("o3", reps=4) if d.condition in {"N_0_0", "L_4_0", "R_-4_8"}]
    for variant, share in (("A1", 0.5), ("A2", 0.9), ("A3", 1.1)):
        drives += [
            replace(d, variant=variant, left=tuple(share * x for x in d.left))
            for d in drives[:12]
            if (variant, d.condition) != ("A2", "N_0_0")
        ]
    study = StudyResults(write_study(tmp_path / "t.duckdb", drives))
    levels, families = made(study, "factors"), {}
    for name, row in values_of(study, "contrasts").items():
        _, variant, _, measure = name.split("/")
        same = by_id(levels)[f"prompt={variant}/{measure}"].values
        for one, other in (("p", "p"), ("p_holm", "p_holm"), ("ci", "difference_ci")):
            assert same[other] == pytest.approx(row[one])
        low, high = row["ci"]
        assert (row["p"] < 0.05) == (not low <= 0 <= high)
        # Who goes first is what a study asks unless it says otherwise; the rest is one family.
        if row["p"] < 1:
            primary = measure == "left_first_percent"
            families.setdefault(primary, []).append((row["p"], row["p_holm"]))
    for family in families.values():
        p, p_holm = zip(*family, strict=True)
        assert len(family) >= 2
        assert list(p_holm) == pytest.approx(multipletests(p, method="holm")[1])
    assert (
        by_id(made(study, "effects"))["prompt=A1/gap_m"].values["p_corrected"]
        == (by_id(levels)["prompt=A1/gap_m"].values["p_holm"])
    )
    assert notes_with(levels, "prompt: not balanced")


def test_factors_are_shown_at_each_level_of_another_one_with_interactions(played, study):
    study = StudyResults(study.db, Selection(by="opponent"))
    table = made(study, "factors")
    rows = {row.id: row.values for row in table.rows}
    at_self, at_sleepy = (rows[f"opponent={n}/temperature=0.2/gap_m"] for n in ("self", "sleepy"))
    assert (at_self["trials"], at_sleepy["trials"]) == (12, 6)
    row = "opponent=sleepy/temperature=0.2/interaction/gap_m"
    assert (rows[row]["at"], rows[row]["factor"]) == ("sleepy - self", "temperature × opponent")
    assert all(source.trials for source in explain(study, table, row).sources)
    wrong = played.run("tables", "factors", "--by", "mood")
    assert "unknown factor 'mood'; valid: model, prompt, opponent, temperature" in wrong.err


def test_an_interaction_is_the_difference_of_the_differences_in_shared_cells(tmp_path):
    """o3 has two prompts in two moods; in the second mood the second prompt brakes harder.

    The first prompt has one repetition less in the first mood.
    """
    drives = []
    for drive in [*yielding("o3", reps=4), *yielding("o3", "A1", 4)]:
        lacking = drive.variant == "baseline" and drive.rep == 1
        if drive.condition not in {"N_0_0", "L_4_0", "R_-4_8"} or lacking:
            continue
        hard = drive.variant == "A1" and drive.rep % 2 == 0
        drives.append(replace(drive, right=tuple(x * (0.5 + 0.25 * hard) for x in drive.right)))
    moody = changed(
        write_study(tmp_path / "t.duckdb", drives),
        "INSERT INTO trial_factors SELECT trial_id, spec_hash, 'mood', "
        "if(rep % 2 = 0, 'late', 'early'), false FROM trials",
    )
    rows = values_of(StudyResults(moody.db, Selection(by="mood")), "factors")
    late, early = (rows[f"mood={m}/prompt=A1/gap_m"]["difference"] for m in ("late", "early"))
    found = rows["mood=late/prompt=A1/interaction/gap_m"]
    assert found["difference"] == pytest.approx(late - early)
    assert abs(found["difference"]) > 0.1
    low, high = found["difference_ci"]
    assert low < found["difference"] < high
    assert (found["p"] < 0.05) == (low > 0 or high < 0)
    effects = made(StudyResults(moody.db), "effects")
    (note,) = notes_with(effects, "p is corrected")
    # Of 13 others the 4 of crashes and both changing their speed vary nowhere, as 3 interactions.
    assert note.endswith(
        "for the 6 other tests of the table effects, without those in which nothing varies within "
        "a situation: 2 by prompt, 2 by mood and 2 by prompt × mood (interaction), in gap at the "
        "merge point and deviation from the initial speed"
    )
    row = by_id(effects)["mood=late/prompt=A1/interaction/gap_m"].values
    assert (row["level"], row["n"]) == ("A1 × late", 6)
    assert (row["reference"], row["n_reference"]) == ("baseline × early", 3)
    # By the other factor it is the same.
    turned = values_of(StudyResults(moody.db, Selection(by="prompt")), "factors")
    same = turned["prompt=A1/mood=late/interaction/gap_m"]["difference"]
    assert same == pytest.approx(found["difference"])


def test_means_are_compared_within_the_cells_that_both_levels_have_and_the_notes_say_which(
    played, study, factors, rows
):
    (note,) = notes_with(factors, "model: ")
    assert note.startswith(
        "model: not balanced, so that values over all trials are confounded: dear lacks 6 "
    )
    assert notes_with(factors, "temperature: every level has the same")
    cheap, dear = (set(level.pooled.finished["cell"]) for level in levels_by_factor(study)[0])
    assert dear < cheap
    # The same mock model answers under both names, so that equal cells hold equal trials.
    row = rows["model=dear/gap_m"]
    assert (row["difference"], row["p"]) == (pytest.approx(0, abs=1e-9), pytest.approx(1))
    assert abs(row["value"] - rows["model=cheap/gap_m"]["value"]) > 0.1


def test_stand_ins_are_never_pooled_with_models(copy):
    study = changed(
        copy,
        "UPDATE trials SET scripted = false WHERE model_left = 'dear'",
        "UPDATE calls SET scripted = false WHERE trial_id LIKE 'dear/%'",
    )
    levels = [level for levels in levels_by_factor(study) for level in levels]
    assert {level.pooled.scripted for level in levels} == {False, True}
    for level in levels:
        assert {name.startswith("dear") for name in level.groups} == {not level.pooled.scripted}
        assert level.id.endswith(" [scripted]") == level.pooled.scripted
