"""Importing: which files are read, what is stored, and what happens the second time."""

from dataclasses import replace

import numpy as np
import pytest

from merge_runner.errors import UsageError
from merge_runner.results.rows import rows_of
from merge_runner.results.store import Store, query, results_digest
from merge_runner_analysis.humans import load
from merge_runner_analysis.humans.load import import_trials, sort_files
from merge_runner_analysis.humans.record import SPEC, SPEC_HASH, parse_csv, trial_record
from tests.support.pages import packed, velocity_page
from tests.support.recordings import Recording, drive, file

LEFT = drive("L_4_0")
# On the pages: two pairs and their iterations.
DRIVEN = {"1-1": drive("L_4_0"), "3-12": drive("L_4_0", yields="left")}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "results/merge.duckdb"


def imported(path, files: dict[str, bytes]):
    download = sort_files(file(name, content) for name, content in files.items())
    return import_trials(download, Store(path))


def rows(path, sql):
    return query(path, sql)[1]


def changed(recording: Recording, name: str, row: int, value: object) -> bytes:
    columns = {key: list(values) for key, values in recording.columns.items()}
    columns[name][row] = value
    return Recording(columns).csv()


def test_a_trial_is_stored_as_its_record_says_and_its_spec_too(path):
    report = imported(path, {"d/experiment_6_iter_1.csv": LEFT.csv()})
    assert (report.added, report.stored, report.differing) == (1, 0, [])
    record = trial_record(parse_csv(LEFT.csv()), 6, 1)
    assert rows(path, "from trials") == rows_of(record)["trials"]
    assert rows(path, "from states order by step, side") == rows_of(record)["states"]
    assert rows(path, "from specs") == [(SPEC_HASH, SPEC)]
    measured = "select pair, source, variant, time_to_merge_s > 0 from trials join trial_metrics"
    assert rows(path, f"{measured} using (trial_id, spec_hash)") == [("pair3", "human", None, True)]


def test_importing_twice_or_beside_a_sweep_leaves_the_database_as_it_was(path):
    record = trial_record(parse_csv(LEFT.csv()), 4, 1)
    llm = record._replace(spec=replace(record.spec, spec_hash="another", source="llm"))
    Store(path).add_recorded([llm], {})
    files = {f"experiment_{n}_iter_{m}.csv": LEFT.csv() for n in (4, 5) for m in (0, 1)}
    assert imported(path, files).added == 4
    assert rows(path, "select count(*), count(distinct trial_id) from trials") == [(5, 4)]
    before = results_digest(path)
    again = imported(path, files)
    assert (again.added, again.stored, again.differing) == (0, 4, [])
    assert results_digest(path) == before


OTHER = [
    ("velocities.left", 120, 9.0),
    ("travelled_distance.right", 120, 60.0),
    ("end_state", 0, "Collided"),
    ("dt", 0, 51),
]


def test_a_trial_that_is_stored_with_other_values_is_named_and_kept(path):
    names = [f"experiment_4_iter_{number}.csv" for number in range(len(OTHER))]
    first = {f"{folder}/{name}": LEFT.csv() for name in names for folder in "ab"}
    report = imported(path, first)
    assert (report.added, report.stored) == (4, 4)
    kept = "from states where trial_id not like '%iter009' order by trial_id, step, side"
    before = rows(path, "from trials order by rep"), rows(path, kept)
    other = {name: changed(LEFT, *change) for name, change in zip(names, OTHER, strict=True)}
    report = imported(path, other | {"experiment_4_iter_9.csv": LEFT.csv()})
    assert (report.added, report.stored) == (1, 0)
    assert sorted(report.differing) == [f"human/pair1/L_4_0/iter00{number}" for number in range(4)]
    assert (rows(path, "from trials where rep < 9 order by rep"), rows(path, kept)) == before


def test_only_a_csv_of_a_trial_is_ever_read(path):
    def read():
        raise AssertionError

    others = [
        *(f"experiment_4_iter_1.{suffix}" for suffix in ("pkl", "mat")),
        *(f"experiment_4_training_{k}.{suffix}" for k in (1, 2) for suffix in ("csv", "mat")),
        *("simulation_4_iter_0.pkl", "auto_save.pkl", "participant_info.txt"),
        *("._experiment_4_iter_1.csv", "experiment_4_iter_1.csv.bak", "experiment_4_iter_.csv"),
    ]
    files = [replace(file(name, b""), content=read, size=10**9) for name in others]
    files += [
        file(f"experiment_{n}_iter_2.{end}", LEFT.csv()) for n, end in ((10, "CSV"), (9, "csv"))
    ]
    report = import_trials(sort_files(files), Store(path))
    assert (report.added, report.unreadable) == (2, [])
    assert rows(path, "select pair from trials order by all") == [("pair5",), ("pair6",)]
    with pytest.raises(UsageError, match="recordings never have"):
        sort_files([replace(file("experiment_4_iter_1.csv", b""), size=10**9)])


def test_what_is_stored_before_an_interruption_stays(path, monkeypatch):
    monkeypatch.setattr(load, "CHUNK", 2)

    def interrupt():
        raise KeyboardInterrupt

    files = [file(f"experiment_4_iter_{m}.csv", LEFT.csv()) for m in range(5)]
    stopped = [replace(one, content=interrupt) if one is files[3] else one for one in files]
    with pytest.raises(KeyboardInterrupt):
        import_trials(sort_files(stopped), Store(path))
    assert rows(path, "select rep from trials order by rep") == [(0,), (1,)]
    report = import_trials(sort_files(files), Store(path))
    assert (report.added, report.stored) == (3, 2)


def test_a_page_gives_the_trials_that_the_recordings_give(tmp_path):
    one, other = tmp_path / "pages.duckdb", tmp_path / "recordings.duckdb"
    pages = {"plots/4_0.html": velocity_page(DRIVEN, packed)}
    recordings = {
        f"experiment_{number}_iter_{label[2:]}.csv": DRIVEN[label].csv()
        for label, number in (("1-1", 4), ("3-12", 6))
    }
    assert (imported(one, pages).added, imported(other, recordings).added) == (2, 2)
    trials = "SELECT trial_id, pair, condition, rep, status, merged_first, end_time_s FROM trials"
    assert rows(one, f"{trials} ORDER BY ALL") == rows(other, f"{trials} ORDER BY ALL")
    states = (
        "SELECT trial_id, step, side, time_s, position_m, velocity_mps, acceleration_mps2 "
        "FROM states ORDER BY ALL"
    )
    first, second = rows(one, states), rows(other, states)
    assert [row[:3] for row in first] == [row[:3] for row in second]
    apart = np.array([row[3:] for row in first]) - np.array([row[3:] for row in second])
    assert np.abs(apart).max() < 1e-9
    # Recordings after pages leave these as they are.
    report = imported(one, recordings)
    assert (report.added, report.stored, report.differing) == (0, 2, [])
