"""The tables: their numbers, their forms, and what they say where there is nothing to say."""

from __future__ import annotations

import csv
import io
import json
import re
from pathlib import Path

import duckdb
import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.errors import UsageError
from merge_runner.results.store import Store
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.data.load import load
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.explain import explain
from merge_runner_analysis.figures import FIGURES
from merge_runner_analysis.metrics import METRICS
from merge_runner_analysis.names import TableFormat
from merge_runner_analysis.stats.indicators import score
from merge_runner_analysis.stats.intervals import proportion
from merge_runner_analysis.tables import TABLES, make_tables
from merge_runner_analysis.tables import table as table_of
from merge_runner_analysis.tables.against import against
from merge_runner_analysis.tables.formats import as_csv, as_text, render
from merge_runner_analysis.tables.model import Column, Row, Table
from tests.support.harness import PROJECT
from tests.support.studies import Drive, changed, write_study, yielding

GOLDEN = Path(__file__).parents[3] / "golden" / "tables"
CRASH = (0.0,)


def cell(table, row_id, column):
    (row,) = [row for row in table.rows if row.id == row_id]
    return row.values.get(column)


@pytest.mark.parametrize("name", TABLES)
def test_a_table_reads_as_its_golden_file(tables, name):
    text = render([tables[name]], TableFormat.TEXT)
    assert text + "\n" == (GOLDEN / f"{name}.txt").read_text(encoding="utf-8")


def test_the_docs_list_the_tables_and_figures_as_the_explorer_does():
    text = (PROJECT / "docs/reference/analysis.md").read_text(encoding="utf-8").replace("\\|", "|")
    about = {name: one.about for name, one in TABLES.items()}
    figures = {name: one.shows for name, one in FIGURES.items()}
    for shows in (about, figures):
        rows = [f"| `{name}` | {what} |" for name, what in shows.items()]
        assert "\n".join(["|---|---|", *rows, ""]) in text


@pytest.mark.parametrize("width", [60, 80, 120])
def test_a_table_fits_the_terminal_and_names_the_columns_that_do_not(tables, width):
    for table in tables.values():
        lines = render([table], TableFormat.TEXT, width).splitlines()
        assert all(len(line) <= width for line in lines), table.name
        if not table.rows:
            continue
        left_out = re.search(r"so without (.*?): --format csv", " ".join(map(str.strip, lines)))
        assert bool(left_out) == (len(as_text(table).splitlines()[2]) > width), table.name
        if left_out:
            assert {*left_out[1].split(", ")} <= {column.name for column in table.columns}


def test_a_comparison_has_one_p_and_one_corrected_p_in_every_table(study, tables):
    (factors,) = make_tables(Study(study.db, by="model"), ["factors"])
    rows = {row.id: row.values for row in factors.rows}
    assert tables["contrasts"].rows
    for row in tables["contrasts"].rows:
        driver, setting, _, metric = row.id.split("/")
        there = rows[f"model={driver}/prompt={setting}/{metric}"]
        assert (row.values["p"], row.values["p_holm"]) == (there["p"], there["p_holm"])
        assert row.values["ci"] == there["difference_ci"]


def test_an_interval_of_a_difference_agrees_with_its_p(study, tables):
    (by,) = make_tables(Study(study.db, by="model"), ["factors"])
    for table, name in (
        (by, "difference_ci"),
        (tables["factors"], "difference_ci"),
        (tables["contrasts"], "ci"),
    ):
        for row in table.rows:
            if row.values.get("p") is not None:
                low, high = row.values[name]
                assert (row.values["p"] < 0.05) == (not low <= 0 <= high), row.id


def test_human_rows_carry_the_golden_numbers(tables):
    table = tables["who-first"]
    found = [
        [round(cell(table, f"human/{term}", name), 3) for name in ("b", "se")]
        for term in ("intercept", "projected_headway", "relative_velocity")
    ]
    assert found == [[-0.304, 0.135], [1.111, 0.075], [-3.304, 0.310]]
    assert cell(table, "human/intercept", "n") == 962
    quantitative = tables["ablation-quantitative"]
    assert round(cell(quantitative, "human", "collided_boxes_percent"), 2) == 2.83
    assert [cell(quantitative, "human", c) for c in ("gap_m", "rmse_mps", "joint_percent")] == [
        3.85,
        0.66,
        53.0,
    ]


