"""A recording may come from anybody: it is ours and whole, or it is refused and nothing is kept."""

from __future__ import annotations

import hashlib
import json
import math
import random
import sqlite3
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import duckdb
import pytest

from merge_runner.errors import MergeRunnerError, RecordingError
from merge_runner.llm.cache import CachedCall, ResponseCache
from merge_runner.records import Attempt, Slot, call_key, canonical_json
from merge_runner.results.recording import COLUMNS, export_recording, import_recording, summarise
from tests.support.raw_server import a_request

CALLS = 3
ANSWER = json.dumps({"choices": [{"message": {"content": "M\n[0.1]"}}]})


def entry(number, prompt=None):
    return CachedCall(a_request(number, prompt), (Attempt(1, "ok", 200, reply=ANSWER),))


@pytest.fixture
def file(tmp_path):
    """A recording that is whole."""
    cache = ResponseCache(tmp_path / "source")
    entries = [entry(number) for number in range(CALLS)]
    cache.put_now(entries)
    export_recording(tmp_path / "good.parquet", cache, [e.request.key for e in entries], {})
    cache.close()
    return tmp_path / "good.parquet"


@pytest.fixture
def cache(tmp_path):
    """The cache that a hostile file is after."""
    opened = ResponseCache(tmp_path / "target")
    opened.put_now([entry(99)])
    yield opened
    assert [kept.request.slot.decision for kept in opened.entries()] == [99]
    opened.close()


def rewritten(file, *changes, select="FROM calls", **told):
    """The recording with its rows and metadata changed, as somebody who knows the format would."""
    bad = file.with_name("bad.parquet")
    with duckdb.connect() as connection:
        pairs = connection.execute(f"FROM parquet_kv_metadata('{file}')").fetchall()
        kept = {key.decode(): value.decode() for _, key, value in pairs} | told
        connection.execute(f"CREATE TABLE calls AS FROM '{file}'")
        for change in changes:
            connection.execute(change)
        listed = ", ".join(f"{name}: {quoted(value)}" for name, value in kept.items())
        connection.execute(
            f"COPY ({select}) TO {quoted(str(bad))} (FORMAT parquet, COMPRESSION zstd, "
            f"KV_METADATA {{{listed}}})"
        )
    return bad


def quoted(text):
    return "'" + text.replace("'", "''") + "'"


def planted(file, **columns):
    """The recording with its first row replaced by other content under a key that fits it."""
    with duckdb.connect() as connection:
        found = connection.execute(f"FROM '{file}' ORDER BY decision LIMIT 1").fetchone()
    row = dict(zip(COLUMNS, found, strict=True)) | columns
    slot = Slot(*(row[n] for n in ("condition", "repetition", "side", "decision", "sample_set")))
    # Where there is no key for it, any will do.
    with suppress(ValueError, TypeError, AttributeError, RecursionError):
        row["call_key"] = call_key(
            endpoint=row["endpoint"],
            path=row["path"],
            headers=json.loads(row["headers"]),
            body=row["body"],
            slot=slot,
        )
    sets = ", ".join(
        f"{name} = {'NULL' if value is None else quoted(str(value))}" for name, value in row.items()
    )
    return rewritten(file, f"UPDATE calls SET {sets} WHERE decision = 0")


def forged(file, **columns):
    """The same under hashes that fit: that of the content, and that of what the file says."""
    bad = planted(file, **columns)
    with duckdb.connect() as connection:
        rows = connection.execute(f"SELECT call_key, attempts FROM '{bad}'").fetchall()
        pairs = connection.execute(f"FROM parquet_kv_metadata('{bad}')").fetchall()
    told = {key.decode(): value.decode() for _, key, value in pairs}
    lines = "".join(f"{key} {attempts}\n" for key, attempts in rows)
    told["content_sha256"] = hashlib.sha256(lines.encode()).hexdigest()
    del told["provenance_sha256"]
    told["provenance_sha256"] = hashlib.sha256(canonical_json(told).encode()).hexdigest()
    return rewritten(bad, **told)


def refusal(bad, cache):
    """The refusal's text: one line, and not a screenful."""
    with pytest.raises(MergeRunnerError) as refused:
        import_recording(bad, cache)
    text = str(refused.value)
    assert len(text.splitlines()) == 1
    assert text.isprintable()
    assert len(text) < 2000
    return text


