"""The tables: their numbers, their forms, and what they say where there is nothing to say."""

import csv
import io
import json
import re

import duckdb
import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.errors import UsageError
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.explain import explain
from merge_runner_analysis.selection import Selection
from merge_runner_analysis.stats.indicators import score
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.table_format import TableFormat
from merge_runner_analysis.tables import TABLES, make_tables
from merge_runner_analysis.tables import table as table_of
from merge_runner_analysis.tables.against import against
from merge_runner_analysis.tables.formats import as_csv, as_text, render
from merge_runner_analysis.tables.model import Column, Row, Table
from tests.support.harness import PROJECT
from tests.support.studies import Drive, changed, write_study, yielding
from tests.support.tables import QUICK, by_id, cell, made, notes_with


@pytest.mark.parametrize("name", TABLES)
def test_a_table_reads_as_its_golden_file(tables, name):
    golden = PROJECT / f"tests/golden/tables/{name}.txt"
    assert render([tables[name]], TableFormat.TEXT) + "\n" == golden.read_text(encoding="utf-8")


def hidden_in(table, width):
    """The lines of a table on a terminal, and the columns that they say are hidden."""
    lines = render([table], TableFormat.TEXT, width).splitlines()
    rest = " ".join(lines)
    said = re.search(r"  (\d+) columns? hidden: --wide shows ((?:\w+, +)*\w+)", rest)
    names = re.split(", +", said[2]) if said else []
    assert len(names) == (int(said[1]) if said else 0)
    return lines, names


@pytest.mark.parametrize("width", [60, 100, 120])
def test_a_table_fits_the_terminal_and_names_the_columns_that_do_not(tables, width):
    for table in tables.values():
        lines, hidden = hidden_in(table, width)
        assert all(len(line) <= width for line in lines), table.name
        if not table.rows:
            continue
        assert bool(hidden) == (len(as_text(table).splitlines()[2]) > width), table.name
        assert {*hidden} <= {column.name for column in table.columns}


def test_a_terminal_of_100_columns_shows_estimates_differences_p_and_verdicts(tables):
    for name in ("verdicts", "effects", "contrasts", "factors", "indicators", "who-first"):
        _, hidden = hidden_in(tables[name], 100)
        kinds = {column.name: column.kind for column in tables[name].columns}
        assert hidden, name
        findings = {"estimate", "value", "b", "difference", "p", "p_holm", "p_corrected", "state"}
        assert not findings & {*hidden}, name
        assert not {"p", "verdict"} & {kinds[column] for column in hidden}, name


def test_the_score_counts_the_marks_beside_it_and_disagreeing_rules_are_marked(study, tables):
    differing = 0
    for row in tables["ablation-qualitative"].rows:
        for rule in ("paper", "robust"):
            marks = [row.values.get(f"i{i}_{rule}") for i in range(1, 6)]
            known = [mark for mark in marks if mark is not None]
            assert row.values[f"score_{rule}"] == f"{sum(known)} of {len(known)}", (row.id, rule)
        for i in range(1, 5):
            rules = {row.values[f"i{i}_paper"], row.values[f"i{i}_robust"]}
            assert (row.values[f"i{i}_differ"] == "≠") == (rules == {True, False})
            differing += rules == {True, False}
    assert differing
    rows = by_id(tables["ablation-qualitative"])
    for group in study.models:
        ceiling = score(study, group).ceiling["paper"]["I1-I4"]
        assert rows[group.id].values["ceiling_paper"] == 100 * ceiling
    small, large = (rows[name].values["ceiling_paper"] for name in ("o3/A1", "o3/baseline"))
    assert small < large < 50


def test_every_form_holds_the_same_values(tables):
    for table in tables.values():
        (parsed,) = json.loads(render([table], TableFormat.JSON))["tables"]
        flat = list(csv.DictReader(io.StringIO(render([table], TableFormat.CSV))))
        assert flat == [
            {k: "" if v is None else str(v) for k, v in row.items()} for row in parsed["rows"]
        ]
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
        assert r"\begin{tabular}{l" in latex, "names stand at the left"
        assert len(text) >= len(table.rows) + 3
        assert "nan" not in "\n".join(text).lower()


