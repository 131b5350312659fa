"""Folders and zips: read in memory, and refused where they are damaged or made to harm."""

import struct
import zipfile

import pytest

from merge_runner.errors import UsageError
from merge_runner_analysis.humans import archive
from merge_runner_analysis.humans.archive import Unreadable, check_sizes, open_files
from tests.support.recordings import file, write_folder, write_zip

FILES = {"a/experiment_4_iter_1.csv": b"first" * 50, "b/c/experiment_4_iter_2.csv": b"second"}


def patched(path, signature, offset, layout, value):
    """Change a field of the zip's first record of this kind."""
    content = bytearray(path.read_bytes())
    struct.pack_into(layout, content, content.index(signature) + offset, value)
    path.write_bytes(content)
    return path


def unreadable(path, says):
    with open_files(path) as files, pytest.raises(Unreadable, match=says):
        files[0].read()


def test_a_folder_and_a_zip_of_it_hold_the_same_files(tmp_path):
    for path in (write_folder(tmp_path / "d", FILES), write_zip(tmp_path / "d.zip", FILES)):
        with open_files(path) as files:
            assert {f.name: (f.size, f.read()) for f in files} == {
                name: (len(content), content) for name, content in FILES.items()
            }


@pytest.mark.parametrize(
    ("member", "name"),
    [("a\\experiment_4_iter_1.csv", "a/experiment_4_iter_1.csv"), ("a..b/x...csv", "a..b/x...csv")],
)
def test_names_of_windows_and_dots_within_a_name_are_safe(tmp_path, member, name):
    with open_files(write_zip(tmp_path / "d.zip", {member: b"x"})) as files:
        assert [found.name for found in files] == [name]


def test_a_path_that_is_not_there_or_no_zip_is_refused(tmp_path):
    with pytest.raises(UsageError, match="there is no "), open_files(tmp_path / "nowhere"):
        pass
    whole = write_zip(tmp_path / "d.zip", FILES).read_bytes()
    for content in (b"", b"no zip", whole[:-30]):
        (tmp_path / "d.zip").write_bytes(content)
        with pytest.raises(UsageError, match="a whole zip"), open_files(tmp_path / "d.zip"):
            pass


@pytest.mark.parametrize(
    "name",
    ["../x.csv", "a/../../x.csv", "/etc/x.csv", "..\\x.csv", "C:\\x.csv", "c:x.csv", "\\\\s\\x"],
)
def test_a_name_that_leads_out_of_the_folder_is_refused_before_anything_is_read(tmp_path, name):
    path = write_zip(tmp_path / "d.zip", {**FILES, name: b"x"})
    with pytest.raises(UsageError, match="is unsafe: its member"), open_files(path):
        pass


@pytest.mark.parametrize("compression", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_a_damaged_member_is_unreadable_and_the_others_are_not(tmp_path, compression):
    path = write_zip(tmp_path / "d.zip", FILES, compression)
    name = next(iter(FILES)).encode()
    patched(path, name, len(name) + 2, "B", 0x55)
    unreadable(path, "it is damaged")
    with open_files(path) as files:
        assert files[1].read() == b"second"


@pytest.mark.parametrize(
    ("field", "says"),
    [
        ((24, "<I", 249), "it is damaged"),  # shorter than it is
        ((24, "<I", 251), "it is damaged"),
        ((8, "<H", 1), "is encrypted"),
    ],
)
def test_a_member_that_is_not_what_the_zip_declares_is_unreadable(tmp_path, field, says):
    unreadable(patched(write_zip(tmp_path / "d.zip", FILES), b"PK\1\2", *field), says)


def test_no_more_is_unpacked_than_declared(tmp_path, monkeypatch):
    path = write_zip(tmp_path / "d.zip", {"experiment_4_iter_1.csv": bytes(2**20)})
    patched(path, b"PK\1\2", 24, "<I", 10_000)
    asked = []
    read = zipfile.ZipExtFile.read
    monkeypatch.setattr(
        zipfile.ZipExtFile, "read", lambda self, n=-1: asked.append(n) or read(self, n)
    )
    unreadable(path, "it is damaged")
    assert asked == [10_000]


@pytest.mark.parametrize("compression", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_compression_that_cannot_be_bounded_is_not_unpacked(tmp_path, compression):
    unreadable(write_zip(tmp_path / "d.zip", FILES, compression), "is not deflate")


def test_a_bomb_is_refused_by_its_declared_sizes():
    check_sizes([file("small", bytes(1000)), file("empty", b"")])
    huge = archive.File("x.csv", archive.MAX_FILE_BYTES + 1, bytes)
    with pytest.raises(UsageError, match=r"x\.csv has 67108865 bytes unpacked"):
        check_sizes([huge])
    big = archive.File("x.csv", archive.MAX_FILE_BYTES, bytes)
    check_sizes([big] * 64)
    with pytest.raises(UsageError, match="files up to it have 4362076160"):
        check_sizes([big] * 65)


def test_a_file_that_cannot_be_read_says_why(tmp_path):
    (tmp_path / "experiment_4_iter_1.csv").symlink_to(tmp_path / "gone")
    unreadable(tmp_path, "No such file")
