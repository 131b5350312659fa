"""Caches and databases from others: only replies are read, each verified, and no name leads out."""

from __future__ import annotations

import contextlib
import json
import shutil
import sqlite3
from dataclasses import asdict

import diskcache
import duckdb
import pytest

from merge_runner.errors import RecordingError, UsageError
from merge_runner.llm.cache import CachedCall, ResponseCache, import_folder
from merge_runner.records import Attempt, make_request
from tests.support.raw_server import a_request

SECRET = "what nobody else may read"
PART = ("baseline", "--reps", 1, "--conditions", "N_0_0")


def entry(number):
    return CachedCall(a_request(number), (Attempt(1, "ok", 200, reply="{}"),))


FIRST, SECOND = entry(1), entry(2)


@pytest.fixture
def folder(tmp_path):
    """A folder with two replies, as anybody may hand it over."""
    cache = ResponseCache(tmp_path / "theirs")
    cache.put_now([FIRST, SECOND])
    cache.close()
    return tmp_path / "theirs"


@pytest.fixture
def own(tmp_path):
    cache = ResponseCache(tmp_path / "own")
    yield cache
    cache.close()


@pytest.fixture
def victim(tmp_path):
    """A file of the user's, which no cache may touch."""
    file = tmp_path / "diary.txt"
    file.write_text(SECRET)
    yield file
    assert file.read_text() == SECRET


@pytest.fixture
def cache(folder):
    """That folder, used as it is."""
    cache = ResponseCache(folder)
    yield cache
    cache.close()


@contextlib.contextmanager
def database(folder):
    with contextlib.closing(sqlite3.connect(folder / "cache.db")) as opened, opened:
        yield opened


def everything_in(folder):
    """Every file of a folder, with its content."""
    return {each.name: each.read_bytes() for each in folder.iterdir()}


# diskcache's modes: a value in the row, bytes, a text, or a pickle in the file.
@pytest.mark.parametrize(
    ("mode", "leads"),
    [*((mode, "absolutely") for mode in range(5)), (2, "up"), (4, "up"), (2, "inside")],
)
def test_a_file_that_a_row_names_is_neither_read_nor_deleted(folder, victim, mode, leads):
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
    with pytest.raises(RecordingError, match="not ours"):
        cache.get(key)
    assert cache.set_damage_aside(key) == [key]
    assert cache.put_now([FIRST]) == [FIRST]
    assert list(cache.entries()) == [SECOND, FIRST]
    cache.run_now([lambda: cache.remove(f"damaged {key}")])
    cache.close()
    assert inside.read_text() == SECRET
    shutil.rmtree(folder / "aa")
    with database(folder) as opened:
        opened.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    assert SECRET.encode() not in b"".join(everything_in(folder).values())


def test_the_database_of_another_program_is_left_alone(tmp_path):
    with database(tmp_path) as opened:
        opened.execute("CREATE TABLE bookmarks (url)")
    before = everything_in(tmp_path)
    with pytest.raises(UsageError, match="cannot be used: no such table"):
        ResponseCache(tmp_path)
    assert everything_in(tmp_path) == before


def test_stock_diskcache_still_reads_what_is_written(folder):
    with diskcache.Cache(str(folder)) as stock:
        assert CachedCall.from_json(stock[FIRST.request.key][32:]) == FIRST
        assert len(stock) == len(list(stock))
        assert stock.check() == []


@pytest.mark.parametrize("left", ["nothing", "no table"])
def test_a_file_that_is_empty_is_not_taken_for_new(folder, left):
    """Or what a sweep has spent would begin at 0 again."""
    file = folder / "cache.db"
    file.unlink()
    file.touch()
    if left == "no table":
        with database(folder) as opened:
            opened.execute("PRAGMA user_version = 1")
    before = everything_in(folder)
    with pytest.raises(UsageError, match="cannot be used: no such table"):
        ResponseCache(folder)
    assert everything_in(folder) == before


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
    assert import_folder(folder, own) == (0, 2)
    assert list(own.entries()) == [FIRST, SECOND]
    assert (folder / "cache.db").read_bytes() == before
    assert own.names("spent ") == []


def test_a_folder_is_imported_with_what_its_last_run_has_not_written_back(folder, own, tmp_path):
    theirs = ResponseCache(folder)
    theirs.put_now([entry(3)])
    shutil.copytree(folder, tmp_path / "copied")
    theirs.close()
    assert (tmp_path / "copied/cache.db-wal").stat().st_size
    assert import_folder(tmp_path / "copied", own) == (3, 0)


