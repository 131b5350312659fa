"""A recording may come from anybody: it is ours and whole, or it is refused and nothing is kept."""

import contextlib
import json
import math
import random
import shutil
import subprocess
import sys
from pathlib import Path

import duckdb
import pytest

from merge_runner.errors import MergeRunnerError, RecordingError, UsageError
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.store import CachedCall
from merge_runner.records import Attempt, Slot, call_key
from merge_runner.results.parquet import group_bytes
from merge_runner.results.recording import (
    COLUMNS,
    export_recording,
    import_recording,
    read_recording,
)
from merge_runner.results.recording_summary import summarise, summary_lines
from merge_runner.run.plan import make_plan
from merge_runner.run.recorded_plans import recorded_plans
from tests.support.raw_server import a_request
from tests.support.recording_files import quoted, rewritten

CALLS = 3
ANSWER = json.dumps({"choices": [{"message": {"content": "M\n[0.1]"}}]})


def entry(number, prompt=None):
    return CachedCall(a_request(number, prompt), (Attempt(1, "ok", 200, reply=ANSWER),))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A recording that is whole."""
    folder = tmp_path_factory.mktemp("whole")
    source = ResponseCache(folder / "source")
    entries = [entry(number) for number in range(CALLS)]
    source.put_now(entries)
    export_recording(folder / "good.parquet", source, [e.request.key for e in entries], {})
    return folder / "good.parquet"


@pytest.fixture
def file(whole, tmp_path):
    return shutil.copy(whole, tmp_path / "good.parquet")


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """The cache that all hostile files here are after."""
    opened = ResponseCache(tmp_path_factory.mktemp("target"))
    opened.put_now([entry(99)])
    yield opened
    assert [kept.request.slot.decision for kept in opened.entries()] == [99]


def planted(file, **columns):
    """The recording with its first row replaced by other content under a key that fits it."""
    with duckdb.connect() as connection:
        found = connection.execute(f"FROM '{file}' ORDER BY decision LIMIT 1").fetchone()
    row = dict(zip(COLUMNS, found, strict=True)) | columns
    slot = Slot(*(row[n] for n in ("condition", "repetition", "side", "decision", "sample_set")))
    # Where there is no key for it, any will do.
    with contextlib.suppress(ValueError, TypeError, AttributeError, RecursionError):
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


OK = {"number": 1, "outcome": "ok", "http_status": 200, "reply": ANSWER}
LOST = {"number": 1, "outcome": "timeout"}
ATTEMPTS = (
    *([OK | {"reply": reply}] for reply in ("no JSON", "[]", DEEP)),
    *([OK | {"number": number}] for number in (10**30, -1, 0)),
    *([OK | {"http_status": status}] for status in (500, None, 2**31)),
    *([OK | {"cost_usd": usd}] for usd in (-1.0, math.nan)),
    *([OK | {"usage": {name: n}}] for name, n in (("output_tokens", 10**12), ("input_tokens", -1))),
    [OK | {"latency_s": math.inf}],
    [OK | {"started_at": "yesterday"}],
    [OK | {"outcome": "won"}],
    [OK | {"http_status": 1000, "outcome": "refusal"}],
    *([], {}, [{"number": 1}], [LOST], [LOST, OK]),
    [LOST | {"number": 3}, OK | {"number": 2}],
    [LOST, OK | {"number": 2, "outcome": "OK"}],
    *([LOST | {"outcome": name}, OK | {"number": 2}] for name in ("<b>", "a" * 41)),
)


@pytest.mark.parametrize(
    "columns",
    [
        *({"body": body} for body in ('{"prompt": 0}', "[]", "no JSON", '{"a":NaN}', DEEP, None)),
        *({"side": side} for side in ("middle", None)),
        *({name: None} for name in ("condition", "repetition", "model")),
        *({"headers": text} for text in ("[]", '{"a": 1}', DEEP)),
        *({name: value} for name in ("repetition", "decision") for value in (-1, 100_001)),
        *({"repetition": 0}, {"sample_set": -1}, {"condition": ""}, {"condition": "../../etc"}),
        {"attempts": DEEP},
        *({"attempts": json.dumps(attempts)} for attempts in ATTEMPTS),
    ],
    ids=lambda columns: str(columns)[-60:],
)
def test_a_row_that_no_export_writes_is_refused_also_under_its_own_key(whole, cache, columns):
    assert "row 1 is damaged: " in refusal(planted(whole, **columns), cache)


def test_other_content_under_its_own_key_has_another_hash(whole, cache):
    assert "another hash" in refusal(planted(whole, body="{}"), cache)


def test_a_failure_a_refusal_and_a_large_sample_set_are_taken(tmp_path):
    failed = Attempt(4, "http_418", 418)
    attempts = (Attempt(1, "timeout"), failed, Attempt(5, "refusal", 400))
    slot = Slot("N_0_0", 100_000, "left", 0, 2**40)
    call = CachedCall(a_request(slot=slot), attempts)
    source = ResponseCache(tmp_path / "source")
    source.put_now([call])
    export_recording(tmp_path / "r.parquet", source, [call.request.key], {})
    assert list(read_recording(tmp_path / "r.parquet")) == [call]


def test_nothing_is_kept_of_a_file_whose_last_row_is_wrong(file, cache, monkeypatch):
    monkeypatch.setattr("merge_runner.results.database.ROWS_AT_ONCE", 1)
    assert "is damaged" in refusal(
        rewritten(file, "UPDATE calls SET attempts = '' WHERE decision = 2"), cache
    )


SQL = "x'); DROP TABLE calls; COPY (SELECT 1) TO 'planted.csv'; --"


def test_sql_in_strings_is_a_string(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    hostile = entry(7, prompt=SQL)
    source = ResponseCache(tmp_path / "source")
    source.put_now([hostile])
    made = tmp_path / "hostile.parquet"
    export_recording(made, source, [hostile.request.key], {"note": SQL, SQL: "note"})
    assert summarise(made)["provenance"]["note"] == SQL
    assert list(read_recording(made)) == [hostile]
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
    for change, said in (
        ("UPDATE calls SET attempts = replace(attempts, '0.1', '0.2')", "not as it was exported"),
        ("DELETE FROM calls WHERE decision = 1", "not as it was exported"),
        ("INSERT INTO calls FROM calls LIMIT 1", "repeats"),
    ):
        assert said in refusal(rewritten(file, change), cache)
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
        with contextlib.suppress(RecordingError):
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
from merge_runner.results.recording_summary import summarise

def peak():
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) // 1024

before = peak()
for file in sys.argv[1:]:
    try:
        summarise(Path(file))
    except RecordingError as exc:
        print(exc)
print(peak() - before)
"""


