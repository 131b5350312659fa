"""Recorded replies on disk: one text entry per call key, never evicted, never pickled.

An entry is the JSON of a request, its slot and every attempt, the answering one last, behind a
checksum. It is durable before anyone sees it: writes are batched into one synchronous SQLite
transaction each. Beside the entries lie what is known of each model, what each sweep has spent
(see ledger.py), the attempts of calls that have no answer yet, and damaged entries set aside.
"""

from __future__ import annotations

import contextlib
import hashlib
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import diskcache
from pydantic import TypeAdapter, ValidationError

from merge_runner.errors import CacheFailed, RecordingError, UsageError
from merge_runner.llm.batches import BatchWriter, Operation
from merge_runner.llm.disk import FORMAT, format_of, open_disk, set_format
from merge_runner.llm.keys import manner, without_prompt
from merge_runner.records import Attempt, ChatRequest, is_scripted

ENTRY_VERSION = 1
KEY_LENGTH = 64
CHECKSUM_LENGTH = 32
ATTEMPTS = TypeAdapter(tuple[Attempt, ...])
# Prefixes of keys that are no call keys.
_MODEL, _UNANSWERED, _DAMAGED = "model ", "attempts ", "damaged "
_OLD_ENDPOINTS = "endpoints "


@dataclass(frozen=True, slots=True)
class Entry:
    """A recorded call: its request, and all attempts, the answering one last."""

    request: ChatRequest
    attempts: tuple[Attempt, ...]

    def to_json(self) -> str:
        """The entry as one JSON text."""
        return _STORED.dump_json(_Stored(ENTRY_VERSION, self)).decode()

    @classmethod
    def from_json(cls, text: str) -> Entry:
        """Read an entry; raises RecordingError, or UsageError for one of a newer version."""
        try:
            stored = _STORED.validate_json(text, strict=True)
        except ValidationError as exc:
            raise RecordingError(
                f"the recorded reply is damaged: {exc.errors()[0]['msg']}"
            ) from exc
        if stored.version > ENTRY_VERSION:
            raise UsageError(
                f"a recorded reply has version {stored.version}, written by a newer merge-runner; "
                f"this one reads up to {ENTRY_VERSION}: update merge-runner"
            )
        if not stored.entry.attempts:
            raise RecordingError("the recorded reply is damaged: it holds no attempt")
        return stored.entry


@dataclass(frozen=True, slots=True)
class _Stored:
    """An entry as it lies in the cache."""

    version: int
    entry: Entry


_STORED: TypeAdapter[_Stored] = TypeAdapter(_Stored)


@dataclass(slots=True)
class Totals:
    """Sums over entries of one model, at one endpoint, asked in one manner (see keys.py).

    Tokens and latencies are those of the ``measured`` answers: they tell both, and are the model's
    own and no stand-in's.
    """

    cost_usd: float = 0.0
    measured: int = 0
    input_tokens: int = 0
    output_tokens: int = 0
    latency_s: float = 0.0

    def add(self, entry: Entry) -> None:
        """Count an entry."""
        self.cost_usd += sum(attempt.cost_usd or 0.0 for attempt in entry.attempts)
        last = entry.attempts[-1]
        if entry.request.provider != "emulator" and is_scripted(entry.request, last):
            return
        if last.usage.input_tokens is not None and last.usage.output_tokens is not None:
            self.measured += 1
            self.input_tokens += last.usage.input_tokens
            self.output_tokens += last.usage.output_tokens
            self.latency_s += last.latency_s or 0.0


@dataclass(slots=True)
class ModelFacts:
    """What the cache knows of a model: totals by endpoint, and there by how it was asked."""

    totals: dict[str, dict[str, Totals]] = field(default_factory=dict)

    def add(self, entry: Entry) -> None:
        """Count an entry."""
        request = entry.request
        asked = manner(request.path, without_prompt(request.body))
        self.totals.setdefault(request.endpoint, {}).setdefault(asked, Totals()).add(entry)

    def of(self, endpoint: str, asked: str) -> Totals:
        """The totals of one endpoint and manner of asking."""
        return self.totals.get(endpoint, {}).get(asked, Totals())

    @property
    def cost_usd(self) -> float:
        """What all its entries cost when they were made."""
        return sum(each.cost_usd for manners in self.totals.values() for each in manners.values())


_FACTS = TypeAdapter(ModelFacts)


