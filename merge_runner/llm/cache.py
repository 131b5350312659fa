"""Recorded replies on disk: one text entry per call key, never evicted, never pickled.

An entry is the JSON of a request, its slot and every attempt, the answering one last, behind a
checksum. It is durable before anyone sees it: each batch of writes is one synchronous SQLite
transaction. Beside the entries lie what is known of each model, what each sweep has spent (see
ledger.py), the attempts of calls that have no answer yet, and damaged entries set aside.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import islice
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter, ValidationError

from merge_runner.errors import CacheFailed, RecordingError
from merge_runner.llm.cache_db import FAILURES, open_read_only, open_store
from merge_runner.llm.content_hashes import manner, without_prompt
from merge_runner.llm.model_lock import ModelLocks
from merge_runner.llm.verify import DAMAGED, check_body, check_call
from merge_runner.llm.write_batcher import BatchWriter, Operation, ResultT
from merge_runner.records import Attempt, ChatRequest, is_scripted

CHECKSUM_LENGTH = 32
BATCH = 1_000
ATTEMPTS = TypeAdapter(tuple[Attempt, ...])
# Prefixes of keys that are no call keys.
_MODEL, _UNANSWERED, _DAMAGED = "model ", "attempts ", "damaged "


@dataclass(frozen=True, slots=True)
class CachedCall:
    """A recorded call: its request, and all attempts, the answering one last."""

    request: ChatRequest
    attempts: tuple[Attempt, ...]

    def to_json(self) -> str:
        """The entry as one JSON text."""
        return _STORED.dump_json(_Stored(1, self)).decode()

    @classmethod
    def from_json(cls, text: str) -> CachedCall:
        """Read an entry; raises RecordingError."""
        try:
            stored = _STORED.validate_json(text, strict=True)
        except ValidationError as exc:
            raise RecordingError(
                f"the recorded reply is damaged: {exc.errors()[0]['msg']}"
            ) from exc
        if not stored.entry.attempts:
            raise RecordingError("the recorded reply is damaged: it holds no attempt")
        return stored.entry


@dataclass(frozen=True, slots=True)
class _Stored:
    """An entry as it lies in the cache."""

    version: Literal[1]
    entry: CachedCall


_STORED: TypeAdapter[_Stored] = TypeAdapter(_Stored)


@dataclass(slots=True)
class CallTotals:
    """Sums over entries of one model, at one endpoint, asked in one manner (see content_hashes.py).

    ``measured`` counts the answers that state their tokens and are the model's own, no stand-in's:
    tokens and latencies are theirs. So many of them are ``untimed``: a batch tells no latency.
    """

    cost_usd: float = 0.0
    measured: int = 0
    input_tokens: int = 0
    output_tokens: int = 0
    latency_s: float = 0.0
    untimed: int = 0

    @property
    def mean_latency_s(self) -> float | None:
        """The mean over the answers that have one; None: none has."""
        timed = self.measured - self.untimed
        return self.latency_s / timed if timed else None

    def add(self, entry: CachedCall) -> None:
        """Count an entry."""
        self.cost_usd += sum(attempt.cost_usd or 0.0 for attempt in entry.attempts)
        last = entry.attempts[-1]
        if entry.request.provider != "emulator" and is_scripted(entry.request, last):
            return
        if last.usage.input_tokens is not None and last.usage.output_tokens is not None:
            self.measured += 1
            self.untimed += last.latency_s is None
            self.input_tokens += last.usage.input_tokens
            self.output_tokens += last.usage.output_tokens
            self.latency_s += last.latency_s or 0.0


@dataclass(slots=True)
class ModelStats:
    """What the cache knows of a model: totals by endpoint, and there by how it was asked."""

    totals: dict[str, dict[str, CallTotals]] = field(default_factory=dict)

    def add(self, entry: CachedCall) -> None:
        """Count an entry."""
        request = entry.request
        asked = manner(request.path, without_prompt(request.body))
        self.totals.setdefault(request.endpoint, {}).setdefault(asked, CallTotals()).add(entry)

    def of(self, endpoint: str, asked: str) -> CallTotals:
        """The totals of one endpoint and manner of asking."""
        return self.totals.get(endpoint, {}).get(asked, CallTotals())

    @property
    def cost_usd(self) -> float:
        """What all its entries cost when they were made."""
        return sum(each.cost_usd for manners in self.totals.values() for each in manners.values())


_STATS = TypeAdapter(ModelStats)


@dataclass(frozen=True, slots=True)
class KnownCall:
    """What is recorded of a call: its entry, or the attempts of earlier runs.

    ``damaged`` names what was found damaged and set aside.
    """

    entry: CachedCall | None
    attempts: tuple[Attempt, ...]
    damaged: tuple[str, ...] = ()


class ResponseCache:
    """The cache folder. Reads are direct; writes are batched in a thread and awaited.

    Whoever makes a call has claimed it, so that no other trial or worker of its run makes it too.
    ``locks`` keep other live runs from asking the same model.
    """

    def __init__(
        self,
        folder: Path,
        *,
        overlay: Callable[[], Mapping[str, CachedCall]] | None = None,
        read_only: bool = False,
    ) -> None:
        """Open or make the folder; ``overlay`` reads a recording, entries by key.

        What the recording holds comes before what the folder holds. ``read_only`` changes nothing
        in the folder, which must be there.
        """
        self.folder = folder
        self.locks = ModelLocks(folder)
        self._claimed: set[str] = set()
        self._read_overlay = overlay
        self._store = open_read_only(folder) if read_only else open_store(folder)
        self._writer = BatchWriter(self.run_now)
        self._new: list[CachedCall] = []

    @cached_property
    def _overlay(self) -> Mapping[str, CachedCall]:
        return self._read_overlay() if self._read_overlay else {}

    def get(self, key: str) -> CachedCall | None:
        """The entry of a call key; raises RecordingError for one that is damaged or made up."""
        return self._overlay.get(key) or self._kept(key)

    async def claim(self, key: str) -> KnownCall | None:
        """Claim a call and learn what is recorded of it; None while another one holds it.

        What is damaged is set aside.
        """
        if key in self._claimed:
            return None
        known = self._known(key)  # what cannot be read is not claimed
        self._claimed.add(key)
        return known

    def _known(self, key: str) -> KnownCall:
        try:
            return KnownCall(self.get(key), self.unanswered(key))
        except RecordingError:
            damaged = tuple(self.set_damage_aside(key))
            return KnownCall(self.get(key), self.unanswered(key), damaged)

    def release(self, key: str) -> None:
        """Give a claim up."""
        self._claimed.discard(key)

    async def put(self, entry: CachedCall, also: Operation | None = None) -> CachedCall:
        """Keep an entry; returns the one that is kept when it is durable.

        That is another one where an import was first: a kept reply is never replaced.
        ``also`` runs in the same transaction.
        """

        def operation() -> CachedCall:
            kept = self._keep(entry)
            if also is not None:
                also()
            return kept

        return await self.write(operation)

    def put_now(self, entries: Iterable[CachedCall]) -> list[CachedCall]:
        """Keep entries in one transaction, in this thread; returns those that are kept."""
        return self.run_now([partial(self._keep, entry) for entry in entries])

    def add_missing(self, entries: Iterable[CachedCall]) -> tuple[int, int]:
        """Keep the entries that the cache lacks; returns (added, already there)."""
        added = there = 0
        waiting = iter(entries)
        while batch := list(islice(waiting, BATCH)):
            new = [entry for entry in batch if not self._holds(entry.request.key)]
            self.put_now(new)
            added += len(new)
            there += len(batch) - len(new)
        return added, there

    def set_damage_aside(self, key: str) -> list[str]:
        """Move a damaged entry, or list of attempts, to where it can still be looked at.

        Returns the names of what was moved.
        """
        checks = {key: self._kept, _UNANSWERED + key: self.unanswered}

        def damaged() -> list[str]:
            return [name for name, check in checks.items() if _is_damaged(check, key)]

        def operation() -> list[str]:
            found = damaged()  # again: an import may have moved it since
            for name in found:
                self._store.quarantine(name, _DAMAGED + name)
            return found

        moved: list[str] = self.run_now([operation])[0] if damaged() else []
        return moved

    def unanswered(self, key: str) -> tuple[Attempt, ...]:
        """The attempts at a call that earlier runs made without an answer."""
        text = self.read(_UNANSWERED + key)
        return () if text is None else _attempts(text)

    def all_unanswered(self) -> dict[str, tuple[Attempt, ...]]:
        """The attempts at all calls without an answer, by call key."""
        keys = (name.removeprefix(_UNANSWERED) for name in self.names(_UNANSWERED))
        return {key: self.unanswered(key) for key in keys}

    def keep_all(
        self, entries: Iterable[CachedCall], unanswered: Mapping[str, tuple[Attempt, ...]]
    ) -> None:
        """An operation: keep entries, and the attempts at calls that have no answer yet."""
        for entry in entries:
            self._keep(entry)
        for key, attempts in unanswered.items():
            self.keep_unanswered(key, attempts)

    def keep_unanswered(self, key: str, attempts: tuple[Attempt, ...]) -> None:
        """An operation: keep the attempts at a call that has no answer yet."""
        self._store.set(_UNANSWERED + key, _behind_checksum(ATTEMPTS.dump_json(attempts).decode()))

    async def put_unanswered(self, key: str, attempts: tuple[Attempt, ...]) -> None:
        """Keep the attempts at a call that has no answer yet, durably."""
        await self.write(lambda: self.keep_unanswered(key, attempts))

    async def write(self, operation: Callable[[], ResultT]) -> ResultT:
        """Run an operation on this cache in the next durable batch; raises CacheFailed."""
        return await self._writer.write(operation)

    def run_now(self, operations: list[Operation]) -> list[Any]:
        """Run operations in one durable transaction, in this thread."""
        try:
            with self._store.transaction():
                results = [operation() for operation in operations]
                self._count(self._new)
        except FAILURES as exc:
            raise self._failed(
                f"written: {exc}. Every reply up to now is kept, those in flight are lost; when "
                "that is fixed, run the same command again"
            ) from exc
        finally:
            self._new = []
        return results

    def read(self, name: str) -> str | None:
        """The text under a name.

        Raises RecordingError where it is no text, CacheFailed where the folder cannot be read.
        """
        with self._readable():
            return self._store.get(name)

    def replace(self, name: str, text: str) -> None:
        """An operation: keep a text under a name that is no call key."""
        self._store.set(name, text)

    def remove(self, name: str) -> None:
        """An operation: forget what is under a name that is no call key."""
        self._store.delete(name)

    def names(self, prefix: str) -> list[str]:
        """The names that begin so, of what is no call."""
        with self._readable():
            return self._store.names(prefix)

    def read_checked(self, name: str) -> str | None:
        """Return a text that was kept behind a checksum; raises RecordingError."""
        text = self.read(name)
        return None if text is None else _checked(text)

    def replace_checked(self, name: str, text: str) -> None:
        """Keep a text behind a checksum, as an operation."""
        self._store.set(name, _behind_checksum(text))

    def entries(self, left_out: list[str] | None = None) -> Iterator[CachedCall]:
        """All entries, of the folder and of the overlay, each verified.

        What is damaged, or none of ours, is left out, and the reason added to ``left_out``.
        """
        with self._readable():
            yield from self._own_entries([] if left_out is None else left_out)
        yield from self._overlay.values()

    def recorded_endpoints(self, model: str) -> list[str]:
        """The endpoint identities of a model's replies: the recording's, else the folder's."""
        requests = (entry.request for entry in self._overlay.values())
        overlaid = sorted({r.endpoint for r in requests if r.model == model})
        return overlaid or sorted(self.stats(model).totals)

    def recorded_models(self, provider: str) -> list[str]:
        """The models of a provider that have replied: the recording's, else the folder's."""
        for entries in (self._overlay.values(), self._own_entries([])):
            requests = (entry.request for entry in entries)
            if models := {r.model for r in requests if r.provider == provider}:
                return sorted(models)
        return []

    def stats(self, model: str) -> ModelStats:
        """What the folder knows of a model."""
        return self._stats(model) or self._counted_anew()[model]

    def cost_usd(self) -> float:
        """What all entries of the folder cost when they were made."""
        models = (name.removeprefix(_MODEL) for name in self.names(_MODEL))
        return sum(self.stats(model).cost_usd for model in models)

    def close(self) -> None:
        """Close the folder, and free its locks."""
        self.locks.close()
        self._store.close()

    def _keep(self, entry: CachedCall) -> CachedCall:
        key = entry.request.key
        try:
            if kept := self._kept(key):
                return kept  # a kept reply is never replaced
        except RecordingError:
            self._store.quarantine(key, _DAMAGED + key)
        self._store.set(key, _behind_checksum(entry.to_json()))
        self._store.delete(_UNANSWERED + key)
        self._new.append(entry)
        return entry

    def _holds(self, key: str) -> bool:
        try:
            return self.get(key) is not None
        except RecordingError:
            return False  # a damaged one is set aside when another is kept in its place

    def _kept(self, key: str) -> CachedCall | None:
        text = self.read(key)
        return None if text is None else _verified(key, text)

    @contextlib.contextmanager
    def _readable(self) -> Iterator[None]:
        try:
            yield
        except FAILURES as exc:
            raise self._failed(
                f"read: {exc}. Put a copy of it back, or name another with --cache; the database "
                "and any exported recording are not affected"
            ) from exc

    def _failed(self, how: str) -> CacheFailed:
        if self._store.in_place:
            return CacheFailed(f"the cache {self.folder} cannot be {how}")
        return CacheFailed(
            f"the cache {self.folder} was removed, moved or replaced while it was in use, and what "
            "it kept with it. Put it back if you can, and run the same command again: what is in "
            "no cache is asked again. The database is not affected"
        )

    def _count(self, entries: Iterable[CachedCall]) -> None:
        """Within a transaction: add entries to the stats of their models."""
        by_model: dict[str, list[CachedCall]] = {}
        for entry in entries:
            by_model.setdefault(entry.request.model, []).append(entry)
        for model, new in by_model.items():
            known = self._stats(model)
            if known is None:
                known = self._counted_anew()[model]  # with the new ones, which lie there already
            else:
                for entry in new:
                    known.add(entry)
            self._keep_stats(model, known)

    def _keep_stats(self, model: str, stats: ModelStats) -> None:
        self.replace_checked(_MODEL + model, _STATS.dump_json(stats).decode())

    def _stats(self, model: str) -> ModelStats | None:
        """The stats of a model; None where they are damaged."""
        try:
            text = self.read_checked(_MODEL + model)
            return ModelStats() if text is None else _STATS.validate_json(text)
        except (RecordingError, ValidationError):
            return None

    def _counted_anew(self) -> defaultdict[str, ModelStats]:
        """The stats of each model, from all entries; those it has none of are empty."""
        stats: defaultdict[str, ModelStats] = defaultdict(ModelStats)
        for entry in self._own_entries([]):  # a damaged one is reported when it is needed
            stats[entry.request.model].add(entry)
        return stats

    def _own_entries(self, left_out: list[str]) -> Iterator[CachedCall]:
        """The entries of the folder; see ``entries``."""
        for row in self._store.calls():
            try:
                if isinstance(row, RecordingError):
                    raise row
                entry = _verified(*row)
                check_body(entry.request.body)
                yield entry
            except (RecordingError, *DAMAGED) as exc:
                left_out.append(str(exc))


def _verified(key: str, text: str) -> CachedCall:
    """Return the entry that a row holds.

    Raises RecordingError unless it is whole and belongs to its key: a reply to one request must
    never answer another.
    """
    entry = CachedCall.from_json(_checked(text))
    try:
        check_call(key, entry.request, entry.attempts)
    except DAMAGED as exc:
        raise RecordingError(f"the recorded reply is damaged: {exc}") from exc
    return entry


def _behind_checksum(text: str) -> str:
    """A text as it is stored."""
    return hashlib.sha256(text.encode()).hexdigest()[:CHECKSUM_LENGTH] + text


def _checked(text: str) -> str:
    """Return what was put behind a checksum; raises RecordingError where that is wrong."""
    content = text[CHECKSUM_LENGTH:]
    if text != _behind_checksum(content):
        raise RecordingError("the recorded reply is damaged: its checksum is wrong")
    return content


def _attempts(text: str) -> tuple[Attempt, ...]:
    try:
        return ATTEMPTS.validate_json(_checked(text))
    except ValidationError as exc:
        raise RecordingError("the list of earlier attempts is damaged") from exc


def _is_damaged(check: Callable[[str], object], key: str) -> bool:
    try:
        check(key)
    except RecordingError:
        return True
    return False
