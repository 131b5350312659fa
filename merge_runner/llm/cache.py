"""Recorded replies on disk: one text entry per call key, never evicted, never pickled.

An entry is the JSON of a request, its slot and every attempt, the answering one last. It is
durable before anyone sees it: writes are batched into one synchronous SQLite transaction each.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import diskcache
from diskcache.core import MODE_PICKLE

from merge_runner.errors import RecordingError, UsageError
from merge_runner.records import Attempt, ChatRequest, Slot, Usage

ENTRY_VERSION = 1
_ENDPOINTS = "endpoints "
"""Prefix of the entries that list, per model id, the endpoint identities with recordings."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A recorded call: its request, and all attempts, the answering one last."""

    request: ChatRequest
    attempts: tuple[Attempt, ...]

    def to_json(self) -> str:
        """The entry as one JSON text."""
        request = self.request
        return json.dumps(
            {
                "version": ENTRY_VERSION,
                "key": request.key,
                "provider": request.provider,
                "endpoint": request.endpoint,
                "model": request.model,
                "path": request.path,
                "headers": request.headers,
                "slot": request.slot.as_dict(),
                "body": request.body,
                "attempts": [asdict(attempt) for attempt in self.attempts],
            },
            ensure_ascii=False,
        )

    @classmethod
    def from_json(cls, text: str) -> Entry:
        """Read an entry; raises RecordingError."""
        try:
            value = json.loads(text)
            if value["version"] != ENTRY_VERSION:
                raise RecordingError(
                    f"the entry has version {value['version']}, this program reads {ENTRY_VERSION}"
                )
            return cls(
                request=ChatRequest(
                    key=value["key"],
                    provider=value["provider"],
                    endpoint=value["endpoint"],
                    model=value["model"],
                    path=value["path"],
                    headers=value["headers"],
                    body=value["body"],
                    slot=Slot(**value["slot"]),
                ),
                attempts=tuple(attempt_from(attempt) for attempt in value["attempts"]),
            )
        except (ValueError, KeyError, TypeError) as exc:
            raise RecordingError(f"damaged cache entry: {exc!r}") from exc


class TextDisk(diskcache.Disk):  # type: ignore[misc] # diskcache ships no types
    """Stores text alone, and refuses a pickled value: reading one would execute code."""

    def store(self, value: object, read: bool, key: object = diskcache.UNKNOWN) -> Any:  # noqa: ANN401 # diskcache's signature
        """Store a text."""
        if not isinstance(value, str):
            raise TypeError("the cache stores text only")
        return super().store(value, read, key=key)

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
        """Open or make the folder; ``overlay`` reads a recording, entries by key, when needed."""
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
        except OSError as exc:
            raise UsageError(f"the cache {folder} cannot be used: {exc}") from exc
        self._pending: list[tuple[Entry, asyncio.Future[None]]] = []
        self._writer: asyncio.Task[None] | None = None

    @cached_property
    def _overlay(self) -> Mapping[str, Entry]:
        return self._read_overlay() if self._read_overlay else {}

    def get(self, key: str) -> Entry | None:
        """The entry of a call key."""
        text = self._disk.get(key)
        return self._overlay.get(key) if text is None else Entry.from_json(text)

    async def put(self, entry: Entry) -> None:
        """Keep an entry; returns when it is durable."""
        done = asyncio.get_running_loop().create_future()
        self._pending.append((entry, done))
        if self._writer is None:
            self._writer = asyncio.create_task(self._write_pending())
        await done

    def put_now(self, entries: Iterable[Entry]) -> None:
        """Keep entries in one transaction, in this thread."""
        with self._disk.transact(retry=True):
            for entry in entries:
                self._disk.set(entry.request.key, entry.to_json())
                self._note_endpoint(entry.request)

    def entries(self) -> Iterator[Entry]:
        """All entries, of the folder and of the overlay."""
        for key in self._disk:
            if not key.startswith(_ENDPOINTS):
                yield Entry.from_json(self._disk[key])
        yield from self._overlay.values()

    def recorded_endpoints(self, model: str) -> list[str]:
        """The endpoint identities of a model's replies: the folder's, else the recording's."""
        on_disk = json.loads(self._disk.get(_ENDPOINTS + model) or "[]")
        requests = (entry.request for entry in self._overlay.values())
        return on_disk or sorted({r.endpoint for r in requests if r.model == model})

    def close(self) -> None:
        """Close the folder."""
        self._disk.close()

    async def _write_pending(self) -> None:
        while self._pending:
            batch, self._pending = self._pending, []
            try:
                await asyncio.to_thread(self.put_now, [entry for entry, _ in batch])
            except (OSError, diskcache.Timeout) as exc:
                failure = UsageError(f"the cache {self.folder} cannot be written: {exc}")
                for _, done in batch:
                    done.set_exception(failure)
            else:
                for _, done in batch:
                    done.set_result(None)
        self._writer = None

    def _note_endpoint(self, request: ChatRequest) -> None:
        name = _ENDPOINTS + request.model
        known = json.loads(self._disk.get(name) or "[]")
        if request.endpoint not in known:
            self._disk.set(name, json.dumps(sorted([*known, request.endpoint])))


def attempt_from(value: dict[str, Any]) -> Attempt:
    """An attempt from its JSON object."""
    return Attempt(**{**value, "usage": Usage(**value["usage"])})