class ResponseCache:
    """The cache folder. Reads are direct; writes are batched in a thread and awaited."""

    def __init__(
        self, folder: Path, *, overlay: Callable[[], Mapping[str, Entry]] | None = None
    ) -> None:
        """Open or make the folder; ``overlay`` reads a recording, entries by key.

        What the recording holds comes before what the folder holds.
        """
        self.folder = folder
        self._read_overlay = overlay
        self._disk, version = open_disk(folder)
        self._writer = BatchWriter(self.run_now)
        self._new: list[Entry] = []
        if version < FORMAT:
            self._bring_up_to_date()

    @cached_property
    def _overlay(self) -> Mapping[str, Entry]:
        return self._read_overlay() if self._read_overlay else {}

    def get(self, key: str) -> Entry | None:
        """The entry of a call key; raises RecordingError for a damaged one."""
        if key in self._overlay:
            return self._overlay[key]
        text = self.read(key)
        return None if text is None else _unsealed(text)

    async def put(self, entry: Entry, also: Operation | None = None) -> Entry:
        """Keep an entry; returns the one that is kept when it is durable.

        That is another one where another process was first: a kept reply is never replaced.
        ``also`` runs in the same transaction.
        """

        def operation() -> Entry:
            kept = self._keep(entry)
            if also is not None:
                also()
            return kept

        kept: Entry = await self.write(operation)
        return kept

    def put_now(self, entries: Iterable[Entry]) -> list[Entry]:
        """Keep entries in one transaction, in this thread; returns those that are kept."""
        return self.run_now([partial(self._keep, entry) for entry in entries])

    def set_damage_aside(self, key: str) -> list[str]:
        """Move a damaged entry, or list of attempts, to where it can still be looked at.

        Returns the names of those that were.
        """
        names = {key: _unsealed, _UNANSWERED + key: _attempts}

        def damaged() -> list[str]:
            return [name for name, check in names.items() if self._is_damaged(name, check)]

        def operation() -> list[str]:
            found = damaged()  # another process may have mended it
            for name in found:
                self._disk.set(_DAMAGED + name, self._disk[name])
                self._disk.delete(name)
            return found

        moved: list[str] = self.run_now([operation])[0] if damaged() else []
        return moved

    def unanswered(self, key: str) -> tuple[Attempt, ...]:
        """The attempts at a call that earlier runs made without an answer."""
        text = self.read(_UNANSWERED + key)
        return () if text is None else _attempts(text)

    def keep_unanswered(self, key: str, attempts: tuple[Attempt, ...]) -> None:
        """An operation: keep the attempts at a call that has no answer yet."""
        self._disk.set(_UNANSWERED + key, ATTEMPTS.dump_json(attempts).decode())

    async def put_unanswered(self, key: str, attempts: tuple[Attempt, ...]) -> None:
        """Keep the attempts at a call that has no answer yet, durably."""
        await self.write(lambda: self.keep_unanswered(key, attempts))

    async def write(self, operation: Callable[[], Any]) -> Any:  # noqa: ANN401 # the operation's own result
        """Run an operation on this cache in the next durable batch; raises CacheFailed."""
        return await self._writer.write(operation)

    def run_now(self, operations: list[Operation]) -> list[Any]:
        """Run operations in one durable transaction, in this thread."""
        try:
            with self._disk.transact(retry=True):
                results = [operation() for operation in operations]
                self._count(self._new)
        except (OSError, sqlite3.Error, diskcache.Timeout) as exc:
            raise CacheFailed(
                f"the cache {self.folder} cannot be written: {exc}. Every reply up to now is kept, "
                "those in flight are lost; when that is mended, run the same command again"
            ) from exc
        finally:
            self._new = []
        return results

    def read(self, name: str) -> str | None:
        """The text under a name; raises CacheFailed where the folder cannot be read."""
        try:
            text: str | None = self._disk.get(name)
        except (OSError, sqlite3.Error, diskcache.Timeout) as exc:
            raise CacheFailed(
                f"the cache {self.folder} cannot be read: {exc}. Mend or move it; the database and "
                "any exported recording are not affected"
            ) from exc
        return text

    def replace(self, name: str, text: str) -> None:
        """An operation: keep a text under a name that is no call key."""
        self._disk.set(name, text)

    def remove(self, name: str) -> None:
        """An operation: forget what is under a name that is no call key."""
        self._disk.delete(name)

    def names(self, prefix: str) -> list[str]:
        """The names that begin so, of what is no call."""
        try:
            return [key for key in self._disk if key.startswith(prefix)]
        except sqlite3.Error as exc:
            raise CacheFailed(f"the cache {self.folder} cannot be read: {exc}") from exc

    def entries(self) -> Iterator[Entry]:
        """All entries, of the folder and of the overlay."""
        for key in self._keys():
            yield _unsealed(self._disk[key])
        yield from self._overlay.values()

    def recorded_endpoints(self, model: str) -> list[str]:
        """The endpoint identities of a model's replies: the recording's, else the folder's."""
        requests = (entry.request for entry in self._overlay.values())
        overlaid = sorted({r.endpoint for r in requests if r.model == model})
        return overlaid or sorted(self.facts(model).totals)

    def facts(self, model: str) -> ModelFacts:
        """What the folder knows of a model."""
        return self._facts(model) or self._counted_anew(model)

    def cost_usd(self) -> float:
        """What all entries of the folder cost when they were made."""
        models = [name.removeprefix(_MODEL) for name in self.names(_MODEL)]
        return sum(self.facts(model).cost_usd for model in models)

    def close(self) -> None:
        """Close the folder."""
        self._disk.close()

    def _keep(self, entry: Entry) -> Entry:
        key = entry.request.key
        if not self._disk.add(key, _sealed(entry)):
            return _unsealed(self._disk[key])
        self._disk.delete(_UNANSWERED + key)
        self._new.append(entry)
        return entry

    def _is_damaged(self, name: str, check: Callable[[str], object]) -> bool:
        text = self.read(name)
        try:
            if text is not None:
                check(text)
        except RecordingError:
            return True
        return False

    def _keys(self) -> Iterator[str]:
        return (key for key in self._disk if len(key) == KEY_LENGTH and " " not in key)

    def _count(self, entries: Iterable[Entry]) -> None:
        """Within a transaction: add entries to the facts about their models."""
        by_model: dict[str, list[Entry]] = {}
        for entry in entries:
            by_model.setdefault(entry.request.model, []).append(entry)
        for model, new in by_model.items():
            known = self._facts(model)
            if known is None:
                known = self._counted_anew(model)  # with the new ones, which lie there already
            else:
                for entry in new:
                    known.add(entry)
            self._disk.set(_MODEL + model, _FACTS.dump_json(known).decode())

    def _bring_up_to_date(self) -> None:
        """Earlier formats knew less of each model: count anew."""
        with self._disk.transact(retry=True):
            if format_of(self._disk) == FORMAT:
                return  # another process was quicker
            for key in [key for key in self._disk if key.startswith((_OLD_ENDPOINTS, _MODEL))]:
                del self._disk[key]
            self._count(self._undamaged())
            set_format(self._disk)

    def _facts(self, model: str) -> ModelFacts | None:
        """The facts about a model; None where they are damaged."""
        text = self.read(_MODEL + model)
        try:
            return ModelFacts() if text is None else _FACTS.validate_json(text)
        except ValidationError:
            return None

    def _counted_anew(self, model: str) -> ModelFacts:
        facts = ModelFacts()
        for entry in self._undamaged():
            if entry.request.model == model:
                facts.add(entry)
        return facts

    def _undamaged(self) -> Iterator[Entry]:
        """A damaged entry is reported when it is needed, not before."""
        for key in self._keys():
            with contextlib.suppress(RecordingError):
                yield _unsealed(self._disk[key])


def _sealed(entry: Entry) -> str:
    """An entry as it is stored: its JSON behind a checksum."""
    text = entry.to_json()
    return checksum(text) + text


def _unsealed(text: str) -> Entry:
    """A stored entry; those of the first format have no checksum. Raises RecordingError."""
    if not text.startswith("{"):
        told, text = text[:CHECKSUM_LENGTH], text[CHECKSUM_LENGTH:]
        if told != checksum(text):
            raise RecordingError("the recorded reply is damaged: its checksum is wrong")
    return Entry.from_json(text)


def _attempts(text: str) -> tuple[Attempt, ...]:
    try:
        return ATTEMPTS.validate_json(text)
    except ValidationError as exc:
        raise RecordingError("the list of earlier attempts is damaged") from exc


def checksum(text: str) -> str:
    """What tells a damaged text."""
    return hashlib.sha256(text.encode()).hexdigest()[:CHECKSUM_LENGTH]
