import asyncio
import contextlib
import gc
import json
import shutil
import sqlite3
import stat
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import diskcache
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from merge_runner.errors import MergeRunnerError, RecordingError, UsageError
from merge_runner.llm import templates
from merge_runner.llm.cache import ResponseCache, import_folder
from merge_runner.llm.cache_format import CREATE_TABLES, TextDisk
from merge_runner.llm.ledger import Ledger
from merge_runner.llm.store import CachedCall
from merge_runner.records import Attempt, ChatRequest, Slot, Usage, make_request
from tests.support.cases import cases
from tests.support.hostile import Bomb
from tests.support.json_values import paths, replaced


def entry(number=0, *, model="m", endpoint="openai", reply="{}", **attempt):
    named = {"provider": "openai", "endpoint": endpoint, "model": model, "path": "/p"}
    slot = Slot("A1", 1, "left", number, 0)
    request = make_request(**named, headers={}, body={"prompt": number}, slot=slot)
    return CachedCall(request, (Attempt(1, "ok", 200, reply=reply, **attempt),))


def said(text):
    """A reply: what an answer holds is a JSON object."""
    return json.dumps({"text": text})


def by_key(*entries):
    return {each.request.key: each for each in entries}


def counted(entries):
    """How many of these calls there are of each kind."""
    return templates.count_by_template((each.request, each.attempts[-1]) for each in entries)


def overlaid(entries):
    return entries, counted(entries.values())


async def keep(cache, kept):
    return await cache.write(partial(cache.keep, kept))


async def put(cache, *entries):
    # The limit only ends a test whose write is lost.
    async with asyncio.timeout(10):
        await asyncio.gather(*(keep(cache, each) for each in entries))


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "responses"


@pytest.fixture
def cache(folder):
    with contextlib.closing(ResponseCache(folder)) as opened:
        yield opened


@pytest.fixture
def other(cache, folder):
    """The same folder, opened by another process."""
    with contextlib.closing(ResponseCache(folder)) as opened:
        yield opened


def endpoints(cache, model):
    return sorted(templates.recorded_values(cache, "endpoint", model=model))


def left_out(cache):
    """Why rows are left out where all entries are read, none of which is whole."""
    reasons = []
    assert list(cache.entries(reasons)) == []
    return reasons


@pytest.fixture
def stock(cache, folder):
    """What any other program makes of the folder."""
    with diskcache.Cache(str(folder)) as opened:
        yield opened


def aside(cache, key):
    """The names of what is damaged of a call, and set aside."""
    return cache.run_now([partial(cache.quarantine, key)])[0]


texts = st.text(st.characters(exclude_categories=["Cs"]))
counts = st.none() | st.integers(0, 10**9)
numbers = st.none() | st.floats(0, 2**31 - 1)
named = ("model_served", "finish_reason", "started_at", "reply", "error")
attempts = st.builds(
    Attempt,
    number=st.integers(1, 99),
    outcome=st.from_regex("[a-z][a-z0-9_]{0,39}", fullmatch=True),
    http_status=st.none() | st.integers(100, 599),
    usage=st.builds(Usage, counts, counts, counts, counts),
    **dict.fromkeys(("latency_s", "cost_usd"), numbers),
    **dict.fromkeys(named, st.none() | texts),
)
slots = st.builds(
    Slot,
    st.from_regex("[A-Za-z0-9_.-]+", fullmatch=True),
    *(st.integers(1, 10**5), st.sampled_from(["left", "right"])),
    *(st.integers(0, 10**5), st.integers(0)),
)
requests = st.builds(
    ChatRequest,
    headers=st.dictionaries(texts, texts, max_size=3),
    slot=slots,
    **dict.fromkeys(("key", "provider", "endpoint", "model", "path", "body"), texts),
)


@settings(max_examples=30)
@given(st.builds(CachedCall, requests, st.lists(attempts, min_size=1, max_size=3).map(tuple)))
def test_an_entry_survives_its_text_form(recorded):
    assert CachedCall.from_json(recorded.to_json()) == recorded


