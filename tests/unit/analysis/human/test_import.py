"""Importing: which files are read, what is stored, and what happens the second time."""

from __future__ import annotations

from dataclasses import replace

import pytest

from merge_runner.errors import UsageError
from merge_runner.results.rows import rows_of
from merge_runner.results.store import Store, query, results_digest
from merge_runner_analysis.human import load
from merge_runner_analysis.human.load import import_trials, sort_files
from merge_runner_analysis.human.record import SPEC, SPEC_HASH, parse_csv, trial_record
from tests.support.recordings import Recording, drive, file

LEFT, RIGHT = drive("L_4_0"), drive("R_-4_0", yields="left")


@pytest.fixture
def path(tmp_path):
    return tmp_path / "results/merge.duckdb"


def imported(path, files: dict[str, bytes]):
    download = sort_files(file(name, content) for name, content in files.items())
    return import_trials(download, Store(path))


def rows(path, sql):
    return query(path, sql)[1]


def changed(recording: Recording, name: str, row: int, value: object) -> Recording:
    columns = {key: list(values) for key, values in recording.columns.items()}
    columns[name][row] = value
    return Recording(columns)


def test_a_trial_is_stored_as_its_record_says_and_its_spec_too(path):
    report = imported(path, {"d/experiment_6_iter_1.csv": LEFT.csv()})
    assert (report.added, report.there, report.differing) == (1, 0, [])
    record = trial_record(parse_csv(LEFT.csv()), 6, 1)
    assert rows(path, "from trials") == rows_of(record)["trials"]
    assert rows(path, "from states order by step, side") == rows_of(record)["states"]
    assert rows(path, "from specs") == [(SPEC_HASH, SPEC)]
    assert rows(path, "select pair, source, variant, time_to_merge_s > 0 from trials "
                "join trial_metrics using (trial_id, spec_hash)") == [
        ("pair3", "human", None, True)
    ]  # fmt: skip


def test_importing_twice_leaves_the_database_as_it_was(path):
    files = {f"experiment_{n}_iter_{m}.csv": LEFT.csv() for n in (4, 5) for m in (0, 1)}
    assert imported(path, files).added == 4
    before = results_digest(path)
    again = imported(path, files)
    assert (again.added, again.there, again.differing) == (0, 4, [])
    assert results_digest(path) == before
    assert rows(path, "select count(*) from specs") == [(1,)]


@pytest.mark.parametrize(
    ("name", "row", "value"),
    [
        ("velocities.left", 120, 9.0),
        ("travelled_distance.right", 120, 60.0),
        ("end_state", 0, "Collided"),
        ("dt", 0, 51),
    ],
)
def test_a_trial_that_is_stored_with_other_values_is_named_and_kept(path, name, row, value):
    imported(path, {"experiment_4_iter_1.csv": LEFT.csv()})
    of_first = "from states where trial_id like '%iter001' order by step, side"
    before = rows(path, "from trials"), rows(path, of_first)
    other = changed(LEFT, name, row, value).csv()
    report = imported(path, {"experiment_4_iter_1.csv": other, "experiment_4_iter_2.csv": other})
    assert (report.added, report.there) == (1, 0)
    assert report.differing == ["human/pair1/L_4_0/iter001"]
    assert rows(path, "select count(*) from trials") == [(2,)]
    assert (rows(path, "from trials where rep = 1"), rows(path, of_first)) == before


def test_trials_of_a_sweep_are_left_alone(path):
    record = trial_record(parse_csv(LEFT.csv()), 4, 1)
    llm = replace(record, spec=replace(record.spec, spec_hash="another", source="llm"))
    Store(path).add_recorded([llm], {})
    assert imported(path, {"experiment_4_iter_1.csv": LEFT.csv()}).added == 1
    assert rows(path, "select count(*), count(distinct trial_id) from trials") == [(2, 1)]


def test_copies_of_a_trial_are_stored_once_and_other_values_are_named(path):
    copies = {"a/experiment_4_iter_1.csv": LEFT.csv(), "b/experiment_4_iter_1.csv": LEFT.csv()}
    other = changed(LEFT, "velocities.left", 120, 9.0).csv()
    report = imported(path, {**copies, "c/experiment_4_iter_1.csv": other})
    assert (report.added, report.there) == (1, 1)
    assert report.differing == ["human/pair1/L_4_0/iter001"]


def test_what_cannot_be_read_says_why_and_the_rest_is_imported(path):
    report = imported(
        path,
        {
            "a/experiment_4_iter_1.csv": b"",
            "b/experiment_4_iter_1.csv": b"",
            "experiment_4_iter_2.csv": RIGHT.csv(),
            "experiment_4_iter_3.csv": changed(LEFT, "travelled_distance.left", 0, 2.0).csv(),
        },
    )
    assert report.added == 1
    assert [name for name, _ in report.unreadable] == [
        "a/experiment_4_iter_1.csv", "b/experiment_4_iter_1.csv", "experiment_4_iter_3.csv",
    ]  # fmt: skip
    assert "left at 2.00 m with 10.00 m/s, right at 0.00 m" in report.unreadable[2][1]


@pytest.mark.parametrize("suffix", ["pkl", "mat"])
def test_only_a_csv_is_ever_read(path, suffix):
    def read():
        raise AssertionError

    other = replace(file(f"experiment_4_iter_1.{suffix}", b""), content=read)
    beside = [file("experiment_4_iter_2.csv", LEFT.csv())]
    beside.append(replace(other, name=f"{suffix}/experiment_4_iter_2.{suffix}"))
    report = import_trials(sort_files([other, *beside]), Store(path))
    assert (report.added, report.unreadable) == (1, [])


def test_only_trials_are_trials():
    names = [
        *(
            f"experiment_4_training_{k}.{suffix}"
            for k in (1, 2)
            for suffix in ("csv", "mat", "pkl")
        ),
        *("simulation_4_iter_0.pkl", "simulation_4_iter_1.pkl", "auto_save.pkl"),
        *("participant_info.txt", "._experiment_4_iter_1.csv", "experiment_4_iter_1.csv.bak"),
        *("experiment_4_iter_.csv", "experiment_10_iter_1.CSV", "experiment_9_iter_2.csv"),
    ]
    sources = sort_files(file(name, b"x") for name in names)
    assert [source[1:3] for source in sources] == [(9, 2), (10, 1)]


def test_only_what_would_be_read_can_be_a_bomb():
    sort_files([replace(file("auto_save.pkl", b""), size=10**9)])
    for suffix in ("mat", "pkl"):
        sort_files([replace(file(f"experiment_4_iter_1.{suffix}", b""), size=10**9)])
    with pytest.raises(UsageError, match="recordings never have"):
        sort_files([replace(file("experiment_4_iter_1.csv", b""), size=10**9)])


def test_what_is_stored_before_an_interruption_stays(path, monkeypatch):
    monkeypatch.setattr(load, "CHUNK", 2)
    content = LEFT.csv()

    def interrupt():
        raise KeyboardInterrupt

    files = [file(f"experiment_4_iter_{m}.csv", content) for m in range(5)]
    files[3] = replace(files[3], content=interrupt)
    with pytest.raises(KeyboardInterrupt):
        import_trials(sort_files(files), Store(path))
    assert rows(path, "select rep from trials order by rep") == [(0,), (1,)]
    files[3] = replace(files[3], content=lambda: content)
    report = import_trials(sort_files(files), Store(path))
    assert (report.added, report.there) == (3, 2)
