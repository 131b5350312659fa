"""A metric that a package from outside registers is shown wherever metrics are."""

from __future__ import annotations

import json
from html import unescape

import duckdb
import pytest

from tests.support.harness import FAST, how_to, plugin

NAME, HEADING = "mean_abs_acceleration_mps2", "mean |a| (m/s²)"
TABLES = ("indicators", "contrasts")
FORMATS = {"text": HEADING, "csv": NAME, "md": r"mean \|a\|", "latex": "$|$a$|$"}
NOTHING = f"{HEADING}: no human value is published, and none is imported"
EXPECTED = (
    "SELECT avg(a) FROM (SELECT avg(abs(acceleration_mps2)) AS a FROM states "
    "JOIN trials USING (trial_id, spec_hash) WHERE time_s > 0 AND status = 'finished' "
    "AND variant = 'A1' GROUP BY trial_id, spec_hash)"
)


@pytest.fixture(scope="module")
def installed(study):
    """The emulator with a variant, and a program, in three conditions; where the package is."""
    chosen = ("--conditions", "L_4_0,N_0_0,R_-4_0", "--reps", 1, *FAST)
    for sweep in (
        ("sweep", "ablations", "--variants", "baseline,A1"),
        ("sweep", "baseline", "--model", "projected-order"),
    ):
        run = study.run(*sweep, *chosen)
        assert run.code == 0, run.err
    return plugin(study.folder / "installed", how_to("add-a-metric"))


@pytest.fixture(scope="module")
def report(study, installed):
    run = study.run("report", "--out", "report.html", **installed)
    assert run.code == 0, run.err
    return (study.folder / "report.html").read_text()


@pytest.mark.long
def test_it_stands_in_the_tables_in_every_format(study, installed):
    shown = study.run("tables", *TABLES, "--format", "json", **installed).out
    for table in json.loads(shown)["tables"]:
        assert NAME in json.dumps(table), table["name"]
    for name, heading in FORMATS.items():
        out = study.run("tables", *TABLES, "--format", name, **installed).out
        assert out.count(heading) >= len(TABLES), name


def test_its_number_is_that_of_the_states_and_leads_to_its_trials(study, installed):
    table = ("tables", "ablation-quantitative", "--format", "json")
    tables = json.loads(study.run(*table, **installed).out)
    rows = {row["row"]: row for row in tables["tables"][0]["rows"]}
    with duckdb.connect(str(study.folder / "results/merge.duckdb"), read_only=True) as connection:
        (expected,) = connection.execute(EXPECTED).fetchone()
    assert rows["emulator/A1"][NAME] == pytest.approx(expected)
    assert rows["human"][NAME] is None
    assert NOTHING in rows["human"]["note"]
    told = study.run(
        "explain", "ablation-quantitative", f"emulator/A1:{NAME}", "--json", **installed
    )
    (source,) = json.loads(told.out)["sources"]
    listed = study.run("sql", source["query"], "--format", "json", **installed)
    assert [row["trial_id"] for row in json.loads(listed.out)] == source["trials"]
    assert len(source["trials"]) == rows["emulator/A1"]["n"]


@pytest.mark.long
def test_the_report_shows_it(report):
    text = unescape(report)
    assert HEADING in text
    assert NOTHING in text


@pytest.mark.long
def test_the_exported_pages_show_it(study, installed):
    run = study.run("view", "--export", "pages", **installed)
    assert run.code == 0, run.err
    pages = {
        path.name: unescape(path.read_text()) for path in study.folder.glob("pages/files/*.html")
    }
    assert HEADING in pages["prompts.html"]
    assert all(HEADING in pages[f"tables-{name}.html"] for name in ("indicators", "contrasts"))


@pytest.mark.slow
def test_kept_tables_are_of_the_package_that_is_installed(study, installed):
    """The package comes, changes and goes between two looks at a table of the same results."""
    table = ("tables", "ablation-quantitative")
    other = how_to("add-a-metric").replace('label="mean |a|"', 'label="average |a|"')
    changed = plugin(study.folder / "changed", other)
    assert HEADING in study.run(*table, **installed).out
    assert "average |a| (m/s²)" in study.run(*table, **changed).out
    assert "|a|" not in study.run(*table).out


def test_a_mistake_in_its_sql_is_told_in_one_line(study, installed):
    wrong = how_to("add-a-metric").replace("avg(abs(acceleration_mps2))", "avg(nothing)")
    run = study.run("tables", "gap", **plugin(study.folder / "wrong", wrong))
    assert run.code == 2
    assert run.err.startswith(f"error: the SQL of the metric {NAME} fails: ")
    assert run.err.count("\n") == 1