def test_counts_and_rates_of_a_cell_are_those_of_its_trials(study, tables):
    rows = load(
        "SELECT status, count(*) n, count(*) FILTER (joint) joint, avg(gap_m) gap FROM trials "
        "JOIN trial_metrics USING (trial_id, spec_hash) WHERE trials.spec_hash = 'o3-A2' "
        "GROUP BY ALL",
        study.db,
    ).set_index("status")
    table, ended = tables["ablation-quantitative"], int(rows["n"].sum())
    collided = int(rows["n"].get("collided", 0))
    assert cell(table, "o3/A2", "n") == ended == 55
    assert cell(table, "o3/A2", "collided_percent") == pytest.approx(100 * collided / ended)
    interval = proportion(collided, ended)
    assert cell(table, "o3/A2", "collided_percent_ci") == pytest.approx(
        (100 * interval.low, 100 * interval.high)
    )
    finished = rows.loc["finished"]
    assert cell(table, "o3/A2", "gap_m") == pytest.approx(finished["gap"])
    assert cell(table, "o3/A2", "joint_percent") == pytest.approx(
        100 * finished["joint"] / finished["n"]
    )


def test_the_score_counts_the_marks_beside_it(tables):
    table = tables["ablation-qualitative"]
    for row in table.rows:
        for rule in ("paper", "robust"):
            marks = [row.values.get(f"i{i}_{rule}") for i in range(1, 6)]
            known = [mark for mark in marks if mark is not None]
            assert row.values[f"score_{rule}"] == f"{sum(known)} of {len(known)}", (row.id, rule)


def test_disagreeing_rules_are_marked(study, tables):
    found = 0
    for row in tables["ablation-qualitative"].rows:
        for i in range(1, 5):
            paper, robust = row.values[f"i{i}_paper"], row.values[f"i{i}_robust"]
            differ = None not in {paper, robust} and paper != robust
            assert (row.values[f"i{i}_differ"] == "≠") == differ
            found += differ
    assert found


def test_every_form_holds_the_same_values(tables):
    for table in tables.values():
        (parsed,) = json.loads(render([table], TableFormat.JSON))["tables"]
        flat = list(csv.DictReader(io.StringIO(render([table], TableFormat.CSV))))
        assert [row["row"] for row in flat] == [row["row"] for row in parsed["rows"]]
        for comma, plain in zip(flat, parsed["rows"], strict=True):
            assert comma == {k: "" if v is None else str(v) for k, v in plain.items()}
        markdown = render([table], TableFormat.MD).splitlines()
        latex = render([table], TableFormat.LATEX)
        text = render([table], TableFormat.TEXT).splitlines()
        bars = {line.replace(r"\|", "").count("|") for line in markdown if line.startswith("|")}
        assert len(bars) == 1, "every line of a Markdown table has as many cells"
        body = latex.split(r"\midrule")[1].split(r"\bottomrule")[0].strip().splitlines()
        assert len(body) == len(table.rows)
        cells = {line.replace(r"\&", "").count("&") for line in body}
        assert cells == ({bars.pop() - 2} if body else set())
        assert latex.count("{") == latex.count("}")
        assert len(text) >= len(table.rows) + 3
        assert "nan" not in "\n".join(text).lower()


def test_a_table_without_rows_is_a_frame_with_its_columns(small):
    frame = table_of(small, "factors")
    assert frame.empty
    assert [frame.index.name, *frame] == as_csv(make_tables(small, ["factors"])[0]).split(",")


def test_several_csv_tables_carry_their_names(study):
    text = render(make_tables(study, ["who-first", "gap"]), TableFormat.CSV)
    assert [line for line in text.splitlines() if line.startswith("#")] == ["# who-first", "# gap"]


