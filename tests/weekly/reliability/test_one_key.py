"""Two processes on one key of an account."""

import json

from aiohttp import web

from tests.support.harness import watched


async def test_two_sweeps_on_one_key_go_on_after_the_servers_429(merge_runner):
    answered, refused = [], []

    async def middle(request, handler):
        if len(answered) // 12 > len(refused):  # however slow the machine is
            refused.append(request)
            limit = {"message": "Rate limit reached", "code": "rate_limit_exceeded"}
            return web.json_response({"error": limit}, status=429, headers={"retry-after": "1"})
        answered.append(request)
        return await handler(request)

    sweep = ("sweep", "baseline", "--reps", 1, "--model", "o3", "--yes", "--json", "--rpm", 600)
    async with watched(middle) as server:
        env = server.account
        runs = [
            await merge_runner.start(*sweep, "--tpm", 10**9, "--conditions", name, "--cache", name,
                                     "--db", f"{name}.duckdb", **env)
            for name in ("L_4_0", "N_0_0")
        ]  # fmt: skip
        summaries = [json.loads((await run.communicate())[0]) for run in runs]
    assert [run.returncode for run in runs] == [0, 0]
    assert refused
    assert sum(summary["calls"]["live"] for summary in summaries) == len(answered)