FIELDS = {
    "an answer to another question": {"key": SECOND.request.key},
    "a changed question": {"body": '{"prompt":7}'},
    "another endpoint": {"endpoint": "http://elsewhere"},
    "another model's path": {"path": "/responses"},
    "another slot": {"slot": {**asdict(FIRST.request.slot), "repetition": 2}},
    "another version": {"headers": {"anthropic-version": "1"}},
}


def plant(cache, key, /, **changes):
    """An entry behind a checksum that fits, with other parts of its request or its attempt."""
    text = json.loads(FIRST.to_json())
    for part in (text["entry"]["request"], text["entry"]["attempts"][0]):
        part.update({name: value for name, value in changes.items() if name in part})
    cache.run_now([lambda: cache.replace(key, json.dumps(text))])


@pytest.mark.parametrize("changes", FIELDS.values(), ids=FIELDS)
def test_an_answer_is_never_used_for_another_question(folder, cache, own, changes):
    """Whether the folder is used as it is, or imported."""
    plant(cache, FIRST.request.key, **changes)
    with pytest.raises(RecordingError, match="does not belong to its key"):
        cache.get(FIRST.request.key)
    with pytest.raises(RecordingError, match=r"1 calls of .* 1 rows are left out"):
        import_folder(folder, own)
    assert list(own.entries()) == [SECOND]


@pytest.mark.parametrize(
    "changes",
    [
        *({"reply": reply} for reply in ("no JSON", "[]", "[" * 100_000)),
        *({"number": -1}, {"http_status": 2**40}, {"cost_usd": -5.0}, {"started_at": "yesterday"}),
        {"usage": {"input_tokens": -1}},
    ],
    ids=range(8),
)
def test_an_attempt_that_no_run_makes_is_refused(folder, cache, own, changes):
    plant(cache, FIRST.request.key, **changes)
    with pytest.raises(RecordingError, match="1 rows are left out"):
        import_folder(folder, own)
    with pytest.raises(RecordingError):
        cache.get(FIRST.request.key)


def test_a_request_that_nobody_sends_is_refused(folder, cache, own):
    """Its key is right, but its body is no JSON object."""
    request = FIRST.request
    parts = {"path": request.path, "headers": {}, "body": ["x"], "slot": request.slot}
    made = make_request(provider="openai", endpoint="openai", model="m", **parts)
    cache.put_now([CachedCall(made, FIRST.attempts)])
    with pytest.raises(RecordingError, match="not a canonical JSON object"):
        import_folder(folder, own)


def test_an_import_mends_what_is_damaged_here(folder, own):
    own.put_now([FIRST])
    with database(own.folder) as opened:
        opened.execute("UPDATE Cache SET value = 'x' WHERE key = ?", [FIRST.request.key])
    assert import_folder(folder, own) == (2, 0)
    assert own.get(FIRST.request.key) == FIRST


async def test_the_command_takes_a_folder_and_says_what_it_left(merge_runner, tmp_path):
    assert (await merge_runner("sweep", *PART)).code == 0
    (tmp_path / "cache/responses").rename(tmp_path / "theirs")
    nothing = await merge_runner("recording", "import", "results")
    assert nothing.code == 2
    assert "there is no cache in results" in nothing.err
    with database(tmp_path / "theirs") as opened:
        opened.execute("UPDATE Cache SET value = 7 WHERE value LIKE '%\"decision\":4%'")
    taken = await merge_runner("recording", "import", "theirs")
    assert taken.code == 1
    assert "2 rows are left out" in taken.err
    replay = await merge_runner("replay", *PART, "--db", "new", "--json")
    assert replay.summary["calls"]["cached"] > 0


async def test_no_name_of_a_condition_leads_out_of_the_folder_of_an_export(merge_runner, tmp_path):
    both = (*PART[:-1], "N_0_0,L_4_0")
    assert (await merge_runner("sweep", *both, "--model", "constant")).code == 0
    with duckdb.connect(str(tmp_path / "results/merge.duckdb")) as opened:
        opened.execute("UPDATE trials SET condition = if(condition = 'N_0_0', 'a/b', '../up')")
    run = await merge_runner("view", "--trials", "*", "--export", "shared/pages")
    assert run.code == 0, run.err
    assert [path.name for path in (tmp_path / "shared").iterdir()] == ["pages"]
    pages = [path for path in (tmp_path / "shared/pages").iterdir() if path.is_file()]
    for name in both[-1].split(","):
        assert any(f"constant/baseline/{name}/rep01" in page.read_text() for page in pages)
