"""Copies the recorded replies of one trial to many slots."""

from __future__ import annotations

import json
import random
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import islice
from pathlib import Path

from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.store import CachedCall
from merge_runner.records import call_key

BATCH = 500
_ID = re.compile(r'"id": "(\d+)"')


def multiply(folder: Path, repetitions: int, reply_bytes: int = 0) -> None:
    """Give every call in a cache, all of which are of repetition 1, that many repetitions.

    Equal answers lead to equal prompts, so the bodies stay; the ids of the replies become new. A
    reply that is shorter than ``reply_bytes`` gets longer: its reasoning and its summary.
    """
    cache = ResponseCache(folder)
    copies = _copies(list(cache.entries()), repetitions, reply_bytes)
    while batch := list(islice(copies, BATCH)):
        cache.put_now(batch)
    cache.close()


def longer(reply: str, size: int, seed: str) -> str:
    """A chat completion of about that many bytes; a quarter is content, the rest reasoning."""
    lacking = size - len(reply)
    if lacking <= 0:
        return reply
    body = json.loads(reply)
    message = body["choices"][0]["message"]
    text = _words()
    begin = random.Random(seed).randrange(len(text) - lacking)  # noqa: S311 # no secret
    boundary = begin + lacking // 4
    message["content"] = f"{text[begin:boundary]}\n\n{message['content']}"
    message["reasoning_content"] = text[boundary : begin + lacking]
    return json.dumps(body)


@cache
def _words() -> str:
    """8 MB of text that compresses like text."""
    drawn = random.Random(1)  # noqa: S311 # no secret
    words = ["".join(drawn.choices("etaoinshrdlu", k=drawn.randint(2, 9))) for _ in range(4_000)]
    return " ".join(drawn.choices(words, k=1_200_000))


def _copies(entries: list[CachedCall], repetitions: int, reply_bytes: int) -> Iterator[CachedCall]:
    for repetition in range(2, repetitions + 1):
        for entry in entries:
            request = entry.request
            slot = replace(request.slot, repetition=repetition)
            key = call_key(
                endpoint=request.endpoint,
                path=request.path,
                headers=request.headers,
                body=request.body,
                slot=slot,
            )
            (attempt,) = entry.attempts
            reply = _ID.sub(rf'"id": "\1-{repetition}"', attempt.reply or "", count=1)
            reply = longer(reply, reply_bytes, key)
            yield CachedCall(replace(request, key=key, slot=slot), (replace(attempt, reply=reply),))
