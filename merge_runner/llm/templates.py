"""Counts of a cache's answered calls by request template: all of a request but prompt and slot.

A run needs them when it begins, and need not read all calls for that. The counts lie in a table of
the cache's file; calls that were answered since it was written are added when it is next read.
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
# As bytes, since a damaged value may be no text.
NEWER = """
SELECT rowid, mode, filename, CAST(value AS BLOB) FROM Cache WHERE rowid > ? AND raw = 1
AND length(key) = 64 AND NOT instr(key, ' ') AND typeof(value) = 'text' ORDER BY rowid LIMIT ?
"""
LAST = "SELECT coalesce(max(last), 0) FROM kinds"
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


class RequestTemplate(NamedTuple):
    """A request without its prompt and slot; ``genuine``: no mock model answered in its name."""

    provider: str
    endpoint: str
    model: str
    path: str
    body: str
    genuine: bool


class AnswerCounts(NamedTuple):
    """Number of answers, of those that report their tokens, and the sums of these."""

    answers: int = 0
    measured: int = 0
    input_tokens: int = 0
    output_tokens: int = 0

    def plus(self, other: AnswerCounts) -> AnswerCounts:
        """Return the sum of both."""
        return AnswerCounts(*map(sum, zip(self, other, strict=True)))


TemplateCounts = dict[RequestTemplate, AnswerCounts]


def count_by_template(calls: Iterable[tuple[ChatRequest, Attempt]]) -> TemplateCounts:
    """Count answered calls, given as requests and last attempts."""
    counts: TemplateCounts = {}
    for request, last in calls:
        genuine = request.provider == "emulator" or not is_scripted(request, last)
        template = RequestTemplate(
            request.provider,
            request.endpoint,
            request.model,
            request.path,
            without_prompt(request.body),
            genuine,
        )
        read, written = last.usage.input_tokens, last.usage.output_tokens
        answer = AnswerCounts(1)
        if read is not None and written is not None:
            answer = AnswerCounts(1, 1, read, written)
        counts[template] = counts.get(template, AnswerCounts()).plus(answer)
    return counts


def answer_counts(cache: ResponseCache) -> tuple[TemplateCounts, TemplateCounts]:
    """Return the counts of the recording and of the folder, whose newer calls are counted first."""
    after = 0
    while _has_newer(cache) and (after := cache.run_now([partial(_count_newer, after)])[0]):
        pass
    rows = cache.rows("SELECT * FROM kinds")
    folder = {RequestTemplate(*row[:6]): AnswerCounts(*row[6:10]) for row in rows}
    return cache.recording[1], folder


def _has_newer(cache: ResponseCache) -> bool:
    """Return whether a call is not counted yet: only then the folder is written."""
    if not cache.rows("SELECT 1 FROM sqlite_master WHERE name = 'kinds'"):
        return True
    ((last,),) = cache.rows(LAST)
    return bool(cache.rows(NEWER, last, 1))


def _count_newer(after: int, execute: Execute) -> int:
    """Count up to BATCH calls that are not counted yet, with a row id above ``after``.

    An operation. No call is ever removed, so newer calls have higher row ids. Returns the row id
    after which to go on, 0 at the end.
    """
    execute(TABLE)
    ((last,),) = execute(LAST).fetchall()
    rows = execute(NEWER, (max(last, after), BATCH)).fetchall()
    calls = []
    for _, mode, filename, value in rows:
        with suppress(RecordingError, *DAMAGED):  # reported where it is used
            entry = CachedCall.from_json(text_of(mode, filename, value.decode()))
            calls.append((entry.request, entry.attempts[-1]))
    newest = rows[-1][0] if rows else 0
    for template, answers in count_by_template(calls).items():
        execute(ADD, (*template, *answers, newest))
    return newest if len(rows) == BATCH else 0


def recorded_values(cache: ResponseCache, name: str, **fields: str) -> set[str]:
    """Return the values of ``name`` in templates with these ``fields``.

    They come from the recording, or else from the folder.
    """
    for counts in answer_counts(cache):
        matching = [t for t in counts if all(getattr(t, f) == value for f, value in fields.items())]
        if matching:
            return {getattr(template, name) for template in matching}
    return set()
