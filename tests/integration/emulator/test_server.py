"""The emulator as a server, and within the process of a sweep."""

import asyncio
import socket
from urllib.parse import urlsplit

import aiohttp
import httpx
import pytest

from merge_runner import Study
from merge_runner.cli.models import emulate
from merge_runner.emulator.handler import Emulator
from merge_runner.emulator.server import run, serve
from merge_runner.errors import UsageError
from tests.support.harness import RECORDING

BODY = {"model": "m", "messages": [{"role": "user", "content": "a prompt"}]}
CHAT = "/v1/chat/completions"


@pytest.fixture
async def served():
    runner, url = await serve(0)
    yield url
    await runner.cleanup()


async def test_the_emulator_is_bound_to_loopback_alone():
    runner, url = await serve(0)
    addresses = runner.addresses
    await runner.cleanup()
    assert addresses == [("127.0.0.1", urlsplit(url).port)]
    assert urlsplit(url).hostname == "127.0.0.1"


@pytest.mark.parametrize(
    ("host", "status"),
    [
        *((f"{host}:PORT", 200) for host in ("127.0.0.1", "localhost", "LocalHost", "[::1]")),
        ("localhost", 200),
        *((f"{host}:PORT", 403) for host in ("evil.example", "localhost.evil.example")),
        *((host, 403) for host in ("evil.example", "127.0.0.1:1", "127.0.0.2:PORT", "")),
    ],
)
async def test_a_request_in_another_name_is_refused(served, host, status):
    """A page of the web can have its own name resolved to loopback, but not forge the header."""
    headers = {"host": host.replace("PORT", str(urlsplit(served).port))}
    async with aiohttp.ClientSession() as session:
        async with session.get(f"{served}/v1/models", headers=headers) as listed:
            assert listed.status == status
        async with session.post(f"{served}{CHAT}", headers=headers, json={}) as reply:
            assert reply.status == status


async def test_a_port_in_use_is_a_usage_error(served):
    port = urlsplit(served).port
    with pytest.raises(UsageError, match=str(port)):
        await serve(port)


async def test_it_announces_its_url_serves_and_closes_its_port_when_cancelled():
    announced = asyncio.get_running_loop().create_future()
    serving = asyncio.create_task(run(0, announce=announced.set_result))
    async with asyncio.timeout(10), httpx.AsyncClient(base_url=await announced) as client:
        assert (await client.post(CHAT, json=BODY)).status_code == 200
        serving.cancel()
        with pytest.raises(asyncio.CancelledError):
            await serving
        with pytest.raises(httpx.ConnectError):
            await client.post(CHAT, json=BODY)


def test_the_command_prints_its_url_and_that_of_a_local_model(monkeypatch, capsys):
    async def announce_alone(port, *, announce):
        announce(f"http://127.0.0.1:{port}")

    monkeypatch.setattr("merge_runner.emulator.server.run", announce_alone)
    emulate(8765)
    out, err = capsys.readouterr()
    assert out == "http://127.0.0.1:8765\n"
    assert err.endswith(f"LOCAL_BASE_URL={out.strip()}/v1\n")


async def test_it_answers_within_a_process_as_the_server_does(served):
    async def post(**where):
        async with httpx.AsyncClient(**where) as client:
            return await client.post(CHAT, json=BODY, headers={"x-request-id": "an-id"})

    carried = await post(transport=Emulator().transport(), base_url="http://e")
    over_loopback = await post(base_url=served)
    assert (carried.status_code, carried.content) == (200, over_loopback.content)
    assert carried.headers.items() <= over_loopback.headers.items()
    assert "x-merge-runner-scripted" in carried.headers
    assert over_loopback.headers["x-request-id"] == "an-id"


async def test_no_process_is_started_and_nothing_is_connected(tmp_path, monkeypatch):
    def refuse(*arguments, **options):
        raise AssertionError("a socket or a process")

    for name in ("bind", "listen", "connect"):
        monkeypatch.setattr(socket.socket, name, refuse, raising=False)
    monkeypatch.setattr(asyncio, "create_subprocess_exec", refuse)
    monkeypatch.delenv("EMULATOR_BASE_URL", raising=False)
    monkeypatch.chdir(tmp_path)
    outcome = await Study("baseline", repetitions=1, conditions=["N_0_0"]).arun()
    assert outcome.ok
    assert outcome.facts["calls"]["live"] > 0


async def test_its_replies_are_byte_for_byte_those_of_the_shipped_recording(merge_runner):
    part = ("baseline", "--model", "emulator", "--reps", 1, "--conditions", "N_0_0")
    assert (await merge_runner("sweep", *part)).code == 0
    await merge_runner("replay", *part, "--recording", RECORDING, code=0)
