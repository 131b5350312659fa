"""Caches and databases from others: only replies are read, each verified, and no name leads out."""

import contextlib
import json
import shutil
import sqlite3
from dataclasses import asdict
from functools import partial

import diskcache
import duckdb
import pytest

from merge_runner.errors import RecordingError, UsageError
from merge_runner.llm.cache import ResponseCache, import_folder
from merge_runner.llm.store import CachedCall
from merge_runner.records import Attempt
from tests.support.raw_server import a_request

SECRET = "what nobody else may read"
PART = ("baseline", "--reps", 1, "--conditions", "N_0_0")


def entry(number):
    return CachedCall(a_request(number), (Attempt(1, "ok", 200, reply="{}"),))


FIRST, SECOND = entry(1), entry(2)


@pytest.fixture(scope="module")
def theirs(tmp_path_factory):
    cache = ResponseCache(tmp_path_factory.mktemp("theirs"))
    cache.put_now([FIRST, SECOND])
    cache.close()
    return cache.folder


@pytest.fixture
def folder(theirs, tmp_path):
    """A folder with two replies, as anybody may hand it over."""
    return shutil.copytree(theirs, tmp_path / "theirs")


@pytest.fixture
def own(tmp_path):
    with contextlib.closing(ResponseCache(tmp_path / "own")) as cache:
        yield cache


@pytest.fixture
def cache(folder):
    """That folder, used as it is."""
    with contextlib.closing(ResponseCache(folder)) as cache:
        yield cache


@contextlib.contextmanager
def database(folder):
    with contextlib.closing(sqlite3.connect(folder / "cache.db")) as opened, opened:
        yield opened


def everything_in(folder):
    """Every file of a folder, with its content."""
    return {each.name: each.read_bytes() for each in folder.iterdir()}


# diskcache's modes: a value in the row, bytes, a text, or a pickle in the file.
@pytest.mark.parametrize(
    ("mode", "leads"), [*((mode, "absolutely") for mode in range(5)), (4, "up"), (2, "inside")]
)
def test_a_file_that_a_row_names_is_neither_read_nor_deleted(folder, mode, leads):
    victim = folder.with_name("diary.txt")
    victim.write_text(SECRET)
    inside = folder / "aa/bb/value.val"
    inside.parent.mkdir(parents=True)
    inside.write_text(SECRET)
    names = {"absolutely": str(victim), "up": f"../{victim.name}", "inside": "aa/bb/value.val"}
    key = FIRST.request.key
    with database(folder) as opened:
        opened.execute(
            "UPDATE Cache SET mode = ?, filename = ?, value = NULL WHERE key = ?",
            [mode, names[leads], key],
        )
    cache = ResponseCache(folder)
    with pytest.raises(RecordingError, match="did not write it"):
        cache.get(key)
    assert cache.run_now([partial(cache.quarantine, key)]) == [[key]]
    assert cache.put_now([FIRST]) == [FIRST]
    assert list(cache.entries()) == [SECOND, FIRST]
    cache.run_now([partial(cache.remove, f"damaged {key}")])
    cache.close()
    assert inside.read_text() == victim.read_text() == SECRET
    shutil.rmtree(folder / "aa")
    with database(folder) as opened:
        opened.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    assert SECRET.encode() not in b"".join(everything_in(folder).values())


def test_stock_diskcache_still_reads_what_is_written(folder):
    with diskcache.Cache(str(folder)) as stock:
        assert CachedCall.from_json(stock[FIRST.request.key][32:]) == FIRST
        assert len(stock) == len(list(stock))
        assert stock.check() == []


@pytest.mark.parametrize("sql", ["", "PRAGMA user_version = 1", "CREATE TABLE bookmarks (url)"])
def test_a_file_that_is_empty_or_of_another_program_is_not_taken_for_new(tmp_path, sql):
    """Or what a sweep has spent would begin at 0 again."""
    (tmp_path / "cache.db").touch()
    with database(tmp_path) as opened:
        opened.execute(sql)
    before = everything_in(tmp_path)
    with pytest.raises(UsageError, match="cannot be used: no such table"):
        ResponseCache(tmp_path)
    assert everything_in(tmp_path) == before


