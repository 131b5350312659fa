"""How many calls a cache has answered, by kind of request, so that no run reads them all to begin.

The counts lie in a table of the cache's file. Calls that were answered since it was written are
added when it is next asked for.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from functools import partial
from typing import NamedTuple

from merge_runner.errors import RecordingError
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.durable import Execute
from merge_runner.llm.store import CachedCall, text_of
from merge_runner.records import DAMAGED, Attempt, ChatRequest, is_scripted, without_prompt

BATCH = 1_000
# As bytes, since a damaged text may be none.
NEWER = """
SELECT rowid, mode, filename, CAST(value AS BLOB) FROM Cache WHERE rowid > ? AND raw = 1
AND length(key) = 64 AND NOT instr(key, ' ') AND typeof(value) = 'text' ORDER BY rowid LIMIT ?
"""
COLUMNS = "provider, endpoint, model, path, body, own"
TABLE = f"""
CREATE TABLE IF NOT EXISTS kinds (
    provider TEXT, endpoint TEXT, model TEXT, path TEXT, body TEXT, own INTEGER,
    answers INTEGER NOT NULL, measured INTEGER NOT NULL, input_tokens INTEGER NOT NULL,
    output_tokens INTEGER NOT NULL, last INTEGER NOT NULL, PRIMARY KEY ({COLUMNS})) STRICT
"""
ADD = f"""
INSERT INTO kinds VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?) ON CONFLICT ({COLUMNS}) DO UPDATE SET
answers = answers + excluded.answers, measured = measured + excluded.measured,
input_tokens = input_tokens + excluded.input_tokens,
output_tokens = output_tokens + excluded.output_tokens, last = max(last, excluded.last)
"""  # noqa: S608 # constants


class Kind(NamedTuple):
    """Requests that are equal but for their prompt and slot.

    ``body`` is without the prompt; ``own`` says that no stand-in answered in the model's name.
    """

    provider: str
    endpoint: str
    model: str
    path: str
    body: str
    own: bool


class Answers(NamedTuple):
    """How many answers there are, how many of them name their tokens, and the sums of these."""

    answers: int = 0
    measured: int = 0
    input_tokens: int = 0
    output_tokens: int = 0

    def plus(self, other: Answers) -> Answers:
        """Return the counts of both."""
        return Answers(*map(sum, zip(self, other, strict=True)))


Kinds = dict[Kind, Answers]


def kinds_of(calls: Iterable[tuple[ChatRequest, Attempt]]) -> Kinds:
    """Count answered calls: their requests and last attempts."""
    found: Kinds = {}
    for request, last in calls:
        own = request.provider == "emulator" or not is_scripted(request, last)
        body = without_prompt(request.body)
        kind = Kind(request.provider, request.endpoint, request.model, request.path, body, own)
        read, written = last.usage.input_tokens, last.usage.output_tokens
        one = Answers(1) if read is None or written is None else Answers(1, 1, read, written)
        found[kind] = found.get(kind, Answers()).plus(one)
    return found


def counted(cache: ResponseCache) -> tuple[Kinds, Kinds]:
    """Return how many calls the recording and the folder have answered, by kind of request.

    Those of the folder since it was last asked for are counted first.
    """
    after = 0
    while after := cache.run_now([partial(_count_newer, after)])[0]:
        pass
    rows = cache.rows("SELECT * FROM kinds")
    return cache.recording[1], {Kind(*row[:6]): Answers(*row[6:10]) for row in rows}


def _count_newer(after: int, execute: Execute) -> int:
    """Count some calls that are not counted yet, and whose number is higher; an operation.

    No call is ever removed, so that a newer one has a higher number than all before it. Returns the
    number after which to go on, 0 where there are no more.
    """
    execute(TABLE)
    ((last,),) = execute("SELECT coalesce(max(last), 0) FROM kinds").fetchall()
    rows = execute(NEWER, (max(last, after), BATCH)).fetchall()
    calls = []
    for _, mode, filename, value in rows:
        with suppress(RecordingError, *DAMAGED):  # it is told where it is used
            entry = CachedCall.from_json(text_of(mode, filename, value.decode()))
            calls.append((entry.request, entry.attempts[-1]))
    newest = rows[-1][0] if rows else 0
    for kind, answers in kinds_of(calls).items():
        execute(ADD, (*kind, *answers, newest))
    return newest if len(rows) == BATCH else 0


def recorded_values(cache: ResponseCache, name: str, **fields: str) -> set[str]:
    """Return what ``name`` is in requests with a reply and these ``fields``.

    They are those of the recording, else of the folder.
    """
    for kinds in counted(cache):
        wanted = [k for k in kinds if all(getattr(k, f) == of for f, of in fields.items())]
        if wanted:
            return {getattr(kind, name) for kind in wanted}
    return set()