def test_several_csv_tables_carry_their_names_and_one_without_rows_its_columns(small, tables):
    text = render([tables["who-first"], tables["gap"]], TableFormat.CSV)
    assert [line for line in text.splitlines() if line.startswith("#")] == ["# who-first", "# gap"]
    frame = table_of(small, "factors")
    assert frame.empty
    assert [frame.index.name, *frame] == as_csv(made(small, "factors")).split(",")
    assert {str(frame[name].dtype) for name in ("factor", "note")} == {"str"}
    assert frame["value"].dtype == float


def test_a_data_frame_may_be_of_a_part_of_a_database(small):
    (driver, *_) = {group.driver for group in small.models}
    assert {*table_of(small.db, "gap", Selection([driver]))["driver"]} == {driver}


def test_a_table_refuses_nan_and_a_gap_without_a_word():
    column = Column("b", "b", "number")
    with pytest.raises(ValueError, match="NaN"):
        Table("t", (column,), [Row("r", (), {"b": float("nan")}, "why")])
    with pytest.raises(ValueError, match="no note"):
        Table("t", (column,), [Row("r", (), {})])
    Table("t", (column,), [Row("r", (), {}, "why")])


AGAINST = {
    "who-first": {("o3/baseline/projected_headway", "b"): 1.11,
                  ("other/baseline/intercept", "b"): None},
    "ablation-quantitative": {("o3/A2", "gap_m"): 10.63, ("o3/A2", "collided_percent"): 2.73,
                              ("o3/A2", "collided_boxes_percent"): None,
                              ("human", "collided_percent"): None,
                              ("human", "collided_boxes_percent"): 2.83},
    "ablation-qualitative": {("o3/A1", "i2_paper"): False, ("o3/A2", "score_paper"): "5 of 5"},
    "indicators": {("o3/baseline/I2", "paper"): False, ("o3/baseline/rmse_mps", "value"): 1.34,
                   ("human/score", "paper"): "5 of 5",
                   ("human/collided_boxes_percent", "value"): 2.83,
                   ("o3/baseline/collided_boxes_percent", "value"): None,
                   ("o3/baseline/collided_percent", "value"): 0},
}  # fmt: skip


@pytest.mark.parametrize("name", AGAINST)
def test_against_the_paper_stand_its_values_and_the_difference(study, tables, name):
    table = against(tables[name], study)
    assert notes_with(table, "arXiv 2604.09609, Table")
    for (row, column), printed in AGAINST[name].items():
        assert cell(table, row, f"{column}_in_paper") == printed, (row, column)
        ours, apart = cell(table, row, column), cell(table, row, f"{column}_difference")
        if None not in (ours, apart) and not isinstance(printed, bool | str):
            assert apart == pytest.approx(ours - printed)
    if name == "ablation-quantitative":
        assert cell(table, "o3/A2", "gap_m_difference") is not None
    assert "no such table" in against(tables["contrasts"], study).notes[-1]


def test_prompts_are_contrasted_without_one_that_is_called_baseline(tmp_path):
    drives = [*yielding("o3", "hurry"), *yielding("o3", "calm")]
    config = {"levels": {"model": ["o3"], "prompt": ["hurry", "calm"]}}
    study = StudyResults(write_study(tmp_path / "t.duckdb", drives, config=config))
    rows = {name: row.values for name, row in by_id(made(study, "contrasts")).items()}
    assert rows["o3/calm/hurry/gap_m"]["difference"] == pytest.approx(0, abs=1e-12)
    assert {values["reference"] for values in rows.values()} == {"hurry"}