def test_a_recording_that_is_rewritten_unchanged_is_whole(file):
    """Or else the other tests would show nothing."""
    assert summarise(rewritten(file))["calls"] == summarise(planted(file))["calls"] == CALLS


DEEP = "[" * 100_000 + "]" * 100_000


def attempts(**changes):
    attempt = {"number": 1, "outcome": "ok", "http_status": 200, "reply": ANSWER, **changes}
    return {"attempts": json.dumps([attempt])}


@pytest.mark.parametrize(
    ("columns", "says"),
    [
        ({"body": "{}"}, "another hash"),
        ({"body": '{"prompt": 0}'}, "not a canonical JSON object"),
        ({"body": "[]"}, "not a canonical JSON object"),
        *(({"body": body}, "is damaged") for body in ("no JSON", '{"a":NaN}', DEEP, None)),
        *(({"side": side}, "is damaged") for side in ("middle", None)),
        *(({name: None}, "is damaged") for name in ("condition", "repetition", "model")),
        *(({"headers": text}, "is damaged") for text in ("[]", '{"a": 1}', DEEP)),
        *(({"attempts": text}, "is damaged") for text in ("[]", "{}", DEEP, '[{"number": 1}]')),
        ({"attempts": '[{"number": 1, "outcome": 2}]'}, "is damaged"),
        # What a replay or a table cannot take.
        *((attempts(reply=reply), "is damaged") for reply in ("no JSON", "[]", DEEP)),
        *((attempts(number=number), "is damaged") for number in (10**30, -1)),
        *((attempts(cost_usd=usd), "is damaged") for usd in (-1.0, math.nan)),
        (attempts(http_status=2**31), "is damaged"),
        (attempts(usage={"output_tokens": 10**12}), "is damaged"),
        (attempts(usage={"input_tokens": -1}), "is damaged"),
        (attempts(latency_s=math.inf), "is damaged"),
        (attempts(started_at="yesterday"), "is damaged"),
    ],
    ids=lambda value: str(value)[-50:],
)
def test_content_that_no_export_writes_is_refused_also_under_its_own_key(
    file, cache, columns, says
):
    assert says in refusal(planted(file, **columns), cache)


OK = {"number": 1, "outcome": "ok", "http_status": 200, "reply": ANSWER}
LOST = {"number": 1, "outcome": "timeout"}


@pytest.mark.parametrize(
    "columns",
    [
        *({name: value} for name in ("repetition", "decision") for value in (-1, 100_001)),
        *({"repetition": 0}, {"sample_set": -1}, {"condition": ""}, {"condition": "../../etc"}),
        *(
            {"attempts": json.dumps(attempts)}
            for attempts in (
                [OK | {"outcome": "won"}],
                [LOST, OK | {"number": 2, "outcome": "OK"}],
                [LOST],
                [OK | {"http_status": 500}],
                [OK | {"http_status": None}],
                [OK | {"http_status": 1000, "outcome": "refusal"}],
                [LOST, OK],
                [LOST | {"number": 3}, OK | {"number": 2}],
                [OK | {"number": 0}],
                [LOST | {"outcome": "<b>"}, OK | {"number": 2}],
                [LOST | {"outcome": "a" * 41}, OK | {"number": 2}],
            )
        ),
    ],
    ids=lambda columns: str(columns)[-60:],
)
def test_a_place_or_an_attempt_that_cannot_be_is_refused_under_hashes_that_fit(
    file, cache, columns
):
    assert "row 1 is damaged: " in refusal(forged(file, **columns), cache)


def test_a_failure_a_refusal_and_a_large_sample_set_are_taken(file):
    attempts = [LOST, LOST | {"number": 4, "outcome": "http_418", "http_status": 418},
                {"number": 5, "outcome": "refusal", "http_status": 400}]  # fmt: skip
    changed = forged(file, attempts=json.dumps(attempts), sample_set=2**40, repetition=100_000)
    assert summarise(changed)["attempts"] == CALLS + 2


def test_nothing_is_kept_of_a_file_whose_last_row_is_wrong(file, cache, monkeypatch):
    monkeypatch.setattr("merge_runner.results.database.ROWS_AT_ONCE", 1)
    assert "is damaged" in refusal(
        rewritten(file, "UPDATE calls SET attempts = '' WHERE decision = 2"), cache
    )


