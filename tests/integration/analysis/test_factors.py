"""A study by its factors: its groups, its tables, its audit, and what its plug-in adds."""

from __future__ import annotations

import json
from dataclasses import replace

import duckdb
import pytest
from statsmodels.stats.multitest import multipletests

from merge_runner.errors import UsageError
from merge_runner_analysis.commands import drivers
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.explain import explain
from merge_runner_analysis.stats.factors import levels_by_factor
from merge_runner_analysis.tables import make_tables
from tests.support.crossed_study import PLUGIN
from tests.support.studies import changed, write_study, yielding

CHEAP_COLD = "cheap+sleepy [temperature=0.2]"


@pytest.fixture(scope="module")
def study(played):
    return Study(played.db)


def found(table, row_id):
    (row,) = [row for row in table.rows if row.id == row_id]
    return row.values


def value(table, row_id, column):
    return found(table, row_id)[column]


@pytest.mark.slow
def test_the_summary_of_a_sweep_counts_by_model_and_by_each_factor(played):
    blocks = [block.splitlines() for block in played.out.split("\n\n")]
    by_factor = {block[0].split()[0]: [row.split()[:2] for row in block[1:]] for block in blocks}
    assert by_factor["model"] == [["cheap", "24"], ["dear", "12"]]
    assert by_factor["temperature"] == [["1.0", "18"], ["0.2", "18"]]
    assert by_factor["opponent"] == [["self", "24"], ["sleepy", "12"]]
    (played.folder / "again.duckdb").write_bytes(played.db.read_bytes())
    again = played.run(
        "sweep", "mine.toml", "--yes", "--trust", "--json", db="again.duckdb"
    ).summary
    trials = {(one["factor"], one["level"]): one["trials"] for one in again["outcomes_by_level"]}
    assert trials["temperature", "0.2"] == 18
    assert trials["model", "dear"] == 12


def test_conditions_of_another_mean_speed_stay_in_the_group_of_their_driver(study):
    names = {f"{model} [temperature={t}]" for model in ("cheap", "dear") for t in ("0.2", "1.0")}
    assert {group.driver for group in study.models} == names | {
        CHEAP_COLD,
        "cheap+sleepy [temperature=1.0]",
    }
    for group in study.models:
        assert set(group.trials["condition"]) == {"N_0_0", "L_4_0", "X_0_15"}
        assert group.trials["spec_hash"].nunique() == 2


def test_two_mean_speeds_of_one_condition_are_never_pooled(played, tmp_path):
    copy = tmp_path / "t.duckdb"
    copy.write_bytes(played.db.read_bytes())
    with duckdb.connect(str(copy)) as connection:
        for table in ("trials", "states", "decisions", "calls", "trial_factors"):
            connection.execute(
                f"INSERT INTO {table} SELECT * REPLACE ('again/' || trial_id AS trial_id, "
                f"'faster' AS spec_hash) FROM {table} WHERE trial_id LIKE '%X_0_15%'"
            )
        connection.execute(
            "INSERT INTO specs SELECT 'faster', json_merge_patch(spec, '{\"mean_speed_mps\": 12}') "
            "FROM specs WHERE spec->>'$.mean_speed_mps' IS NOT NULL LIMIT 1"
        )
    for group in Study(copy).models:
        assert (group.trials.groupby("condition")["spec_hash"].nunique() == 1).all(), group.id


@pytest.mark.slow
def test_where_keeps_the_trials_of_these_levels_and_names_the_valid_ones(played):
    kept = Study(played.db, where={"temperature": ["0.2"], "model": ["cheap"]})
    assert [group.driver for group in kept.models] == ["cheap [temperature=0.2]", CHEAP_COLD]
    assert kept.groups[0].id == "human"
    with pytest.raises(UsageError, match="unknown factor 'mood'; valid: model, prompt, opponent, "):
        Study(played.db, where={"mood": ["good"]})
    with pytest.raises(UsageError, match=r"unknown level of temperature '0.3'; valid: 1.0, 0.2"):
        Study(played.db, where={"temperature": ["0.3"]})
    with pytest.raises(UsageError, match="no trial with model=dear and opponent=sleepy"):
        Study(played.db, where={"model": ["dear"], "opponent": ["sleepy"]})


