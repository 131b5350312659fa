"""Replies as long as reasoning texts are: nothing holds many of them in memory."""

import csv
import io
import json
from dataclasses import replace
from itertools import islice
from operator import attrgetter

import pytest
from aiohttp import web
from typer.testing import CliRunner

from benchmarks.recorder import longer
from merge_runner.cli import app
from merge_runner.errors import UsageError
from merge_runner.llm.cache import ResponseCache
from merge_runner.results.recording import read_recording
from merge_runner.results.store import query, results_digest
from tests.support.harness import RECORDING, a_model, watched

SIZE, REPS = 20_480, 5
REPLAY = ("replay", "baseline", "--reps", REPS, "--cache", "cache", "--json")


@pytest.fixture(scope="module")
def long(prepare, tmp_path_factory):
    """A folder with a cache of a thousand replies of 20 KB, and the database of their replay."""
    folder = tmp_path_factory.mktemp("long")
    cache = ResponseCache(folder / "cache")
    entries = (e for e in read_recording(RECORDING) if e.request.slot.repetition <= REPS)
    while batch := list(islice(entries, 200)):
        cache.put_now(_lengthened(entry) for entry in batch)
    cache.close()
    run = prepare(folder, *REPLAY, code=0)
    assert run.summary["calls"]["cached"] > 1_000
    return folder


def _lengthened(entry):
    (*others, last) = entry.attempts
    longest = replace(last, reply=longer(last.reply, SIZE, entry.request.key))
    return replace(entry, attempts=(*others, longest))


def command(folder, *arguments):
    db = ("--db", str(folder / "results/merge.duckdb"))
    run = CliRunner().invoke(app, [*map(str, arguments), *db])
    assert run.exit_code == 0, run.output
    return run.stdout


def test_a_thousand_long_replies_are_audited_and_looked_up_in_the_cache(long):
    told = json.loads(command(long, "audit", "--cache", long / "cache", "--json"))
    assert told["ok"]
    assert told["audits"][0]["counts"]["calls"] > 1_000


def test_a_thousand_long_replies_are_queried(long):
    asked = "SELECT call_key, reply, reply->>'$.model' AS model FROM calls ORDER BY call_key"
    rows = list(csv.DictReader(io.StringIO(command(long, "sql", asked, "--format", "csv"))))
    assert len(rows) > 1_000
    assert min(len(row["reply"]) for row in rows) > 0.9 * SIZE


def test_a_query_that_needs_too_much_memory_says_what_to_do(long):
    big = "SELECT len(string_agg(reply || n::VARCHAR)) FROM calls, range(100) AS numbers(n)"
    with pytest.raises(UsageError, match="ask for fewer rows or columns at once"):
        query(long / "results/merge.duckdb", big)


def test_long_replies_are_recorded_and_replayed_in_an_order_of_their_own(long, prepare):
    file = long / "long.parquet"
    assert prepare(long, "recording", "export", file, "--cache", "cache").code == 0
    assert [path.name for path in long.glob("*long.parquet*")] == ["long.parquet"]
    slots = [e.request.slot for e in read_recording(file)]
    order = attrgetter("condition", "repetition", "side", "decision", "sample_set")
    assert slots == sorted(slots, key=order)
    prepare(long, "replay", "baseline", "--reps", REPS, "--recording", file,
                    "--db", "again.duckdb", "--cache", "none", "--json", code=0)  # fmt: skip
    assert results_digest(long / "again.duckdb") == results_digest(long / "results/merge.duckdb")


@pytest.mark.parametrize(("reply_mb", "trials", "seconds"), [(15, 1, 8), (2, 4, 30)])
async def test_every_reply_below_max_reply_mb_is_stored(
    merge_runner, tmp_path, reply_mb, trials, seconds
):
    thought = "The gap is too small for me. " * round(reply_mb * 1e6 / 29)
    both_stop = f"M\n\nI brake.\n\n{[-1] * 20}"

    async def middle(request, handler):
        body = json.loads((await handler(request)).body)
        said = {"role": "assistant", "content": both_stop, "reasoning_content": thought}
        body["choices"][0]["message"] = said
        return web.json_response(body)

    (tmp_path / "models.toml").write_text(a_model("patient", timeout_s=100))
    (tmp_path / "study.toml").write_text(
        f"[repetitions]\nbaseline = {trials}\n[scenario]\ntimeout_s = {seconds}\n"
    )
    async with watched(middle) as server:
        run = await merge_runner(
            "sweep", "study.toml", "--model", "patient", "--conditions", "L_4_0", **server.env
        )
    assert (run.code, server.requests) == (0, 2 * trials * seconds), run.err
    stored = "SELECT count(*), min(len(reply)) FROM calls"
    ((calls, shortest),) = query(tmp_path / "results/merge.duckdb", stored)[1]
    assert calls == server.requests
    assert shortest > len(thought)
