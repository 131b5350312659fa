"""The files of a download: of a folder, or of a zip that is never unpacked to disk."""

from __future__ import annotations

import os
import stat
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PureWindowsPath

from merge_runner.errors import MergeRunnerError, UsageError
from merge_runner.text_safety import one_line

MAX_FILE_BYTES = 64 * 2**20
MAX_TOTAL_BYTES = 4 * 2**30
# A zip shrinks recorded numbers to about a third, but one line repeated over and over to a
# hundredth.
MAX_RATIO = 200
ENCRYPTED = 0x1
PAGE = ".html"
DAMAGED = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, NotImplementedError, OSError,
           OverflowError, ValueError)  # fmt: skip


class Unreadable(MergeRunnerError):
    """A file holds no trial that can be imported; the message says why."""


@dataclass(frozen=True, slots=True)
class File:
    """One file: its path within the download, its size and its share of a zip, in bytes.

    ``read`` returns the whole content; raises Unreadable.
    """

    name: str
    size: int
    packed_size: int
    read: Callable[[], bytes]


@contextmanager
def open_files(path: Path) -> Iterator[list[File]]:
    """All files of a folder and those below it, of a zip, or a page; raises UsageError."""
    if path.is_dir():
        yield list(_files_below(path))
    elif path.is_file() and path.suffix.lower() == PAGE:
        yield [_file(path, path.name)]
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
            _refuse_paths_outside(path, archive.infolist())
            yield [_member(archive, member) for member in archive.infolist() if not member.is_dir()]


def refuse_bombs(files: Iterable[File]) -> None:
    """Raise UsageError where a zip declares sizes that recordings cannot have."""
    total = 0
    for file in files:
        total += file.size
        if file.size > MAX_FILE_BYTES:
            what = f"{file.name} has {file.size} bytes unpacked"
        elif file.size > MAX_RATIO * file.packed_size:
            what = f"{file.name} unpacks from {file.packed_size} to {file.size} bytes"
        elif total > MAX_TOTAL_BYTES:
            what = f"the trials have more than {MAX_TOTAL_BYTES} bytes unpacked"
        else:
            continue
        raise UsageError(f"{what}, which recordings never have: download the zip again")


def _files_below(folder: Path) -> Iterator[File]:
    def refuse(error: OSError) -> None:
        raise UsageError(f"{error.filename} cannot be read: {error.strerror}") from error

    for parent, _, names in os.walk(folder, onerror=refuse):
        for name in names:
            path = Path(parent, name)
            yield _file(path, str(path.relative_to(folder)))


def _file(path: Path, name: str) -> File:
    size = path.stat().st_size if path.is_file() else 0
    return File(one_line(name), size, size, partial(_read_file, path))


def _read_file(path: Path) -> bytes:
    if path.exists() and not path.is_file():
        raise Unreadable("it is not a regular file")  # reading a device or a pipe might never end
    try:
        return path.read_bytes()
    except OSError as exc:
        raise Unreadable(f"it cannot be read: {exc.strerror}") from exc


def _refuse_paths_outside(path: Path, members: list[zipfile.ZipInfo]) -> None:
    """Raise UsageError for paths out of the zip: harmless here, but such a zip is an attack."""
    for member in members:
        name = PureWindowsPath(member.orig_filename)
        if name.anchor or ".." in name.parts:
            raise UsageError(
                f"{path} is unsafe: its member {member.orig_filename!r} leads out of the folder; "
                "download it again from the source"
            )


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> File:
    def read() -> bytes:
        if member.flag_bits & ENCRYPTED:
            raise Unreadable("it is encrypted: unpack the zip and import the folder")
        if stat.S_ISLNK(member.external_attr >> 16):
            raise Unreadable("it is a link, not a file")
        # Only these two methods can be unpacked in parts of a limited size.
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise Unreadable("its compression is not deflate: unpack the zip, import the folder")
        try:
            with archive.open(member) as stream:
                content = stream.read(member.file_size)
        except DAMAGED as exc:
            raise Unreadable(f"it is damaged in the zip: {exc}") from exc
        if len(content) != member.file_size:
            raise Unreadable("it is damaged in the zip: it is shorter than declared")
        return content

    name = one_line(member.filename.replace("\\", "/"))
    return File(name, member.file_size, member.compress_size, read)