def test_a_table_refuses_nan_and_a_gap_without_a_word():
    column = Column("b", "b", "number")
    with pytest.raises(ValueError, match="NaN"):
        Table("t", (column,), [Row("r", (), {"b": float("nan")}, "why")])
    with pytest.raises(ValueError, match="no note"):
        Table("t", (column,), [Row("r", (), {})])
    Table("t", (column,), [Row("r", (), {}, "why")])


def test_against_the_paper_stand_its_values_and_the_difference(study, tables):
    table = against(tables["who-first"], study)
    assert cell(table, "o3/baseline/projected_headway", "b_in_paper") == 1.11
    ours = cell(table, "o3/baseline/projected_headway", "b")
    assert ours is None or cell(
        table, "o3/baseline/projected_headway", "b_difference"
    ) == pytest.approx(ours - 1.11)
    assert cell(table, "other/baseline/intercept", "b_in_paper") is None
    quantitative = against(tables["ablation-quantitative"], study)
    assert cell(quantitative, "o3/A2", "gap_m_in_paper") == 10.63
    assert cell(quantitative, "o3/A2", "gap_m_difference") == pytest.approx(
        cell(quantitative, "o3/A2", "gap_m") - 10.63
    )
    assert cell(quantitative, "o3/A2", "collided_percent_in_paper") == 2.73
    assert cell(quantitative, "o3/A2", "collided_boxes_percent_in_paper") is None
    assert cell(quantitative, "human", "collided_percent_in_paper") is None
    assert cell(quantitative, "human", "collided_boxes_percent_in_paper") == 2.83
    qualitative = against(tables["ablation-qualitative"], study)
    assert cell(qualitative, "o3/A1", "i2_paper_in_paper") is False
    assert cell(qualitative, "o3/A2", "score_paper_in_paper") == "5 of 5"
    indicators = against(tables["indicators"], study)
    assert cell(indicators, "o3/baseline/I2", "paper_in_paper") is False
    assert cell(indicators, "o3/baseline/rmse_mps", "value_in_paper") == 1.34
    assert cell(indicators, "human/score", "paper_in_paper") == "5 of 5"
    assert cell(indicators, "human/collided_boxes_percent", "value_in_paper") == 2.83
    assert cell(indicators, "o3/baseline/collided_boxes_percent", "value_in_paper") is None
    assert cell(indicators, "o3/baseline/collided_percent", "value_in_paper") == 0
    assert any("arXiv 2604.09609, Table III" in note for note in table.notes)


def test_a_table_that_the_paper_has_not_says_so(study, tables):
    assert "no such table" in against(tables["contrasts"], study).notes[-1]


def test_prompts_are_contrasted_without_one_that_is_called_baseline(tmp_path):
    drives = [*yielding("o3", "hurry"), *yielding("o3", "calm")]
    config = {"levels": {"model": ["o3"], "prompt": ["hurry", "calm"]}}
    (table,) = make_tables(
        Study(write_study(tmp_path / "t.duckdb", drives, config=config)), ["contrasts"]
    )
    assert cell(table, "o3/calm/hurry/gap_m", "difference") == pytest.approx(0, abs=1e-12)
    assert cell(table, "o3/calm/hurry/gap_m", "reference") == "hurry"
    assert not any(row.values["reference"] == "human" for row in table.rows)


