"""Which of the paper's rows a row stands beside, and what is not compared with itself."""

import pytest

from merge_runner_analysis.published import published
from merge_runner_analysis.tables.against import FILES, against
from tests.support.studies import changed, write_study, yielding
from tests.support.tables import by_id, cell, made

TABLE_VII = "ablation-quantitative"


@pytest.fixture(scope="module")
def met(tmp_path_factory):
    """Models, a program, and the emulator under its own name and in gemini's."""
    path = tmp_path_factory.mktemp("met") / "t.duckdb"
    names = [("o3", variant) for variant in ("baseline", "A1", "A2", "A3")]
    names += [(model, "baseline") for model in ("gemini-2.5-pro", "emulator", "constant")]
    write_study(path, [drive for name in names for drive in yielding(*name, reps=1)])
    scripted = "model_left IN ('gemini-2.5-pro', 'emulator')"
    return changed(
        path,
        f"UPDATE trials SET scripted = true WHERE {scripted}",
        "UPDATE trials SET sample_set = 1 WHERE variant = 'A3'",
        f"""UPDATE specs SET spec = '{{"left": {AT}, "right": {AT}}}' WHERE spec_hash = 'o3-A1'""",
    )


AT = '{"endpoint": "http://localhost:8080/v1"}'


def beside(study, name=TABLE_VII):
    return against(made(study, name), study)


def differences(table, row_id):
    return [name for name in by_id(table)[row_id].values if name.endswith("_difference")]


def test_published_human_values_stand_there_and_are_not_compared_with_themselves(met):
    assert len(FILES) == 5
    for table in (beside(met, name) for name in FILES):
        # The published collisions are by boxes: by the other rule there are none to stand beside.
        ids = [r.id for r in table.rows if r.groups[0] == "human" and "/collided_p" not in r.id]
        assert ids
        for name in ids:
            assert any(column.endswith("_in_paper") for column in by_id(table)[name].values)
            assert differences(table, name) == []


def test_humans_of_a_partial_import_stand_beside_the_paper_without_differences(imported):
    for name, row in ((TABLE_VII, "human"), ("who-first", "human/intercept")):
        assert differences(beside(imported, name), row) == []
    indicators = beside(imported, "indicators")
    assert cell(indicators, "human/collided_boxes_percent", "value_in_paper") == 2.83


def test_only_the_papers_models_stand_beside_its_values(met):
    """A model at another endpoint is another one, and other samples are of the same."""
    rows = published("paper_ablation_quantitative").set_index(["driver", "setting"])["gap_m"]
    papers = {"o3/baseline": "baseline", "o3/A2": "A2", "o3/set1/A3": "A3"}
    papers = {row: rows["o3", setting] for row, setting in papers.items()}
    others = ("o3 at localhost:8080/A1", "gemini-2.5-pro/baseline", "emulator/baseline")
    table = beside(met)
    found = {row: cell(table, row, "gap_m_in_paper") for row in (*papers, *others)}
    assert found == papers | dict.fromkeys(others)


def test_values_stand_against_the_paper_alone(met, prepare, tmp_path):
    tables = ("tables", TABLE_VII, "--db", met.db, "--against")
    refused, shown = (prepare(tmp_path, *tables, name) for name in ("humans", "paper"))
    assert (refused.code, shown.code) == (2, 0)
    assert "valid is paper" in refused.err
    assert "paper: " in shown.out
