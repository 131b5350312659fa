"""The floor: the same calls with nothing around them.

httpx on aiohttp's transport, replies kept in diskcache; a reply that is kept is not asked for. Each
request is hashed and each reply is read as JSON. No prompt is made, no plan is checked, nothing is
driven or stored, so that no runner can be faster with these libraries.
"""

from __future__ import annotations

import argparse
import asyncio
import hashlib
import json

import diskcache
import httpx
from httpx_aiohttp import AiohttpTransport

from benchmarks.workload import CALLS, PROMPT, TRIALS


async def play(args: argparse.Namespace) -> None:
    """All trials, each with two calls at a time, as a trial's two drivers make them."""
    cache = diskcache.Cache(args.cache, eviction_policy="none", size_limit=2**62)
    connections = 2 * args.in_flight
    limits = httpx.Limits(max_connections=connections, max_keepalive_connections=connections)
    in_flight = asyncio.Semaphore(args.in_flight)

    async def call(trial: int, number: int) -> None:
        message = {"role": "user", "content": f"{number} {PROMPT}"}
        body = json.dumps({"model": "floor", "messages": [message]})
        key = hashlib.sha256(f"{trial} {body}".encode()).hexdigest()
        text = cache.get(key)
        if text is None:
            headers = {"content-type": "application/json", "x-floor-slot": key}
            url = args.url + "/chat/completions"
            text = (await client.post(url, content=body.encode(), headers=headers)).text
            cache[key] = text
        json.loads(text)

    async def trial(number: int) -> None:
        async with in_flight:
            for at in range(0, args.calls_per_trial, 2):
                await asyncio.gather(call(number, at), call(number, at + 1))

    transport = AiohttpTransport(limits=limits)
    async with httpx.AsyncClient(transport=transport, timeout=120) as client:
        await asyncio.gather(*(trial(number) for number in range(args.trials)))


def main() -> None:
    """Read the options and play."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--url", required=True)
    parser.add_argument("--cache", required=True)
    parser.add_argument("--trials", type=int, default=TRIALS)
    parser.add_argument("--calls-per-trial", type=int, default=CALLS)
    parser.add_argument("--in-flight", type=int, default=200)
    asyncio.run(play(parser.parse_args()))


if __name__ == "__main__":
    main()