# Drivers with one kind of trouble each, and what is said of it.
TROUBLE = {
    "1 finished trial in which one went first": [yielding("once", reps=1)[3]],
    "no finished trial in which one went first": [
        Drive("crash", "baseline", name, 1, (0.0,), (0.0,)) for name in CONDITIONS
    ],
    "separation: no finite estimate of": [
        drive for drive in yielding("separated", reps=2) if drive.condition != "N_0_0"
    ],
    "who merged first is the same in all 11 trials": [
        Drive("never", "baseline", name, 1, (-1.0,) * 3, (1.0,) * 3) for name in CONDITIONS
    ],
    "A3": yielding("varied", "A3", reps=1),
}


@pytest.mark.parametrize(
    ("names", "trouble"), [(TABLES, {"holds no trial of a model": []}), (QUICK, TROUBLE)]
)
def test_trouble_gives_tables_with_a_stated_reason(names, trouble, tmp_path, recwarn):
    drives = [drive for drives in trouble.values() for drive in drives]
    found = make_tables(StudyResults(write_study(tmp_path / "t.duckdb", drives)), names)
    for form in TableFormat:
        text = render(found, form).replace("\\_", "_")
        assert not re.search(r"\b(nan|inf)\b", text, re.IGNORECASE)
        if form is not TableFormat.CSV:
            assert [reason for reason in trouble if reason not in text] == []
    assert [str(w.message) for w in recwarn.list] == []


def test_where_no_human_drove_there_is_no_ceiling_but_a_note(tmp_path):
    db = write_study(tmp_path / "t.duckdb", yielding("o3", reps=1))
    study = changed(db, "UPDATE trials SET condition = 'own_' || condition")
    rows = by_id(made(study, "indicators")) | by_id(made(study, "ablation-qualitative"))
    for name in ("o3/baseline/I1", "o3/baseline/I4", "o3/baseline/score", "o3/baseline"):
        assert not {"ceiling_paper", "ceiling_robust"} & {*rows[name].values}
        assert "not all conditions of the humans were played: no ceiling" in rows[name].note
    assert "no ceiling" not in rows["o3/baseline/I5"].note + rows["human"].note


def added(db, other, spec, *tables):
    """A database with the rows of another one under a spec of their own."""
    with duckdb.connect(str(db)) as connection:
        connection.execute(f"ATTACH '{other}' AS other (READ_ONLY)")
        for name in ("trials", "states", "decisions", *tables):
            connection.execute(
                f"INSERT INTO {name} SELECT * REPLACE ('{spec}' AS spec_hash) FROM other.{name}"
            )
    return StudyResults(db)


def test_another_task_leaves_a_baseline_and_its_variants_together(tmp_path):
    """A baseline that was also run with drag must not tear the ablation study apart."""
    db = write_study(tmp_path / "t.duckdb", [*yielding("o3", reps=2), *yielding("o3", "A1", 2)])
    drag = ScenarioConfig(resistance="human")
    other = write_study(tmp_path / "u.duckdb", yielding("o3", reps=1), drag)
    study = added(db, other, "drag", "specs")
    first, second, third = (group.id for group in study.models)
    assert (first, second, third[:4]) == ("o3/baseline", "o3/A1", "o3 [")
    assert "o3/A1/baseline/gap_m" in by_id(made(study, "contrasts"))
    beside = against(made(study, "ablation-quantitative"), study)
    assert cell(beside, third, "gap_m_in_paper") == 9.28


def test_models_can_be_chosen_and_an_unknown_one_names_the_valid(tmp_path):
    drives = [yielding(name, reps=1)[0] for name in ("o3", "other")]
    db = write_study(tmp_path / "t.duckdb", drives)
    assert [group.id for group in StudyResults(db, Selection(["other"])).groups] == [
        "other/baseline"
    ]
    with pytest.raises(UsageError, match="valid: human, o3, other"):
        StudyResults(db, Selection(["gpt"]))
    with pytest.raises(UsageError, match="unknown driver"):
        StudyResults(db, Selection([]))
    assert not notes_with(made(StudyResults(db, Selection(["human"])), "gap"), "holds no trial")


# Explain