SQL = "x'); DROP TABLE calls; COPY (SELECT 1) TO 'planted.csv'; --"


def test_sql_in_strings_is_a_string(file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    hostile = entry(7, prompt=SQL)
    source = ResponseCache(tmp_path / "source")
    source.put_now([hostile])
    made = tmp_path / "hostile.parquet"
    export_recording(made, source, [hostile.request.key], {"note": SQL, SQL: "note"})
    assert summarise(made)["provenance"]["note"] == SQL
    target = ResponseCache(tmp_path / "target")
    assert import_recording(made, target) == (1, 0)
    assert target.get(hostile.request.key) == hostile
    assert not (tmp_path / "planted.csv").exists()


@pytest.mark.parametrize(
    "select",
    [
        f'SELECT *, 1 AS "{SQL}" FROM calls',
        'SELECT *, 1 AS "a\n\x1b[31mb" FROM calls',
        "SELECT * EXCLUDE attempts FROM calls",
        f'SELECT * RENAME (body AS "{SQL}") FROM calls',
        "SELECT * REPLACE (1 AS body) FROM calls",
        "SELECT * REPLACE ({'a': 1} AS body) FROM calls",
        "SELECT * REPLACE (body::BLOB AS body) FROM calls",
        "SELECT 1 AS file_row_number, * FROM calls",
        f"SELECT {', '.join(f'1 AS c{n}' for n in range(5000))}",
    ],
    ids=lambda text: text[:40],
)
def test_foreign_missing_and_mistyped_columns_are_refused(file, cache, tmp_path, select):
    text = refusal(rewritten(file, select=select), cache)
    assert "is not one of our recordings" in text or "is damaged, or no Parquet file" in text
    assert not (tmp_path / "planted.csv").exists()


def test_other_keys_and_metadata_are_refused(file, cache):
    bad = rewritten(file, "UPDATE calls SET call_key = md5(body)")
    assert "does not belong to its key" in refusal(bad, cache)
    assert "keys of version '9'" in refusal(rewritten(file, key_version="9"), cache)
    assert "not as it was exported" in refusal(rewritten(file, calls="4"), cache)
    assert "not as it was exported" in refusal(rewritten(file, content_sha256="0"), cache)
    raw = file.read_bytes()
    file.write_bytes(raw.replace(b"content_sha256", b"content_sha25\xff"))
    assert "is damaged" in refusal(file, cache)


def test_what_is_no_parquet_file_is_refused(file, cache, tmp_path):
    whole = file.read_bytes()
    bad = tmp_path / "bad.parquet"
    for content in (b"", b"PAR1", b"PAR1PAR1", b"no Parquet" * 100, whole[:-1], whole[:500]):
        bad.write_bytes(content)
        assert "is damaged, or no Parquet file" in refusal(bad, cache)
    for nothing in (tmp_path, tmp_path / "nowhere"):
        assert "there is no recording" in refusal(nothing, cache)


def test_no_damage_to_a_file_ends_otherwise_than_with_a_refusal_or_unchanged_content(file):
    chance = random.Random(1)
    whole = file.read_bytes()
    for _ in range(25):
        damaged = bytearray(whole)
        for _ in range(chance.choice((1, 3))):
            damaged[chance.randrange(len(whole))] = chance.randrange(256)
        file.write_bytes(damaged)
        with suppress(RecordingError):
            assert summarise(file)["calls"] == CALLS


@pytest.mark.parametrize(("rows", "says"), [(10**9, "1000000000 calls"), (50, "")])
def test_a_billion_rows_that_the_footer_claims_are_refused(file, cache, rows, says):
    raw = file.read_bytes()
    # Thrift's compact form: a zigzag varint; 3 rows in the file and in its row group.
    assert raw.count(bytes([0x16, 2 * CALLS])) >= 2
    claimed, value = bytearray([0x16]), 2 * rows
    while value >= 0x80:
        claimed.append(value & 0x7F | 0x80)
        value >>= 7
    claimed.append(value)
    size = int.from_bytes(raw[-8:-4], "little")
    footer = raw[-8 - size : -8].replace(bytes([0x16, 2 * CALLS]), bytes(claimed))
    file.write_bytes(raw[: -8 - size] + footer + len(footer).to_bytes(4, "little") + b"PAR1")
    assert says in refusal(file, cache)


# Small files that unpack to much. Two were made of a whole recording in the table calls, in minutes
# and gigabytes, by COPY (...) TO 'FILE' (FORMAT parquet, COMPRESSION zstd, KV_METADATA ...) of
#   SELECT * REPLACE (repeat(chr(0), 1000000000) AS body) FROM calls LIMIT 1
#   SELECT calls.* REPLACE (repeat('x', 1000000) AS attempts) FROM calls, range(10000)
# All others of data/ were written byte by byte, with pages that no library would write.
DATA = Path(__file__).with_name("data")
BOMBS = {
    "one-text-of-1-gb": "a row group of it unpacks to 1000000494 bytes",
    "30000-texts-of-1-mb": " bytes in 2048 calls",
    "three-columns-of-200-mb": "a row group of it unpacks to 600000",
    # These took 500 MB, and 9 GB where they were larger.
    "a-dictionary-of-many-empty-texts": "a dictionary has more entries than its column has values",
    "texts-that-are-each-the-one-before": "a column has encoding 7, which no export writes",
}
PEAK_MB = """
import sys
from pathlib import Path
from merge_runner.errors import RecordingError
from merge_runner.results.recording import summarise

def peak():
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) // 1024

before = peak()
try:
    summarise(Path(sys.argv[1]))
except RecordingError as exc:
    print(exc)
print(peak() - before)
"""


def peak_mb(code, *arguments):
    """What a process prints, and by how many MB its memory has grown at most."""
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True
    )
    *said, grown = done.stdout.splitlines()
    return "\n".join(said), int(grown)