@pytest.mark.slow
def test_tables_that_are_kept_are_those_of_their_levels(played):
    for level, other in (("0.2", "1.0"), ("1.0", "0.2")) * 2:
        asked = ("tables", "ablation-quantitative", "--where", f"temperature={level}")
        out = played.run(*asked).out
        assert f"cheap [temperature={level}]" in out
        assert f"temperature={other}" not in out


def test_a_driver_whose_name_has_commas_and_brackets_can_be_chosen(played):
    assert drivers("human, a [x=1, y=2],b") == ["human", "a [x=1, y=2]", "b"]
    found = played.run("tables", "attempts", "--models", CHEAP_COLD, "--format", "json")
    (table,) = json.loads(found.out)["tables"]
    assert [row["row"] for row in table["rows"]] == [f"{CHEAP_COLD}/baseline"]


def test_a_levels_row_pools_its_trials_and_is_compared_with_the_first_level(study, played):
    (table,) = make_tables(study, ["factors"])
    rows = duckdb.connect(str(played.db), read_only=True).execute(
        "SELECT value, count(*) FILTER (status = 'collided'), count(*) FROM trials JOIN "
        "trial_factors USING (trial_id, spec_hash) WHERE factor = 'opponent' GROUP BY ALL"
    ).fetchall()  # fmt: skip
    rates = {level: 100 * collided / trials for level, collided, trials in rows}
    for level, rate in rates.items():
        assert value(table, f"opponent={level}/collided_percent", "value") == pytest.approx(rate)
    row = "opponent=sleepy/collided_percent"
    assert value(table, row, "difference") == pytest.approx(rates["sleepy"] - rates["self"])
    low, high = value(table, row, "difference_ci")
    assert low < rates["sleepy"] - rates["self"] < high
    assert value(table, "opponent=self/collided_percent", "trials") == 24
    levels = [row.values["level"] for row in table.rows if row.id.endswith("/gap_m")]
    assert levels == ["cheap", "dear", "self", "sleepy", "1.0", "0.2"]


def test_a_level_is_compared_with_the_first_that_the_study_lists_or_with_its_reference(
    study, played, tmp_path
):
    text = (played.folder / "mine.toml").read_text()
    (tmp_path / "mine.py").write_text(PLUGIN)
    file = tmp_path / "mine.toml"
    file.write_text('reference = { temperature = 0.2, model = "dear" }\n' + text)
    (listed,), (chosen,) = (
        make_tables(known, ["factors"]) for known in (study, Study(played.db, file=str(file)))
    )
    for first, row in ((listed, "temperature=0.2/gap_m"), (chosen, "temperature=1.0/gap_m")):
        assert "difference" in {n for n, v in found(first, row).items() if v is not None}
    assert value(listed, "temperature=0.2/gap_m", "difference") == pytest.approx(
        -value(chosen, "temperature=1.0/gap_m", "difference")
    )
    assert found(chosen, "temperature=0.2/gap_m").get("difference") is None
    levels = [row.values["level"] for row in chosen.rows if row.id.endswith("/gap_m")]
    assert levels == ["dear", "cheap", "self", "sleepy", "0.2", "1.0"]


def test_a_comparison_has_one_corrected_p_wherever_it_is_printed(tmp_path):
    drives = yielding("o3", reps=5)
    for variant, share in (("A1", 0.5), ("A2", 0.9), ("A3", 1.1)):
        drives += [
            replace(d, variant=variant, left=tuple(share * x for x in d.left)) for d in drives[:55]
        ]
    contrasted, levels = make_tables(
        Study(write_study(tmp_path / "t.duckdb", drives)), ["contrasts", "factors"]
    )
    families = {}
    for row in contrasted.rows:
        _, variant, _, measure = row.id.split("/")
        same = found(levels, f"prompt={variant}/{measure}")
        assert same["p"] == pytest.approx(row.values["p"])
        assert same["p_holm"] == pytest.approx(row.values["p_holm"])
        assert same["difference_ci"] == pytest.approx(row.values["ci"])
        families.setdefault(measure, []).append((same["p"], same["p_holm"]))
    for family in families.values():
        p, p_holm = zip(*family, strict=True)
        assert list(p_holm) == pytest.approx(multipletests(p, method="holm")[1])
    assert {len(family) for family in families.values()} == {3}