PUT_AND_DIE = """
import asyncio, os, sys
from functools import partial
from pathlib import Path
from merge_runner.llm.cache import CachedCall, ResponseCache
async def keep():
    cache = ResponseCache(Path(sys.argv[1]))
    await cache.write(partial(cache.keep, CachedCall.from_json(sys.argv[2])))
asyncio.run(keep())
os._exit(7)
"""


async def test_calls_are_all_stored_or_not_whether_their_replies_are_damaged_or_not(cache, stock):
    await put(cache, *map(entry, range(3)))
    keys = [entry(number).request.key for number in range(4)]
    stock[keys[1]] = "damaged"
    assert cache.has_all([])
    assert cache.has_all([*keys[:3], keys[0]])
    assert not cache.has_all(keys)
    assert not cache.has_all(keys[3:])
    statements = []
    cache.reading.set_trace_callback(statements.append)
    assert cache.has_all(keys[:3])
    assert len(statements) == 1


def test_a_reply_outlives_a_process_that_dies_after_it_is_kept(folder):
    arguments = [sys.executable, "-c", PUT_AND_DIE, folder, entry(1).to_json()]
    assert subprocess.run(arguments, check=False).returncode == 7
    reopened = ResponseCache(folder)
    assert reopened.get(entry(1).request.key) == entry(1)
    reopened.close()


async def test_many_concurrent_puts_are_all_kept_and_readable_by_others(cache, other):
    written = [entry(number, reply=said("x" * 5000)) for number in range(200)]
    assert other.get(written[0].request.key) is None
    await put(cache, *written)
    assert [other.get(each.request.key) for each in written] == written
    assert {each.request.key for each in other.entries()} == {w.request.key for w in written}


async def test_a_kept_reply_is_never_replaced(cache, other):
    """Where another process was first, its reply is the one that all go on with."""
    first, second = entry(1, reply=said("first")), entry(1, reply=said("second"))
    assert await keep(other, first) == first
    assert await keep(cache, second) == first
    assert cache.put_now([second, entry(2)]) == [first, entry(2)]
    twice = [entry(3, reply=said(text)) for text in ("first", "second")]
    assert cache.put_now(twice) == twice[:1] * 2
    assert cache.get(second.request.key) == first


async def test_a_put_that_is_cancelled_or_cannot_be_kept_disturbs_no_other(cache):
    given_up = asyncio.create_task(keep(cache, entry(1)))
    kept = asyncio.create_task(put(cache, entry(2)))
    await asyncio.sleep(0)
    given_up.cancel()
    await kept
    # No file can hold half a surrogate pair, for example.
    with pytest.raises(ValueError, match="surrogates"):
        await put(cache, entry(3, error="\ud800"))
    await put(cache, entry(4))
    assert cache.get(entry(2).request.key) == entry(2)
    assert cache.get(entry(4).request.key) == entry(4)


async def test_a_write_that_fails_is_told_to_all_who_wait(cache, folder):
    cache.run_now([])  # diskcache makes a missing table when it is opened
    with sqlite3.connect(folder / "cache.db") as database:
        database.execute("DROP TABLE Cache")
    writing = (keep(cache, entry(1)), keep(cache, entry(2)))
    async with asyncio.timeout(10):
        results = await asyncio.gather(*writing, return_exceptions=True)
    assert [isinstance(result, MergeRunnerError) for result in results] == [True, True]


async def test_what_fails_alone_is_undone_alone_and_those_written_with_it_are_kept(cache):
    def add(name, execute):
        cache.replace(name, "text", execute)
        execute("INSERT INTO open (scope, usd) VALUES (?, 1.0)", (name,))
        return name

    def add_and_fail(execute):
        add("row 2", execute)
        raise RecordingError("no reply of ours")

    operations = (partial(add, "row 1"), add_and_fail, partial(add, "row 3"))
    first, failed, last = await asyncio.gather(
        *map(cache.write, operations), return_exceptions=True
    )
    assert isinstance(failed, RecordingError)
    assert (first, last) == ("row 1", "row 3")
    assert cache.names("row ") == ["row 1", "row 3"]
    assert cache.rows("SELECT scope FROM open ORDER BY scope") == [("row 1",), ("row 3",)]