@pytest.mark.parametrize("name", BOMBS)
def test_a_small_file_that_unpacks_to_much_is_refused_in_little_memory(name):
    said, grown_mb = peak_mb(PEAK_MB, str(DATA / f"{name}.parquet"))
    assert BOMBS[name] in said
    assert grown_mb < 200


@pytest.mark.parametrize("name", ["empty-texts", "a-dictionary-of-one"])
def test_a_file_that_is_written_by_hand_is_read_to_its_rows(cache, name):
    """Or else the others would be refused for the hand that wrote them."""
    said = refusal(DATA / f"{name}.parquet", cache)
    assert "row 1 is damaged: Expecting value" in said


@pytest.mark.parametrize(
    "file", sorted((DATA / "unreadable").iterdir()), ids=lambda file: file.stem.replace("-", " ")
)
def test_pages_that_a_reader_may_take_in_another_way_are_refused(cache, file):
    said = refusal(file, cache)
    assert "is not one of our recordings: " in said
    assert "page" in said


@pytest.mark.parametrize(
    "name",
    [
        *("it's.parquet", 'a "quoted" one.parquet', "x'); DROP TABLE calls; --.parquet"),
        *("[ab]*?.parquet", "**.parquet", "hive=1.parquet", "model=x/[set] 1/r.parquet"),
        *("two\nlines.parquet", "-.parquet", "\u00e9\U0001f697 %20.parquet"),
    ],
)
def test_a_file_of_any_name_goes_round(file, tmp_path, name):
    named = tmp_path / "folder" / name
    source = ResponseCache(tmp_path / "source")
    export_recording(named, source, [entry(1).request.key], {})
    # A pattern would match this one too.
    (named.parent / "a.parquet").write_bytes(b"no recording")
    target = ResponseCache(tmp_path / "target")
    assert import_recording(named, target) == (1, 0)
    assert target.get(entry(1).request.key) == entry(1)


async def test_the_program_refuses_in_one_line_and_leaves_the_cache_as_it_was(
    merge_runner, file, tmp_path
):
    bad = rewritten(file, "UPDATE calls SET endpoint = 'evil' WHERE decision = 2")
    assert (await merge_runner("recording", "import", file)).code == 0
    kept = rows_of(tmp_path / "cache/responses/cache.db")
    for command in ("import", "verify", "info"):
        run = await merge_runner("recording", command, bad)
        assert (run.code, run.out) == (1, "")
        assert (
            run.err == f"error: {bad}: row 3 is damaged: its content does not belong to its key\n"
        )
    assert len(kept) >= CALLS
    assert rows_of(tmp_path / "cache/responses/cache.db") == kept


def rows_of(database):
    with sqlite3.connect(database) as connection:
        found = connection.execute("SELECT key, value FROM Cache ORDER BY key").fetchall()
    connection.close()
    return found