def test_a_level_that_lacks_a_condition_has_the_p_of_contrasts(tmp_path):
    """The test is one within shared conditions, so that it holds all the same."""
    drives = yielding("o3", reps=5)
    for variant, share in (("A1", 0.5), ("A2", 0.9)):
        drives += [
            replace(d, variant=variant, left=tuple(share * x for x in d.left))
            for d in drives[:55]
            if (variant, d.condition) != ("A2", "N_0_0")
        ]
    contrasted, levels = make_tables(
        Study(write_study(tmp_path / "t.duckdb", drives)), ["contrasts", "factors"]
    )
    assert any(row.id.startswith("o3/A2/") for row in contrasted.rows)
    for row in contrasted.rows:
        _, variant, _, measure = row.id.split("/")
        same = found(levels, f"prompt={variant}/{measure}")
        assert same["p"] == pytest.approx(row.values["p"])
        assert same["p_holm"] == pytest.approx(row.values["p_holm"])
    assert any(note.startswith("prompt: not balanced") for note in levels.notes)


@pytest.mark.slow
def test_factors_are_shown_at_each_level_of_another_one_with_interactions(played):
    made = played.run("tables", "factors", "--by", "opponent", "--json")
    (table,) = json.loads(made.out)["tables"]
    rows = {row["row"]: row for row in table["rows"]}
    at_self, at_sleepy = (rows[f"opponent={n}/temperature=0.2/gap_m"] for n in ("self", "sleepy"))
    assert (at_self["trials"], at_sleepy["trials"]) == (12, 6)
    between = rows["opponent=sleepy/temperature=0.2/interaction/gap_m"]
    assert (between["at"], between["factor"]) == ("sleepy - self", "temperature × opponent")
    row = "opponent=sleepy/temperature=0.2/interaction/gap_m"
    told = json.loads(played.run("explain", "factors", row, "--by", "opponent", "--json").out)
    assert [len(source["trials"]) for source in told["sources"]]
    wrong = played.run("tables", "factors", "--by", "mood")
    assert "unknown factor 'mood'; valid: model, prompt, opponent, temperature" in wrong.err


@pytest.fixture
def moody(tmp_path):
    """o3 with two prompts in two moods; in the second mood the second prompt brakes harder."""
    drives = []
    for drive in [*yielding("o3", reps=8), *yielding("o3", "A1", 8)]:
        hard = drive.variant == "A1" and drive.rep % 2 == 0
        right = tuple(x * (0.5 + 0.25 * hard) for x in drive.right)
        drives.append(replace(drive, right=right))
    db = write_study(tmp_path / "t.duckdb", drives)
    return changed(
        db,
        "INSERT INTO trial_factors SELECT trial_id, spec_hash, 'mood', "
        "if(rep % 2 = 0, 'late', 'early') FROM trials",
    )


def test_an_interaction_is_the_difference_of_the_differences_in_shared_cells(moody):
    study = Study(moody.db, by="mood")
    (table,) = make_tables(study, ["factors"])
    name = "mood=late/prompt=A1"
    parts = [
        value(table, f"mood={mood}/prompt=A1/gap_m", "difference") for mood in ("late", "early")
    ]
    found = value(table, f"{name}/interaction/gap_m", "difference")
    assert found == pytest.approx(parts[0] - parts[1])
    assert abs(found) > 0.1
    low, high = value(table, f"{name}/interaction/gap_m", "difference_ci")
    assert low < found < high
    assert (value(table, f"{name}/interaction/gap_m", "p") < 0.05) == (low > 0 or high < 0)
    # By the other factor it is the same.
    (turned,) = make_tables(Study(moody.db, by="prompt"), ["factors"])
    same = value(turned, "prompt=A1/mood=late/interaction/gap_m", "difference")
    assert same == pytest.approx(found)


