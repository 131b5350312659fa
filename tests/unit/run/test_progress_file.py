"""What a running sweep tells other processes in the file beside its database."""

import os
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace

import pytest

from merge_runner.llm.ledger import Spending
from merge_runner.run import progress_file
from merge_runner.run.local_runner import LocalRunner
from merge_runner.run.plan import make_plan
from merge_runner.run.progress import Progress
from merge_runner.run.progress_file import (
    clear_dead,
    read_snapshot,
    remove_snapshot,
    write_snapshot,
)
from tests.support.snapshots import session

NO_PROCESS = 2**22 + 1  # above the largest that Linux gives
LONG_AGO = datetime(2026, 1, 1, tzinfo=UTC)
LEDGER = SimpleNamespace(spending=Spending(), cap=None)


def snapshot(sweep_id="s", **changes):
    plan = make_plan("baseline", "constant", repetitions=2, conditions=["N_0_0"])
    run = session(plan, LEDGER, {"baseline": 2})
    plain = Progress(run, LocalRunner(plan, {}, 0)).snapshot(sweep_id)
    return plain.model_copy(update=changes)


@pytest.mark.parametrize(
    ("changes", "age_s", "alive"),
    [
        ({}, 9, True),
        ({}, 11, False),  # frozen
        ({"doing": "checking"}, 11, False),
        ({"pid": NO_PROCESS}, 1, False),
        ({"pid": NO_PROCESS, "machine": "another"}, 1, True),  # its ids mean nothing here
    ],
)
def test_a_sweep_is_dead_when_its_process_is_gone_or_silent(monkeypatch, changes, age_s, alive):
    now = datetime.now(UTC)
    monkeypatch.setattr(progress_file, "datetime", SimpleNamespace(now=lambda _: now))
    updated_at = now - timedelta(seconds=age_s)
    assert snapshot(updated_at=updated_at, **changes).alive == alive


def test_only_what_a_killed_sweep_wrote_is_tidied_up(tmp_path):
    """A folder from elsewhere may lead to one of the user's, or hold files of other programs."""
    db, documents = tmp_path / "m.duckdb", tmp_path / "documents"
    write_snapshot(db, snapshot("a", updated_at=LONG_AGO))
    (tmp_path / "m.duckdb.progress").rename(documents)
    for name in ("notes.json", "thesis.tmp"):
        (documents / name).write_text("{}")
        os.utime(documents / name, (0, 0))
    before = sorted(documents.iterdir())
    (tmp_path / "m.duckdb.progress").symlink_to(documents)
    clear_dead(db)
    assert sorted(documents.iterdir()) == before
    (tmp_path / "m.duckdb.progress").unlink()
    documents.rename(tmp_path / "m.duckdb.progress")
    clear_dead(db)
    left = {path.name for path in (tmp_path / "m.duckdb.progress").iterdir()}
    assert left == {"notes.json", "thesis.tmp"}


def test_the_name_of_a_sweep_leads_out_of_no_folder_and_one_that_lives_keeps_its_file(tmp_path):
    db, name = tmp_path / "m.duckdb", "../outside"
    write_snapshot(db, snapshot("a"))
    write_snapshot(db, snapshot("b", updated_at=LONG_AGO))
    clear_dead(db)
    assert (read_snapshot(db, "a").alive, read_snapshot(db, "b")) == (True, None)
    (tmp_path / "outside.json").write_text(snapshot(name).model_dump_json())
    assert read_snapshot(db, name) is None
    remove_snapshot(db, name)
    assert (tmp_path / "outside.json").exists()


def test_a_disk_that_takes_no_file_fails_nothing(tmp_path):
    (tmp_path / "m.duckdb.progress").write_text("a file where the folder should be")
    write_snapshot(tmp_path / "m.duckdb", snapshot())
    remove_snapshot(tmp_path / "m.duckdb", "s")
    clear_dead(tmp_path / "m.duckdb")


@pytest.mark.parametrize("text", ["", "{", '{"sweep_id": "s"}', "\x00" * 9, "[" * 10_000])
def test_a_file_that_is_none_of_ours_says_nothing(tmp_path, text):
    (tmp_path / "m.duckdb.progress").mkdir()
    (tmp_path / "m.duckdb.progress/s.json").write_text(text)
    assert read_snapshot(tmp_path / "m.duckdb", "s") is None
