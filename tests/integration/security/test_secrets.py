"""Keys and account ids are nowhere: not in output, files, tables, process lists or errors."""

import asyncio
import json
import re
from contextlib import asynccontextmanager
from pathlib import Path

import duckdb
import pytest
from aiohttp import web

from tests.support.harness import FAST, watched

KEYS = {
    "OPENAI_API_KEY": "sk-dummy-Zx81Qp55-openai",
    "GOOGLE_API_KEY": "AIza-dummy-Zx81Qp55-gemini",
    "ANTHROPIC_API_KEY": "sk-ant-dummy-Zx81Qp55-anthropic",
}
# What providers send beside a reply: who the account is, and what leads back to the request.
ACCOUNT = {
    "openai-organization": "org-marker-Kw72",
    "openai-project": "proj-marker-Kw72",
    "anthropic-organization-id": "ant-org-marker-Kw72",
    "x-request-id": "req-marker-Kw72",
    "request-id": "req-ant-marker-Kw72",
    "cf-ray": "ray-marker-Kw72",
    "x-goog-user-project": "goog-marker-Kw72",
    "set-cookie": "session=cookie-marker-Kw72; Path=/",
}
ONE = ("baseline", "--reps", 1, "--conditions", "N_0_0", "--yes", *FAST)


def echo(request, how):
    """An answer that says the key back in its body and in its headers."""
    headers = request.headers
    bearer = headers.get("authorization", "").removeprefix("Bearer ")
    key = headers.get("x-api-key") or headers.get("x-goog-api-key") or bearer
    again = {"x-debug-key": key, "www-authenticate": f'Bearer realm="{key}"', "retry-after": "0"}
    if how == "redirect":
        again["location"] = f"{request.url.origin()}/elsewhere?key={key}"
        return web.Response(status=307, text=f"see {again['location']}", headers=again)
    if how == "page":
        page = f"<html><h1>502</h1><pre>Authorization: Bearer {key}</pre></html>"
        return web.Response(status=502, text=page, content_type="text/html", headers=again)
    if how == "escaped":  # as JSON may spell any character, here within a string of JSON
        spelled = "".join(f"\\u{ord(character):04x}" for character in key)
        upstream = json.dumps({"error": {"metadata": {"raw": f'{{"key": "{spelled}"}}'}}})
        body = f'{{"message": "key {spelled}", "upstream": {upstream}}}'
        return web.Response(status=400, text=f'{{"error": {body}}}', headers=again)
    status = {"refused": 401, "bad": 400, "busy": 503}[how]
    message = f"Incorrect API key provided: {key}. {dict(request.headers)}"
    error = {"error": {"message": message, "type": "error", "code": "invalid", "param": key}}
    return web.json_response(error, status=status, headers=again)


@asynccontextmanager
async def provider(*faults):
    """All three providers in one server; the first call at each meets these faults in turn."""
    left: dict[str, list[str]] = {}

    async def middle(request, handler):
        coming = left.setdefault(request.path, list(faults))
        fault = coming.pop(0) if coming else None
        answer = echo(request, fault) if fault else await handler(request)
        answer.headers.update(ACCOUNT)
        return answer

    async with watched(middle) as server:
        # By name: aiohttp keeps no cookies of an address, httpx does.
        url = server.url.replace("127.0.0.1", "localhost")
        urls = {
            "OPENAI_BASE_URL": f"{url}/v1",
            "GOOGLE_GEMINI_BASE_URL": url,
            "ANTHROPIC_BASE_URL": url,
        }
        yield server, {**KEYS, **urls}


def everything_in(folder: Path) -> str:
    """All that is kept: the bytes of all files, and what tables and recordings hold unpacked."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    texts = [path.read_bytes().decode("latin-1") for path in files]
    with duckdb.connect() as connection:

        def rows(sql):
            return connection.execute(sql).fetchall()

        for number, path in enumerate(files):
            if path.suffix == ".parquet":
                texts += map(str, rows(f"FROM '{path}'"))
                texts += map(str, rows(f"FROM parquet_kv_metadata('{path}')"))
            if path.suffix == ".duckdb":
                rows(f"ATTACH '{path}' AS d{number} (READ_ONLY)")
                for database, table in rows(
                    "SELECT database_name, table_name FROM duckdb_tables()"
                ):
                    texts += map(str, rows(f"FROM {database}.{table}"))
    return "\n".join([*map(str, files), *texts])


def leaks(text):
    """The markers of keys and accounts that a text holds; both also in part, and as escapes."""
    text = re.sub(r"\\+u00(\w\w)", lambda code: chr(int(code[1], 16)), text)
    return [marker for marker in ("Zx81Qp55", "Kw72") if marker in text]


async def command_lines(process):
    """The command lines of a process and all below it, read again and again until it ends."""
    seen: set[str] = set()
    while process.returncode is None:
        seen |= set(below(process.pid))
        await asyncio.sleep(0.02)
    return seen


def below(pid):
    try:
        yield Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ")
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                yield from below(child)
    except OSError:
        return  # it has ended meanwhile


async def test_no_key_and_no_account_id_is_in_anything_that_a_sweep_leaves(merge_runner, tmp_path):
    async with provider("page", "busy") as (server, env):
        sweep = await merge_runner("sweep", *ONE, "--model", "o3", "--debug", **env)
        assert KEYS["OPENAI_API_KEY"] in str(server.headers[-1])
        assert [headers for headers in server.headers if "cookie" in headers] == []
        shown = [
            await merge_runner(*words.split(" "), **env)
            for words in (
                *("recording export o3.parquet", "recording info o3.parquet", "models"),
                *("view --trials * --single page.html", "sql FROM\ncalls --format json"),
            )
        ]
    assert {run.code for run in (sweep, *shown)} == {0}
    kept = everything_in(tmp_path) + str((sweep, shown))
    # The errors are kept, with the key taken out of them.
    assert "Bearer [key]" in kept
    assert "Incorrect API key provided: [key]" in kept
    for file in ("results/merge.duckdb", "cache/responses/cache.db", "page.html"):
        assert str(tmp_path / file) in kept
    assert leaks(kept) == []


@pytest.mark.parametrize(
    ("fault", "model"),
    [
        *(("refused", "claude-sonnet-4-6"), ("bad", "o3")),
        *(("escaped", "o3"), ("redirect", "gemini-2.5-pro")),
    ],
)
async def test_no_key_is_in_what_a_failed_sweep_says_and_leaves(
    merge_runner, tmp_path, fault, model
):
    async with provider(*[fault] * 20) as (server, env):
        run = await merge_runner("sweep", *ONE, "--model", model, "--debug", **env)
    assert any(key in str(server.headers[0]) for key in KEYS.values())
    assert run.code in (1, 2)
    assert "[key]" in run.err + run.out
    assert leaks(run.err + run.out + everything_in(tmp_path)) == []


async def test_no_key_is_in_a_command_line(merge_runner, tmp_path):
    async with provider() as (_, env):
        sweep = ("sweep", *ONE, "--model", "emulator+o3")
        process = await merge_runner.start(*sweep, **env)
        lines, (out, err) = await asyncio.gather(command_lines(process), process.communicate())
    assert process.returncode == 0, err
    assert any("emulator+o3" in line for line in lines)
    assert leaks("".join(lines) + out.decode() + err.decode()) == []
