"""How many calls a cache has answered, by kind of request, so that no run reads them all to begin.

The counts lie in a table of the cache's file. Calls that were answered since it was written are
added when it is next asked for.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

from merge_runner.records import Attempt, ChatRequest, is_scripted, without_prompt

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


def kinds_in(rows: Iterable[tuple[Any, ...]]) -> Kinds:
    """Return the counts in rows of the table."""
    found = {}
    for provider, endpoint, model, path, body, own, *counts, _ in rows:
        found[Kind(provider, endpoint, model, path, body, bool(own))] = Answers(*counts)
    return found


def rows_of(kinds: Kinds, last: int) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of counts, the newest of whose calls has this number."""
    return ((*kind, *answers, last) for kind, answers in kinds.items())