def test_the_notes_say_which_cells_a_level_lacks(study):
    (table,) = make_tables(study, ["factors"])
    (note,) = [note for note in table.notes if note.startswith("model: ")]
    assert note.startswith(
        "model: not balanced, so that values over all trials are confounded: dear lacks 6 "
    )
    assert value(table, "model=dear/gap_m", "difference_ci")
    assert value(table, "model=dear/gap_m", "p") == pytest.approx(1)
    assert any(note.startswith("temperature: every level has the same") for note in table.notes)


def test_means_are_compared_within_the_cells_that_both_levels_have(study):
    (table,) = make_tables(study, ["factors"])
    cheap, dear = (
        {cell: gaps["gap_m"].mean() for cell, gaps in level.pooled.finished.groupby("cell")}
        for level in levels_by_factor(study)[0]
    )
    # The same stand-in answers under both names, so that equal cells hold equal trials.
    assert set(dear) < set(cheap)
    assert value(table, "model=dear/gap_m", "difference") == pytest.approx(0, abs=1e-9)
    pooled = [value(table, f"model={name}/gap_m", "value") for name in ("cheap", "dear")]
    assert abs(pooled[1] - pooled[0]) > 0.1


@pytest.mark.slow
def test_a_level_leads_to_its_trials(study):
    (table,) = make_tables(study, ["factors"])
    found = explain(study, table, "opponent=sleepy/collided_percent")
    assert sum(len(source.trials) for source in found.sources) == 12
    with duckdb.connect(str(study.db), read_only=True) as connection:
        for source in found.sources:
            listed = connection.execute(source.query).fetchall()
            assert tuple(trial for trial, *_ in listed) == source.trials


def test_stand_ins_are_never_pooled_with_models(played, tmp_path):
    copy = tmp_path / "t.duckdb"
    copy.write_bytes(played.db.read_bytes())
    with duckdb.connect(str(copy)) as connection:
        connection.execute("UPDATE trials SET scripted = false WHERE model_left = 'dear'")
        connection.execute("UPDATE calls SET scripted = false WHERE trial_id LIKE 'dear/%'")
    found = levels_by_factor(Study(copy))
    assert {level.pooled.scripted for levels in found for level in levels} == {False, True}
    for level in (level for levels in found for level in levels):
        assert {name.startswith("dear") for name in level.groups} == {not level.pooled.scripted}
        assert level.id.endswith(" [scripted]") == level.pooled.scripted


@pytest.mark.slow
def test_a_metric_of_the_studys_plug_in_is_shown_only_where_the_study_is_named(played):
    plain = played.run("tables", "factors")
    assert "duration" not in plain.out
    named = played.run("tables", "factors", "--study", "mine.toml", "--trust")
    assert "duration (s)" in named.out, named.err
    edited = PLUGIN.replace('label="duration"', 'label="whole time"')
    (played.folder / "mine.py").write_text(edited)
    again = played.run("tables", "factors", "--study", "mine.toml", "--trust")
    (played.folder / "mine.py").write_text(PLUGIN)
    assert "whole time (s)" in again.out, "what was kept before the edit is not shown"


@pytest.mark.slow
def test_an_audit_replays_a_studys_prompts_and_conditions_without_its_file_but_runs_no_plug_in(
    played,
):
    alone = json.loads(played.run("audit", "--json").out)
    assert alone["ok"]
    assert alone["audits"][0]["counts"]["replayed"] == 24
    assert "unknown driver 'sleepy'" in " ".join(alone["audits"][0]["notes"])
    named = json.loads(played.run("audit", "--json", "--study", "mine.toml", "--trust").out)
    assert not any("not replayed" in note for note in named["audits"][0]["notes"])