def test_a_small_file_that_unpacks_to_much_is_refused_in_little_memory():
    files = [DATA / f"{name}.parquet" for name in BOMBS]
    done = subprocess.check_output([sys.executable, "-c", PEAK_MB, *files], text=True)
    *said, grown_mb = done.splitlines()
    assert all(says in line for says, line in zip(BOMBS.values(), said, strict=True)), said
    assert int(grown_mb) < 200


def test_a_dictionary_counts_beside_the_pages_that_refer_to_it():
    """The one of a text counts for 131 bytes, 64 of them for its entry."""
    file = DATA / "a-dictionary-of-one.parquet"
    with duckdb.connect() as connection:
        assert [*group_bytes(file, quoted(str(file)), connection)] == [131]


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


NAMES = (
    *("it's.parquet", 'a "quoted" one.parquet', "x'); DROP TABLE calls; --.parquet"),
    *("[ab]*?.parquet", "**.parquet", "hive=1.parquet", "model=x/[set] 1/r.parquet"),
    *("two\nlines.parquet", "-.parquet", "\u00e9\U0001f697 %20.parquet"),
)


def test_a_file_of_any_name_goes_round(tmp_path):
    source = ResponseCache(tmp_path / "source")
    source.put_now([entry(1)])
    for name in NAMES:
        named = tmp_path / "folder" / name
        export_recording(named, source, [entry(1).request.key], {})
        # A pattern would match this one too.
        (named.parent / "a.parquet").write_bytes(b"no recording")
        assert list(read_recording(named)) == [entry(1)], name


async def test_the_program_refuses_in_one_line_and_leaves_the_cache_as_it_was(
    merge_runner, file, tmp_path
):
    bad = rewritten(file, "UPDATE calls SET endpoint = 'evil' WHERE decision = 2")
    assert (await merge_runner("recording", "import", file)).code == 0
    kept = everything_in(tmp_path / "cache/responses")
    for command in ("import", "verify", "info"):
        run = await merge_runner("recording", command, bad)
        assert (run.code, run.out) == (1, "")
        assert run.err == (
            f"error: {bad}: row 3 is damaged: its content does not belong to its key\n"
        )
    assert everything_in(tmp_path / "cache/responses") == kept


@pytest.mark.parametrize(
    "told",
    [
        {},
        {"sweeps": "[]"},
        {"sweeps": '["a", 7]'},
        {"name": "a", "config": "[]"},
        {"name": "a", "config": "7"},
        {"name": "/etc/passwd.toml", "config": "{}"},
        {"name": "a", "config": '{"study": {}}'},
    ],
)
def test_a_recording_that_does_not_say_what_was_played_is_no_study(told, tmp_path):
    source, file = ResponseCache(tmp_path / "source"), tmp_path / "told.parquet"
    source.put_now([entry(1)])
    export_recording(file, source, [entry(1).request.key], told)
    with pytest.raises((RecordingError, UsageError)):
        list(recorded_plans(file, db=tmp_path / "none.duckdb", trust=False))
    assert any(line.startswith("calls    1 ") for line in summary_lines(file, summarise(file)))


def test_an_error_in_the_study_of_a_recording_names_the_recording(tmp_path):
    source, file = ResponseCache(tmp_path / "source"), tmp_path / "theirs.parquet"
    source.put_now([entry(1)])
    config = make_plan("baseline", "constant").model_dump(mode="json")
    config["study"]["text"] = "repetitions = 0"
    played = {"name": "baseline", "config": json.dumps(config)}
    export_recording(file, source, [entry(1).request.key], played)
    with pytest.raises(UsageError, match=f"^{file}: repetitions"):
        list(recorded_plans(file, db=tmp_path / "none.duckdb", trust=False))


def everything_in(cache):
    with contextlib.closing(ResponseCache(cache, read_only=True)) as opened:
        return list(opened.entries())
