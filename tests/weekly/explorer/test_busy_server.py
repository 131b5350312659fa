"""What one visitor asks for holds no page of another, and what nobody can read is refused."""

from __future__ import annotations

import asyncio
import socket

import httpx
import psutil
import pytest

ENDLESS = "SELECT count(*) FROM range(1000000) AS a, range(1000000) AS b WHERE a > b"
QUERIES, LISTS = 60, 25
# All but those that run and the few that wait.
REFUSED = 45


@pytest.fixture
async def site(merge_runner, golden_copy):
    """A server of its own that has read its trials, and its process."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    process = await merge_runner.start(
        "view", "--db", golden_copy / "golden.duckdb", "--port", port
    )
    try:
        async with httpx.AsyncClient(base_url=f"http://127.0.0.1:{port}", timeout=120) as client:
            while not await is_ready(client):
                await asyncio.sleep(0.1)
            yield client, psutil.Process(process.pid)
    finally:
        process.kill()  # queries that nobody waits for any more would end one after the other
        await process.wait()


async def is_ready(client):
    try:
        reply = await client.get("/trials")
    except httpx.ConnectError:
        return False
    return "refresh" not in reply.headers


async def test_forty_five_refused_queries_take_less_of_the_server_than_25_lists_of_trials(site):
    client, process = site

    async def cost(asking):
        before = process.cpu_times()
        await asking
        after = process.cpu_times()
        return after.user + after.system - before.user - before.system

    async def lists():
        for _ in range(LISTS):
            await client.get("/trials")

    async def refused():
        tasks = [
            asyncio.create_task(client.get("/sql", params={"q": ENDLESS})) for _ in range(QUERIES)
        ]
        while sum(task.done() for task in tasks) < REFUSED:
            await asyncio.sleep(0.02)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    assert await cost(refused()) < await cost(lists())