EMPTY = "holds no trial of a model"
TROUBLE = {
    "nothing": ([], EMPTY),
    "one trial": ([yielding("o3", reps=1)[3]], "1 finished trial with a first merger"),
    "only collisions": (
        [Drive("o3", "baseline", name, 1, CRASH, CRASH) for name in CONDITIONS],
        "no finished trial with a first merger",
    ),
    "separation": (
        [d for d in yielding("o3", reps=4) if d.condition != "N_0_0"],
        "separation: no finite estimate of",
    ),
    "left never first": (
        [
            Drive("o3", "baseline", n, r, (-1.0,) * 3, (1.0,) * 3)
            for n in CONDITIONS
            for r in (1, 2)
        ],
        "who merged first is the same in all 22 trials",
    ),
    "only a variant": (yielding("o3", "A3", reps=1), "A3"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", TROUBLE)
def test_trouble_gives_tables_with_a_stated_reason(case, tmp_path, recwarn):
    drives, reason = TROUBLE[case]
    db = tmp_path / "t.duckdb"
    Store(db) if not drives else write_study(db, drives)
    found = make_tables(Study(db))
    for form in TableFormat:
        text = render(found, form)
        assert not re.search(r"\b(nan|inf)\b", text, re.IGNORECASE)
        if form is not TableFormat.CSV:
            assert reason in text.replace("\\_", "_")
    assert [str(w.message) for w in recwarn.list] == []


def test_where_no_human_drove_there_is_no_ceiling_but_a_note(tmp_path):
    db = write_study(tmp_path / "t.duckdb", yielding("o3", reps=2))
    study = changed(db, "UPDATE trials SET condition = 'own_' || condition")
    five, six = make_tables(study, ["indicators", "ablation-qualitative"])
    rows = {row.id: row for row in (*five.rows, *six.rows)}
    for name in ("o3/baseline/I1", "o3/baseline/I4", "o3/baseline/score", "o3/baseline"):
        assert not {"ceiling_paper", "ceiling_robust"} & {*rows[name].values}
        assert "not all conditions of the humans were played: no ceiling" in rows[name].note
    assert "no ceiling" not in rows["o3/baseline/I5"].note + rows["human"].note


@pytest.mark.slow
def test_a_model_under_two_specs_makes_two_rows_that_tell_themselves_apart(tmp_path):
    db = write_study(tmp_path / "t.duckdb", yielding("o3", reps=2))
    other = write_study(tmp_path / "u.duckdb", yielding("o3", reps=1))
    with duckdb.connect(str(db)) as connection:
        connection.execute(f"ATTACH '{other}' AS other (READ_ONLY)")
        for name in ("trials", "states", "decisions"):
            connection.execute(
                f"INSERT INTO {name} SELECT * REPLACE ('changed' AS spec_hash) FROM other.{name}"
            )
    study = Study(db)
    assert [group.driver for group in study.models] == ["o3", "o3 [changed]"]
    assert [len(group.trials) for group in study.models] == [22, 11]


@pytest.mark.slow
def test_another_task_leaves_a_baseline_and_its_variants_together(tmp_path):
    """A baseline that was also run with drag must not tear the ablation study apart."""
    db = write_study(tmp_path / "t.duckdb", [*yielding("o3", reps=2), *yielding("o3", "A1", 2)])
    other = write_study(
        tmp_path / "u.duckdb", yielding("o3", reps=1), ScenarioConfig(resistance="human")
    )
    with duckdb.connect(str(db)) as connection:
        connection.execute(f"ATTACH '{other}' AS other (READ_ONLY)")
        for name in ("specs", "trials", "states", "decisions"):
            connection.execute(
                f"INSERT INTO {name} SELECT * REPLACE ('drag' AS spec_hash) FROM other.{name}"
            )
    study = Study(db)
    assert [group.id for group in study.models][:2] == ["o3/baseline", "o3/A1"]
    assert study.models[2].driver.startswith("o3 [")
    (table,) = make_tables(study, ["contrasts"])
    assert any(row.id == "o3/A1/baseline/gap_m" for row in table.rows)
    (beside,) = [against(t, study) for t in make_tables(study, ["ablation-quantitative"])]
    assert cell(beside, f"{study.models[2].id}", "gap_m_in_paper") == 9.28


@pytest.mark.slow
def test_models_can_be_chosen_and_an_unknown_one_names_the_valid(study):
    chosen = Study(study.db, ["other"])
    assert [group.id for group in chosen.groups] == ["other/baseline"]
    with pytest.raises(UsageError, match="valid: human, o3, other"):
        Study(study.db, ["gpt"])
    with pytest.raises(UsageError, match="unknown driver"):
        Study(study.db, [])
    humans = make_tables(Study(study.db, ["human"]))
    assert not any("holds no trial" in note for table in humans for note in table.notes)


def test_every_cell_can_be_traced_to_its_trials_and_the_query_that_lists_them(study, tables):
    listings: dict[str, tuple[str, ...]] = {}
    for table in tables.values():
        for row in (row for row in table.rows if row.groups[0] in {"o3/A1", "human"}):
            for column in table.columns:
                found = explain(study, table, f"{row.id}:{column.name}")
                assert len(found.sources) == len(row.groups)
                listings |= {source.query: source.trials for source in found.sources}
    assert len(listings) > 8
    with duckdb.connect(str(study.db), read_only=True) as connection:
        # Computed once, and not for each query.
        connection.execute("CREATE TEMP TABLE trial_metrics AS FROM trial_metrics")
        for query, trials in listings.items():
            if query:
                rows = connection.execute(query).fetchall()
                assert tuple(trial_id for trial_id, *_ in rows) == trials


@pytest.mark.parametrize(
    ("name", "row", "column"),
    [
        ("who-first", "o3/baseline/intercept", "n"),
        ("gap", "other/baseline/intercept", "n"),
        ("gap", "o3/A2/intercept", "n"),
        ("ablation-quantitative", "o3/A1", "n"),
        ("indicators", "o3/baseline/joint_percent", "n"),
        ("indicators", "o3/baseline/collided_percent", "n"),
        ("attempts", "other/baseline", "trials"),
    ],
)
def test_n_is_the_number_of_trials_that_explain_lists(study, tables, name, row, column):
    found = explain(study, tables[name], f"{row}:{column}")
    assert str(len(found.sources[0].trials)) == found.value


def test_explain_marks_the_trials_that_a_share_counts(study, tables):
    shares = [
        (row.id, column.name)
        for row in tables["ablation-quantitative"].rows
        for column in tables["ablation-quantitative"].columns
        if column.kind == "percent" and row.values.get(column.name) is not None
    ]
    marked = 0
    for row, column in shares:
        (source,) = explain(study, tables["ablation-quantitative"], f"{row}:{column}").sources
        if source.trials:
            (group,) = (group for group in study.models if group.id == row)
            share = 100 * len(source.numerator) / group.ended[METRICS[column].column].count()
            assert share == pytest.approx(
                cell(tables["ablation-quantitative"], row, column), rel=1e-9
            )
            assert {*source.numerator} <= {*source.trials}
            marked += bool(source.numerator)
    assert marked > 2
    shown = explain(study, tables["ablation-quantitative"], "o3/baseline:collided_percent").lines()
    collided = study.models[0].ended.set_index("trial_id")["collided"]
    for line in shown[-len(collided) :]:
        assert line.startswith("* " if collided[line[2:]] else "  ")


def test_explain_names_the_valid_rows_and_columns(study, tables):
    with pytest.raises(UsageError, match="valid: human/intercept"):
        explain(study, tables["gap"], "nobody")
    with pytest.raises(UsageError, match="valid: term, driver, setting, n"):
        explain(study, tables["gap"], "o3/baseline/intercept:beta")
    whole = explain(study, tables["gap"], "o3/baseline/intercept")
    assert "driver o3" in whole.value


def test_a_contrast_explains_both_its_groups(study, tables):
    found = explain(study, tables["contrasts"], "o3/A2/baseline/gap_m:difference")
    assert [source.group for source in found.sources] == ["o3/baseline", "o3/A2"]


def test_the_ceiling_stands_beside_each_score_and_fits_its_size(study, tables):
    for group in study.models:
        found = score(study, group).ceiling
        row = next(r for r in tables["ablation-qualitative"].rows if r.id == group.id)
        assert row.values["ceiling_paper"] == 100 * found["paper"]["I1-I4"]
    small, large = (
        cell(tables["ablation-qualitative"], row, "ceiling_paper")
        for row in ("o3/A1", "o3/baseline")
    )
    assert small < large < 50
