"""Recorded replies on disk: one text entry per call key, never evicted, never pickled.

An entry is the JSON of a request, its slot and every attempt, the answering one last. It is
durable before anyone sees it: writes are batched into one synchronous SQLite transaction each.
"""

from __future__ import annotations

import asyncio
import json
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import diskcache
from diskcache.core import MODE_PICKLE
from pydantic import TypeAdapter, ValidationError

from merge_runner.errors import RecordingError, UsageError
from merge_runner.records import Attempt, ChatRequest

ENTRY_VERSION = 1
_NAMES = TypeAdapter(list[str])
_ENDPOINTS = "endpoints "
"""Prefix of the entries that list, per model id, the endpoint identities with recordings."""


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
        """Read an entry; raises RecordingError."""
        try:
            stored = _STORED.validate_json(text, strict=True)
        except ValidationError as exc:
            raise RecordingError(
                f"the recorded reply is damaged: {exc.errors()[0]['msg']}"
            ) from exc
        if stored.version != ENTRY_VERSION:
            raise RecordingError(
                f"the recorded reply has version {stored.version}, this program reads version "
                f"{ENTRY_VERSION}"
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


class TextDisk(diskcache.Disk):  # type: ignore[misc] # diskcache ships no types
    """Stores text alone, and refuses a pickled value: reading one would execute code."""

    def store(self, value: object, read: bool, key: object = diskcache.UNKNOWN) -> Any:  # noqa: ANN401 # diskcache's signature
        """Store a text."""
        if not isinstance(value, str):
            raise TypeError("the cache stores text only")
        return super().store(value, read, key=key)

    def get(self, key: object, raw: bool) -> Any:  # noqa: ANN401 # diskcache's signature
        """Read back a key."""
        if not raw or not isinstance(key, str):
            raise RecordingError(
                "the cache holds a key that is no text, which is not ours: refused"
            )
        return super().get(key, raw)

    def fetch(self, mode: int, filename: str | None, value: object, read: bool) -> Any:  # noqa: ANN401 # diskcache's signature
        """Fetch a text."""
        if mode == MODE_PICKLE:
            raise RecordingError("the cache holds a pickled value, which is not ours: refused")
        return super().fetch(mode, filename, value, read)


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
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            folder.chmod(0o700)
            self._disk = diskcache.Cache(
                str(folder),
                disk=TextDisk,
                eviction_policy="none",
                cull_limit=0,
                size_limit=2**62,
                sqlite_synchronous=2,  # FULL: an acknowledged reply survives a power cut
                disk_min_file_size=2**40,  # everything in the one SQLite file
            )
        except (OSError, sqlite3.Error) as exc:
            raise UsageError(f"the cache {folder} cannot be used: {exc}") from exc
        self._pending: list[Entry] = []
        self._next_batch: asyncio.Task[list[Entry]] | None = None
        self._one_batch_at_a_time = asyncio.Lock()

    @cached_property
    def _overlay(self) -> Mapping[str, Entry]:
        return self._read_overlay() if self._read_overlay else {}

    def get(self, key: str) -> Entry | None:
        """The entry of a call key."""
        if key in self._overlay:
            return self._overlay[key]
        text: str | None = self._disk.get(key)
        return None if text is None else Entry.from_json(text)

    async def put(self, entry: Entry) -> Entry:
        """Keep an entry; returns the one that is kept when it is durable.

        That is another one where another process was first: a kept reply is never replaced.
        """
        if self._next_batch is None:
            self._next_batch = asyncio.create_task(self._write_batch())
        batch, place = self._next_batch, len(self._pending)
        self._pending.append(entry)
        # Shielded: whoever gives up waiting takes nobody else's entry with it.
        return (await asyncio.shield(batch))[place]

    def put_now(self, entries: Iterable[Entry]) -> list[Entry]:
        """Keep entries in one transaction, in this thread; returns those that are kept."""
        kept = []
        with self._disk.transact(retry=True):
            for entry in entries:
                if self._disk.add(entry.request.key, entry.to_json()):
                    self._note_endpoint(entry.request)
                    kept.append(entry)
                else:
                    kept.append(Entry.from_json(self._disk[entry.request.key]))
        return kept

    def entries(self) -> Iterator[Entry]:
        """All entries, of the folder and of the overlay."""
        for key in self._disk:
            if not key.startswith(_ENDPOINTS):
                yield Entry.from_json(self._disk[key])
        yield from self._overlay.values()

    def recorded_endpoints(self, model: str) -> list[str]:
        """The endpoint identities of a model's replies: the recording's, else the folder's."""
        requests = (entry.request for entry in self._overlay.values())
        overlaid = sorted({r.endpoint for r in requests if r.model == model})
        return overlaid or self._endpoints(model)

    def close(self) -> None:
        """Close the folder."""
        self._disk.close()

    async def _write_batch(self) -> list[Entry]:
        """Write all that has gathered while the batch before this one was written."""
        async with self._one_batch_at_a_time:
            entries, self._pending, self._next_batch = self._pending, [], None
            try:
                return await asyncio.to_thread(self.put_now, entries)
            except (OSError, sqlite3.Error, diskcache.Timeout) as exc:
                raise UsageError(f"the cache {self.folder} cannot be written: {exc}") from exc

    def _note_endpoint(self, request: ChatRequest) -> None:
        known = self._endpoints(request.model)
        if request.endpoint not in known:
            text = json.dumps(sorted([*known, request.endpoint]))
            self._disk.set(_ENDPOINTS + request.model, text)

    def _endpoints(self, model: str) -> list[str]:
        text = self._disk.get(_ENDPOINTS + model)
        try:
            return [] if text is None else _NAMES.validate_json(text)
        except ValidationError as exc:
            raise RecordingError(f"the cache's list of endpoints is damaged: {exc}") from exc