def test_a_new_folder_is_made_whole_or_not_at_all(tmp_path, monkeypatch):
    """A process that dies while it makes the file leaves none that is empty."""

    def dies(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("os.replace", dies)
    with pytest.raises(KeyboardInterrupt):
        ResponseCache(tmp_path / "new")
    assert not (tmp_path / "new/cache.db").exists()
    monkeypatch.undo()
    ResponseCache(tmp_path / "new").close()


def test_a_folder_is_imported_and_left_as_it_is(folder, own):
    before = (folder / "cache.db").read_bytes()
    assert import_folder(folder, own) == (2, 0)
    assert (folder / "cache.db").read_bytes() == before
    assert own.names("spent ") == []
    # What is damaged here is mended.
    with database(own.folder) as opened:
        opened.execute("UPDATE Cache SET value = 'x' WHERE key = ?", [FIRST.request.key])
    assert import_folder(folder, own) == (1, 1)
    assert list(own.entries()) == [SECOND, FIRST]


def test_a_folder_is_imported_with_what_its_last_run_has_not_written_back(cache, own, tmp_path):
    cache.put_now([entry(3)])
    copied = shutil.copytree(cache.folder, tmp_path / "copied")
    assert (copied / "cache.db-wal").stat().st_size
    assert import_folder(copied, own) == (3, 0)


FIELDS = {
    "an answer to another question": {"key": SECOND.request.key},
    "a changed question": {"body": '{"prompt":7}'},
    "another endpoint": {"endpoint": "http://elsewhere"},
    "another model's path": {"path": "/responses"},
    "another slot": {"slot": {**asdict(FIRST.request.slot), "repetition": 2}},
    "another version": {"headers": {"anthropic-version": "1"}},
    "a reply that is nested too deep": {"reply": "[" * 100_000},
    "a status that is none": {"http_status": 2**40},
}


def plant(cache, key, /, **changes):
    """An entry behind a checksum that fits, with other parts of its request or its attempt."""
    text = json.loads(FIRST.to_json())
    for part in (text["entry"]["request"], text["entry"]["attempts"][0]):
        part.update({name: value for name, value in changes.items() if name in part})
    cache.run_now([partial(cache.replace, key, json.dumps(text))])


@pytest.mark.parametrize("changes", FIELDS.values(), ids=FIELDS)
def test_an_answer_is_never_used_for_another_question_nor_an_attempt_that_no_run_makes(
    folder, cache, own, changes
):
    """Whether the folder is used as it is, or imported."""
    plant(cache, FIRST.request.key, **changes)
    is_attempt = changes.keys() <= {"reply", "http_status"}
    with pytest.raises(RecordingError, match=None if is_attempt else "does not belong"):
        cache.get(FIRST.request.key)
    with pytest.raises(RecordingError, match=r"1 calls of .* 1 rows are left out"):
        import_folder(folder, own)
    assert list(own.entries()) == [SECOND]


async def test_the_command_takes_a_folder_and_says_what_it_left(merge_runner, tmp_path):
    assert (await merge_runner("sweep", *PART)).code == 0
    (tmp_path / "cache/responses").rename(tmp_path / "theirs")
    nothing = await merge_runner("recording", "import", "results", code=2)
    assert "there is no cache in results" in nothing.err
    with database(tmp_path / "theirs") as opened:
        opened.execute("UPDATE Cache SET value = 7 WHERE value LIKE '%\"decision\":4%'")
    taken = await merge_runner("recording", "import", "theirs", code=1)
    assert "2 rows are left out" in taken.err
    replay = await merge_runner("replay", *PART, "--db", "new", "--json")
    assert replay.summary["calls"]["cached"] > 0


async def test_no_name_of_a_condition_leads_out_of_the_folder_of_an_export(merge_runner, tmp_path):
    sweep = ("sweep", *PART[:-1], "N_0_0,L_4_0", "--model", "constant")
    assert (await merge_runner(*sweep)).code == 0
    with duckdb.connect(str(tmp_path / "results/merge.duckdb")) as opened:
        opened.execute("UPDATE trials SET condition = if(condition = 'N_0_0', 'a/b', '../up')")
    await merge_runner("view", "--trials", "*", "--export", "shared/pages", code=0)
    assert [path.name for path in (tmp_path / "shared").iterdir()] == ["pages"]
    pages = "".join(path.read_text() for path in (tmp_path / "shared/pages").glob("*.*"))
    assert "constant/baseline/N_0_0/rep01" in pages
    assert "constant/baseline/L_4_0/rep01" in pages