def test_every_cell_can_be_traced_to_its_trials_and_the_query_that_lists_them(study, tables):
    listings: dict[str, tuple[str, ...]] = {}
    for table in tables.values():
        drivers = {"other/baseline" if table.name == "verdicts" else "o3/A1", "human"}
        for row in (row for row in table.rows if row.groups[0] in drivers):
            for column in table.columns:
                found = explain(study, table, f"{row.id}:{column.name}")
                assert len(found.sources) == len(row.groups)
                for source in found.sources:
                    listings[source.query] = source.numerator if source.counts else source.trials
    assert len(listings) > 4
    with duckdb.connect(str(study.db), read_only=True) as connection:
        # Computed once, and not for each query.
        connection.execute("CREATE TEMP TABLE trial_metrics AS FROM trial_metrics")
        for query, trials in listings.items():
            rows = connection.execute(query).fetchall() if query else []
            assert not query or tuple(trial_id for trial_id, *_ in rows) == trials


def test_explain_marks_the_trials_that_a_share_counts(study, tables):
    table, marked = tables["ablation-quantitative"], 0
    groups = {group.id: group for group in study.models}
    for row in (row for row in table.rows if row.id in groups):
        for name in (c.name for c in table.columns if c.kind == "percent"):
            if row.values.get(name) is None:
                continue
            (source,) = explain(study, table, f"{row.id}:{name}").sources
            share = 100 * len(source.numerator) / len(source.trials)
            assert share == pytest.approx(row.values[name], rel=1e-9)
            assert {*source.numerator} <= {*source.trials}
            said = f"/* {len(source.numerator)} of {len(source.trials)} trials */ SELECT "
            assert source.query.startswith(said if source.numerator else "")
            marked += bool(source.numerator)
        (source,) = explain(study, table, f"{row.id}:gap_m").sources
        assert len(source.trials) == len(groups[row.id].finished)
    assert marked > 2
    collided = groups["o3/baseline"].ended.set_index("trial_id")["collided"]
    for line in explain(study, table, "o3/baseline:collided_percent").lines()[-len(collided) :]:
        assert line.startswith("* " if collided[line[2:]] else "  ")


def test_the_value_of_a_measure_counts_trials_if_it_is_a_share_and_none_if_it_is_a_mean(
    study, tables
):
    told = {"coll. (%)": 0, "gap (m)": 0}
    for row in tables["factors"].rows:
        measure, value = row.values["measure"], row.values.get("value")
        if measure not in told or value is None:
            continue
        sources = explain(study, tables["factors"], f"{row.id}:value").sources
        every = sum(len(source.trials) for source in sources)
        counted = sum(len(source.numerator) for source in sources)
        is_share = measure == "coll. (%)"
        assert {source.counts for source in sources} == {is_share}
        assert not is_share or 100 * counted / every == pytest.approx(value, rel=1e-9)
        assert every == row.values["n"]
        whole = explain(study, tables["factors"], f"{row.id}:value", of_all=True).sources
        assert {source.counts for source in whole} == {False}
        told[measure] += 1
    assert all(told.values())


def test_explain_names_the_valid_rows_and_columns(study, tables):
    with pytest.raises(UsageError, match="valid: human/intercept"):
        explain(study, tables["gap"], "nobody")
    with pytest.raises(UsageError, match="valid: term, driver, setting, n"):
        explain(study, tables["gap"], "o3/baseline/intercept:beta")
    assert "driver o3" in explain(study, tables["gap"], "o3/baseline/intercept").value
    found = explain(study, tables["contrasts"], "o3/A2/baseline/gap_m:difference")
    assert [source.group for source in found.sources] == ["o3/baseline", "o3/A2"]


def test_what_an_encoding_cannot_say_is_replaced(small, prepare, tmp_path):
    asked = ("sql", "SELECT '× – é' AS sign", "--db", small.db)
    done = prepare(tmp_path, *asked, PYTHONIOENCODING="ascii")
    assert (done.code, "? ? ?" in done.out) == (0, True), done.err
