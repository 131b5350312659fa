"""Makes the recorded replies of many trials at once: those of one trial, under other slots."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

from merge_runner.llm.cache import Entry, ResponseCache
from merge_runner.llm.keys import call_key

BATCH = 2_000
_ID = re.compile(r'"id": "(\d+)"')


def multiply(folder: Path, repetitions: int) -> None:
    """Give every call in a cache, all of which are of repetition 1, that many repetitions.

    Equal answers lead to equal prompts, so the bodies stay; the ids of the replies become new.
    """
    cache = ResponseCache(folder)
    copies = _copies(list(cache.entries()), repetitions)
    while batch := list(islice(copies, BATCH)):
        cache.put_now(batch)
    cache.close()


def _copies(entries: list[Entry], repetitions: int) -> Iterator[Entry]:
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
            yield Entry(replace(request, key=key, slot=slot), (replace(attempt, reply=reply),))