async def test_damage_is_set_aside_by_the_writer_while_another_process_writes(
    cache, stock, folder, monkeypatch
):
    """Nothing else could go on while the event loop waited for the other one."""
    monkeypatch.setattr("merge_runner.llm.durable.BUSY_S", 0.0)
    key = entry(1).request.key
    stock[key] = "no JSON"
    with contextlib.closing(sqlite3.connect(folder / "cache.db", isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        keeping = asyncio.create_task(keep(cache, entry(1)))
        await asyncio.sleep(0)
        other.execute("COMMIT")
    assert await keeping == entry(1)
    assert stock[f"damaged {key}"] == "no JSON"


def test_the_folder_is_for_its_owner_alone(folder):
    ResponseCache(folder).close()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    folder.chmod(0o755)
    ResponseCache(folder).close()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


# The stock library keeps a long value in a file of its own.
@pytest.mark.parametrize("padding", ["", "x" * 100_000], ids=["row", "file"])
def test_a_planted_value_is_refused_and_not_executed(cache, stock, tmp_path, padding):
    key = entry().request.key
    stock[key] = [Bomb(tmp_path / "mark"), padding]
    with pytest.raises(RecordingError):
        cache.get(key)
    assert left_out(cache) == [
        "the cache holds a pickle or names a file: merge-runner did not write it"
    ]
    assert not (tmp_path / "mark").exists()


def test_no_key_is_unpickled_where_all_are_listed(cache, stock, tmp_path):
    stock[Bomb(tmp_path / "mark")] = entry().to_json()
    assert left_out(cache) == [
        "the cache holds a key that is no text: merge-runner did not write it"
    ]
    with (
        diskcache.Cache(str(cache.folder), disk=TextDisk) as texts,
        pytest.raises(RecordingError, match="a key that is no text"),
    ):
        list(texts)
    assert not (tmp_path / "mark").exists()
    for key, value in [(b"bytes", ""), *(("key", each) for each in (1, 1.5, None, b"{}", {}))]:
        with pytest.raises(TypeError):
            texts[key] = value


def test_nothing_is_ever_evicted_and_each_write_is_synchronous(cache, stock):
    cache.put_now([entry(number, reply=said("x" * 10_000)) for number in range(20)])
    assert len(list(cache.entries())) == 20
    assert (stock.eviction_policy, stock.cull_limit) == ("none", 0)
    # An acknowledged reply survives a power cut only with SQLite's FULL.
    assert stock.sqlite_synchronous == 2


def test_a_file_with_the_counts_of_diskcache_goes_on_without_them(folder):
    """They are triggers, and other programs that open the file with diskcache make none anew."""
    counting = "SELECT name FROM sqlite_master WHERE type = 'trigger' AND tbl_name = 'Cache'"
    with contextlib.closing(ResponseCache(folder)) as cache:
        cache.put_now([entry(1)])
    with contextlib.closing(sqlite3.connect(folder / "cache.db")) as database, database:
        for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'"):
            database.execute(f"DROP TRIGGER {name}")
    with diskcache.Cache(str(folder)) as stock:
        assert len(stock._sql(counting).fetchall()) == 5
    for _ in range(2):
        with contextlib.closing(ResponseCache(folder)) as cache:
            cache.put_now([entry(2)])
            assert list(cache.entries()) == [entry(1), entry(2)]
            assert cache.rows(counting) == []
        with diskcache.Cache(str(folder)) as stock:
            assert not stock._sql(counting).fetchall()
            assert stock.check() == []


PLANTED = {
    "durability ends": ("sqlite_journal_mode", "off"),
    "durability ends, in other letters": ("sqlite_SYNCHRONOUS", 0),
    "a traceback": ("disk_x", 1),
    "replies are evicted": ("eviction_policy", "least-recently-stored"),
    "another folder": ("_directory", "elsewhere"),
    "no text": (b"size_limit", 1),
    "a name that speaks to a terminal": ("\x1b[2J", 1),
}


@pytest.mark.parametrize(("name", "value"), PLANTED.values(), ids=PLANTED)
@pytest.mark.parametrize("read_only", [False, True])
def test_a_file_with_settings_of_others_is_refused(folder, cache, name, value, read_only):
    changed(folder, "REPLACE INTO Settings VALUES (:name, :value)", name=name, value=value)
    with pytest.raises(UsageError, match=r"has the setting .* of another program") as caught:
        ResponseCache(folder, read_only=read_only)
    assert "\x1b" not in str(caught.value)


NEEDED = {"version", "entry", "request", "attempts", "number", "outcome", "slot", "condition"}
NEEDED |= {"side", "decision", "repetition", "sample_set"}
NEEDED |= {"key", "provider", "endpoint", "model", "path", "body"}
WHOLE = json.loads(entry().to_json())
PATHS = list(paths(WHOLE))


def damaged(path, *value):
    """The text of an entry with one value replaced, or left out."""
    return json.dumps(replaced(WHOLE, path, *value))


DAMAGED = [
    *("", "no JSON", entry().to_json()[:-20], "[]", "1", "null"),
    damaged(["version"], 2),
    damaged(["entry", "attempts"], []),
    damaged(["entry", "attempts", 0, "number"], "1"),
    *(damaged(path, [[]]) for path in PATHS),
    *(damaged(path) for path in PATHS if path[-1] in NEEDED),
]


def test_a_damaged_entry_is_an_error_and_no_reply(cache, stock):
    for number, text in enumerate(DAMAGED):
        stock[f"{number:064x}"] = text
        with pytest.raises(MergeRunnerError):
            cache.get(f"{number:064x}")
    assert len(left_out(cache)) == len(DAMAGED)


async def test_damaged_attempts_are_set_aside_and_good_ones_are_not(cache, stock):
    key = entry(1).request.key
    await cache.write(partial(cache.keep_attempts, key, entry(1).attempts))
    assert aside(cache, key) == []
    name = next(name for name in stock if name.startswith("attempts "))
    stock[name] = "no JSON"
    assert aside(cache, key) == [name]
    assert aside(cache, key) == []
    assert cache.look_up(key) == (None, ())
    assert stock[f"damaged {name}"] == "no JSON"


@pytest.mark.parametrize("mark", [None, "4", "7"])
@pytest.mark.parametrize("read_only", [False, True])
def test_a_folder_of_another_format_is_refused_and_left_alone(
    folder, cache, stock, mark, read_only
):
    del stock["format"]
    if mark is not None:
        stock["format"] = mark
    stock.close()
    cache.close()
    before = (folder / "cache.db").read_bytes()
    told = f"has format {mark or 1}, and this merge-runner has format 6: .*import FILE --cache NEW`"
    with pytest.raises(UsageError, match=told):
        ResponseCache(folder, read_only=read_only)
    assert (folder / "cache.db").read_bytes() == before


def test_a_folder_of_the_format_before_goes_on_with_its_replies_and_its_money(folder, tmp_path):
    kept = entry(1)
    with contextlib.closing(ResponseCache(folder)) as cache:
        cache.put_now([kept])
    before = shutil.copytree(folder, tmp_path / "before")
    with contextlib.closing(sqlite3.connect(before / "cache.db")) as database, database:
        database.execute("UPDATE Cache SET value = '5' WHERE key = 'format'")
        for table in ("spent", "open"):
            database.execute(f"DROP TABLE {table}")
    with contextlib.closing(sqlite3.connect(before / "ledger.db")) as database, database:
        for statement in CREATE_TABLES:
            database.execute(statement)
        database.execute("INSERT INTO spent VALUES ('a study', 'm', 0.5, 0, 0)")
        database.execute("INSERT INTO open (scope, call, usd) VALUES ('a study', 'key', 0.25)")
    with contextlib.closing(ResponseCache(folder)) as cache:
        assert import_folder(before, cache) == (0, 1)
    with pytest.raises(UsageError, match="a sweep or a replay with it brings it to format 6"):
        ResponseCache(before, read_only=True)
    for _ in range(2):
        with contextlib.closing(ResponseCache(before)) as cache:
            assert list(cache.entries()) == [kept]
            spending = Ledger(cache, "a study").spending
            assert (spending.spent_usd, spending.reserved_usd) == (0.5, 0.25)


def changed(folder, sql, **values):
    """Change one row behind the back of the cache."""
    with contextlib.closing(sqlite3.connect(folder / "cache.db")) as database, database:
        assert database.execute(sql, values).rowcount == 1


def row_of(folder, name):
    """All of a row that says something, as it is stored."""
    with contextlib.closing(sqlite3.connect(folder / "cache.db")) as database:
        database.text_factory = bytes
        (row,) = database.execute(
            "SELECT mode, filename, typeof(value), value FROM Cache WHERE key = ?", [name]
        )
    return row


@pytest.mark.parametrize("change", cases("cache_rows"))
def test_an_odd_row_is_told_set_aside_as_it_is_and_the_rest_goes_on(cache, folder, change):
    odd, good = entry(1, reply=said("kept")), entry(2, cost_usd=2)
    key = odd.request.key
    cache.put_now([odd, good])
    other = {"other": good.request.key} if ":other" in change else {}
    changed(folder, f"UPDATE Cache SET {change} WHERE key = :key", key=key, **other)
    before = row_of(folder, key)
    with pytest.raises(RecordingError):
        cache.get(key)
    reasons = []
    assert list(cache.entries(reasons)) == [good]
    assert len(reasons) == 1
    assert aside(cache, key) == [key]
    assert row_of(folder, f"damaged {key}") == before
    assert cache.get(key) is None
    assert cache.put_now([odd]) == [odd]
    assert (cache.get(key), cache.get(good.request.key)) == (odd, good)


def test_what_is_damaged_again_lies_beside_what_was_before(cache, folder):
    key = entry(1).request.key
    for text in ("one", "two", "three"):
        cache.put_now([entry(1)])
        changed(folder, "UPDATE Cache SET value = :text WHERE key = :key", key=key, text=text)
        assert aside(cache, key) == [key]
    names = (f"damaged {key}", f"damaged {key} 2", f"damaged {key} 3")
    assert [row_of(folder, name)[3] for name in names] == [b"one", b"two", b"three"]


FULL = [entry(number, cost_usd=1.0, reply=said("\u00e4" * 9)) for number in (1, 2)]


@pytest.fixture(scope="module")
def model_folder(tmp_path_factory):
    """A folder with a row of every kind; what it holds is in FULL."""
    folder = tmp_path_factory.mktemp("full") / "responses"
    cache = ResponseCache(folder)
    cache.put_now(FULL)
    cache.put_now([], [(entry(9).request.key, entry(9).attempts)])
    cache.close()
    gc.collect()  # the connections of other threads, or their files go while they are copied
    return folder


@settings(max_examples=25)
@given(st.data())
def test_any_one_changed_byte_of_the_file_is_harmless_or_an_error_of_ours(model_folder, data):
    with tempfile.TemporaryDirectory() as place:
        folder = shutil.copytree(model_folder, Path(place) / "responses")
        changed = bytearray((folder / "cache.db").read_bytes())
        changed[data.draw(st.integers(0, len(changed) - 1))] ^= data.draw(st.integers(1, 255))
        (folder / "cache.db").write_bytes(changed)
        found = {}
        with (
            contextlib.suppress(MergeRunnerError),
            contextlib.closing(ResponseCache(folder)) as cache,
        ):
            found |= by_key(*cache.entries())
            for each in FULL:
                with contextlib.suppress(RecordingError):
                    found |= by_key(*filter(None, [cache.get(each.request.key)]))
                aside(cache, each.request.key)
                assert cache.put_now([each]) == [each]
        assert all(each in FULL for each in found.values())


def test_what_is_no_folder_is_an_error_of_ours(folder):
    folder.touch()
    with pytest.raises(MergeRunnerError, match="cannot be used"):
        ResponseCache(folder)


def test_an_overlay_answers_before_the_folder_is_read_once_where_needed_and_never_written(folder):
    recorded = by_key(*(entry(number, reply=said("overlay")) for number in (1, 2)))
    happened = []

    @contextlib.contextmanager
    def overlay():
        happened.append("opened")
        yield overlaid(recorded)
        happened.append("closed")

    cache = ResponseCache(folder, overlay=overlay)
    cache.put_now([entry(1, reply=said("folder")), entry(3)])
    assert happened == []
    replies = [cache.get(entry(number).request.key) for number in (1, 2, 3, 4)]
    assert replies == [*recorded.values(), entry(3), None]
    assert {each.request.slot.decision for each in cache.entries()} == {1, 2, 3}
    assert endpoints(cache, "m") == ["openai"]
    assert happened == ["opened"]
    cache.close()
    assert happened == ["opened", "closed"]
    plain = ResponseCache(folder)
    assert {each.request.slot.decision for each in plain.entries()} == {1, 3}
    plain.close()


def test_calls_are_counted_by_kind_once_whichever_process_kept_them(cache, other, monkeypatch):
    tokens = Usage(input_tokens=100, output_tokens=7)
    first = [entry(n, endpoint=server, usage=tokens) for n in (1, 2) for server in "ab"]
    cache.put_now(first, unanswered=[(entry(9).request.key, (Attempt(1, "timeout"),))])
    assert templates.answer_counts(other) == templates.answer_counts(cache) == ({}, counted(first))
    # A reply takes the place of what was tried last, which no longer has a row.
    later = [entry(9), entry(3, usage=tokens), entry(4, scripted=True)]
    for each in later:
        cache.put_now([each])
    assert (
        templates.answer_counts(cache)
        == templates.answer_counts(other)
        == ({}, counted([*first, *later]))
    )
    assert [template.genuine for template in counted(later)] == [True, True, False]
    monkeypatch.setattr(CachedCall, "from_json", lambda text: pytest.fail("it is read again"))
    assert templates.answer_counts(cache) == ({}, counted([*first, *later]))


@pytest.mark.parametrize("batch", [1, 2, 1000])
def test_all_calls_are_counted_but_damaged_ones(cache, folder, monkeypatch, batch):
    monkeypatch.setattr("merge_runner.llm.templates.BATCH", batch)
    kept = [entry(number) for number in range(1, 6)]
    cache.put_now(kept)
    with contextlib.closing(sqlite3.connect(folder / "cache.db")) as database, database:
        for row, value in ((1, "'damaged'"), (3, "CAST(X'80' AS TEXT)")):
            damaged = f"UPDATE Cache SET value = {value} WHERE key = ?"
            database.execute(damaged, [kept[row].request.key])
    assert templates.answer_counts(cache)[1] == counted(kept[::2])
    assert [*cache.newest(9)] == [kept[4], kept[2], kept[0]]
    assert [*cache.newest(1)] == [kept[4]]


def test_endpoints_are_listed_per_model_the_folders_where_the_overlay_has_none(folder):
    recorded = [entry(8, model="a", endpoint="http://o"), entry(9, model="c", endpoint="http://o")]
    cache = ResponseCache(
        folder, overlay=lambda: contextlib.nullcontext(overlaid(by_key(*recorded)))
    )
    named = [entry(1, model="a"), *(entry(number, model="b") for number in (2, 3))]
    cache.put_now([*named, entry(4, model="b", endpoint="http://b")])
    found = {model: endpoints(cache, model) for model in "abcd"}
    assert found == {"a": ["http://o"], "b": ["http://b", "openai"], "c": ["http://o"], "d": []}
    cache.close()
