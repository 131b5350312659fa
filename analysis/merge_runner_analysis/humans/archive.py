"""The files of a download: of a folder, or of a zip that is never unpacked to disk."""

from __future__ import annotations

import os
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath

from merge_runner.errors import MergeRunnerError, UsageError
from merge_runner.text_safety import one_line

MAX_FILE_BYTES = 64 * 2**20
MAX_TOTAL_BYTES = 4 * 2**30
# Only these two can be unpacked in parts of a limited size.
COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
# RuntimeError: a member is encrypted, or packed by a newer method.
DAMAGED = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, RuntimeError, OSError,
           OverflowError, ValueError)  # fmt: skip


class Unreadable(MergeRunnerError):
    """A file holds no trial that can be imported; the message says why."""


@dataclass(frozen=True, slots=True)
class File:
    """One file: its path within the download, its declared size in bytes, and how it is read."""

    name: str
    size: int
    content: Callable[[], bytes]

    def read(self) -> bytes:
        """Return the whole content; raises Unreadable."""
        try:
            content = self.content()
        except DAMAGED as exc:
            raise Unreadable(f"it is damaged or cannot be read: {exc}") from exc
        if len(content) != self.size:
            raise Unreadable("it is damaged: it is shorter than declared")
        return content


@contextmanager
def open_files(path: Path) -> Iterator[list[File]]:
    """Yield all files of a folder and those below it, or of a zip; raises UsageError."""
    if path.is_dir():
        yield list(_files_below(path))
    elif not path.exists():
        raise UsageError(f"there is no {path}: name the downloaded zip, or the folder of its files")
    else:
        try:
            archive = zipfile.ZipFile(path)
        except DAMAGED as exc:
            raise UsageError(
                f"{path} is neither a folder nor a whole zip ({exc}): download it again"
            ) from exc
        with archive:
            members = [_member(path, archive, member) for member in archive.infolist()]
            yield [file for file in members if not file.name.endswith("/")]


def check_sizes(files: Iterable[File]) -> None:
    """Raise UsageError where a zip declares sizes that recordings cannot have."""
    total = 0
    for file in files:
        total += file.size
        if file.size > MAX_FILE_BYTES or total > MAX_TOTAL_BYTES:
            raise UsageError(
                f"{file.name} has {file.size} bytes unpacked, and the files up to it have {total}, "
                "which recordings never have: download the zip again"
            )


def _files_below(folder: Path) -> Iterator[File]:
    def refuse(error: OSError) -> None:
        raise UsageError(f"{error.filename} cannot be read: {error.strerror}") from error

    for parent, _, names in os.walk(folder, onerror=refuse):
        for path in (Path(parent, name) for name in names):
            yield _file(path, str(path.relative_to(folder)))


def _file(path: Path, name: str) -> File:
    def content() -> bytes:
        if path.exists() and not path.is_file():
            raise Unreadable("it is not a regular file")  # a device or a pipe might never end
        return path.read_bytes()

    return File(one_line(name), path.stat().st_size if path.is_file() else 0, content)


def _member(path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> File:
    """Return a file of a zip; raises UsageError for a path out of its folder, an attack."""
    inside = PureWindowsPath(member.orig_filename)
    if inside.anchor or ".." in inside.parts:
        raise UsageError(
            f"{path} is unsafe: its member {member.orig_filename!r} leads out of the folder; "
            "download it again from the source"
        )

    def content() -> bytes:
        if member.compress_type not in COMPRESSIONS:
            raise Unreadable("its compression is not deflate: unpack the zip, import the folder")
        with archive.open(member) as stream:
            return stream.read(member.file_size)

    return File(one_line(member.filename.replace("\\", "/")), member.file_size, content)
