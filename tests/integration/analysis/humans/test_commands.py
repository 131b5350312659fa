"""``merge-runner human`` on the command line: outputs and exit codes."""

import pytest

from merge_runner.results.store import query
from merge_runner_analysis.study import StudyResults
from tests.support.pages import velocity_page
from tests.support.recordings import drive, write_folder, write_zip

GOOD = {
    "data/experiment_4/experiment_4_iter_1.csv": drive("L_4_0").csv(),
    "copy/experiment_6/experiment_6_iter_2.csv": drive("N_0_0", yields="nobody").csv(),
    "data/experiment_4/experiment_4_training_1.csv": b"",
    "data/experiment_4/participant_info.txt": b"left",
}
BAD = {
    "data/experiment_5/experiment_5_iter_1.csv": b"dt,end_state\r\n50,Finished\r\n",
    "simulated/experiment_4/simulation_4_iter_0.pkl": b"",
    **{f"cut/experiment_8_iter_{m}.csv": b"" for m in range(21)},
}


@pytest.fixture
def human(prepare, tmp_path):
    return lambda *arguments: prepare(tmp_path, "human", *arguments)


def test_a_zip_is_imported_once_and_the_status_counts_it(human, tmp_path):
    path = write_zip(tmp_path / "download.zip", GOOD)
    run = human("import", path)
    assert (run.code, run.out) == (
        0,
        "2 trials added, 0 there already, 0 files could not be read\n",
    )
    (few,) = run.err.splitlines()
    assert few.startswith("note: 2 of 990 trials are imported; who merged first and collisions are")
    again = human("import", path)
    assert (again.code, again.out[:33]) == (0, "0 trials added, 2 there already, ")
    late = {"experiment_4_iter_1.csv": drive("L_4_0", late=True).csv()}
    other = human("import", write_folder(tmp_path / "other", late))
    assert other.code == 1
    assert "error: human/pair1/L_4_0/iter001 is stored with other values, which stay" in other.err
    status = human("status")
    lines = [line.split() for line in status.out.splitlines()]
    assert status.code == 0
    assert ["pair1", "1", "1", "0", "0"] in lines
    assert ["L_4_0", "1", "1", "0", "0", "88", "0", "2"] in lines
    assert ["N_0_0", "1", "0", "0", "1", "37", "48", "5"] in lines
    assert lines[-1][:4] == ["2", "of", "990", "trials"]


def test_what_cannot_be_read_is_listed_and_the_rest_is_imported(human, tmp_path):
    run = human("import", write_folder(tmp_path / "d", {**GOOD, **BAD}), "--db", "other.duckdb")
    assert run.code == 1
    assert "2 trials added, 0 there already, 22 files could not be read\n" in run.out
    lines = run.err.splitlines()
    assert (
        "error: data/experiment_5/experiment_5_iter_1.csv: it lacks travelled_distance.left, "
        "travelled_distance.right, velocities.left, velocities.right" in lines
    )
    assert any(x.startswith("error: cut/experiment_8_iter_0.csv: it is not") for x in lines)
    assert len(lines) == 22 + 1
    assert query(tmp_path / "other.duckdb", "select count(*) from trials")[1] == [(2,)]


@pytest.mark.parametrize(
    ("files", "says"),
    [
        (None, "error: there is no download.zip"),
        (
            {"a/data.zip": b"", "readme.txt": b""},
            "error: no trial is in download.zip: trials are experiment_N_iter_M.csv, "
            "and velocity pages are named like 4_-8.html; unpack a zip within",
        ),
    ],
)
def test_wrong_usage_ends_with_2_one_line_and_no_database(human, tmp_path, files, says):
    if files is not None:
        write_zip(tmp_path / "download.zip", files)
    run = human("import", "download.zip")
    assert run.code == 2
    assert says in run.err
    assert len(run.err.splitlines()) == 1
    assert not (tmp_path / "results").exists()


def test_the_status_of_nothing_says_what_to_type(human):
    run = human("status")
    assert run.code == 0
    assert run.out.startswith("no human recordings are imported: merge-runner human import PATH")
    assert "10.4121/19550377" in run.out


def test_the_source_of_a_trial_is_told_and_none_is_stored_twice(human, tmp_path):
    driven = {"1-1": drive("L_4_0"), "3-12": drive("L_4_0", yields="left")}
    recorded = {"experiment_4_iter_1.csv": driven["1-1"].csv()}
    folder = write_folder(tmp_path / "both", {"4_0.html": velocity_page(driven), **recorded})
    run = human("import", folder)
    assert (run.code, run.out[:32]) == (0, "2 trials added, 1 there already,")
    says = "1 of 2 trials are of the public velocity pages"
    assert says in run.err
    assert says in human("status").out
    assert human("import", folder).out.startswith("0 trials added, 3 there already, ")
    study = StudyResults(tmp_path / "results/merge.duckdb")
    assert len(study.human.trials) == 2
    assert any(said.startswith(says) for said in study.findings)
