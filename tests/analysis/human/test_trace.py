"""Trial files, CSV and MAT: what is read of them, and what makes one unreadable."""

from __future__ import annotations

import random
import struct
import zlib
from contextlib import suppress

import pytest

from analysis.human.archive import Unreadable
from analysis.human.mat import VERSION_5
from analysis.human.trace import NEEDED, parse_csv, parse_mat
from tests.analysis.recordings import Recording, drive

FORMS = {
    "csv": (parse_csv, Recording.csv),
    "mat": (parse_mat, Recording.mat),
    "packed mat": (parse_mat, lambda recording: recording.mat(packed=True)),
}
each_form = pytest.mark.parametrize("form", FORMS)


def read(form, recording):
    parse, write = FORMS[form]
    return parse(write(recording))


@each_form
def test_a_trace_holds_what_was_recorded_to_the_last_bit(form):
    recording = drive("L_2_-8")
    trace = read(form, recording)
    assert trace.step_s == 0.05
    assert trace.end_state == "Finished"
    for side in ("left", "right"):
        assert trace.positions_m[side] == recording.columns[f"travelled_distance.{side}"]
        assert trace.velocities_mps[side] == recording.columns[f"velocities.{side}"]
    assert len(trace.positions_m["left"]) > 200


@each_form
def test_what_is_not_needed_may_be_missing(form):
    recording = drive()
    recording.columns = {name: recording.columns[name] for name in NEEDED}
    assert read(form, recording).end_state == "Finished"


@each_form
def test_missing_columns_are_named(form):
    recording = drive()
    for name in ("dt", "velocities.left"):
        del recording.columns[name]
    with pytest.raises(Unreadable, match=r"^it lacks dt, velocities[._]left$"):
        read(form, recording)


@each_form
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["travelled_distance.left", "velocities.right"])
def test_a_value_that_is_not_finite_is_named_with_its_row(form, value, name):
    recording = drive()
    recording.columns[name][17] = value
    with pytest.raises(Unreadable, match=rf"^{name} is .*{value}.* in row 17, not a finite number"):
        read(form, recording)


@pytest.mark.parametrize("value", ["", "fast"])
def test_a_csv_cell_that_is_no_number_is_named_with_its_row(value):
    recording = drive()
    recording.columns["velocities.left"][3] = value
    with pytest.raises(Unreadable, match=f"velocities.left is '{value}' in row 3"):
        parse_csv(recording.csv())


@each_form
@pytest.mark.parametrize("value", [0, -50, float("nan")])
def test_a_step_must_be_positive(form, value):
    recording = drive()
    recording.columns["dt"] = [value]
    with pytest.raises(Unreadable, match=r"^dt is "):
        read(form, recording)


@each_form
def test_two_rows_are_the_least(form):
    recording = drive()
    recording.columns = {name: values[:2] for name, values in recording.columns.items()}
    assert read(form, recording).positions_m["left"][0] == 4.0
    recording.columns = {name: values[:1] for name, values in recording.columns.items()}
    with pytest.raises(Unreadable, match="fewer than 2 rows"):
        read(form, recording)


def test_series_of_different_lengths_are_refused():
    recording = drive()
    del recording.columns["velocities.left"][-1]
    with pytest.raises(Unreadable, match="series differ in length"):
        parse_mat(recording.mat())
    with pytest.raises(Unreadable, match=r"velocities\.left is '' in row"):
        parse_csv(recording.csv())


@pytest.mark.parametrize("ending", [b"1.5,\r\n", b'"[1.0, 2.0'])
def test_a_csv_that_is_cut_off_says_so(ending):
    content = drive().csv()
    whole = b"".join(content.splitlines(keepends=True)[:100])
    with pytest.raises(Unreadable, match=r"row 99 has 2 of 26 columns|unexpected end of data"):
        parse_csv(whole + ending)


@pytest.mark.parametrize(
    ("content", "says"),
    [(b"", "it lacks dt"), (b"\xff\xfe\x00", "not a CSV table"), (b"\x00" * 10, "it lacks dt")],
)
def test_what_is_no_csv_table_is_refused(content, says):
    with pytest.raises(Unreadable, match=says):
        parse_csv(content)


def test_blank_lines_and_a_byte_order_mark_do_not_matter():
    content = drive().csv()
    assert parse_csv(b"\xef\xbb\xbf" + content + b"\r\n\r\n") == parse_csv(content)


def test_a_mat_file_of_another_version_is_refused():
    content = drive().mat()
    with pytest.raises(Unreadable, match="not a MAT file of version 5"):
        parse_mat(content.replace(VERSION_5, b"\x00\x02IM", 1))
    with pytest.raises(Unreadable, match="not a MAT file of version 5"):
        parse_mat(b"")


def test_a_text_as_matlab_writes_it_is_read():
    content = drive().mat()
    ours = struct.pack("<II", 16, 8) + b"Finished"
    matlabs = struct.pack("<II", 4, 16) + "Finished".encode("utf-16-le")
    before, after = content.split(ours)
    # The matrix around it grows by 8 bytes: its size stands before its flags.
    at = before.rindex(struct.pack("<III", 6, 8, 4)) - 4
    (size,) = struct.unpack_from("<I", before, at)
    before = before[:at] + struct.pack("<I", size + 8) + before[at + 4 :]
    assert parse_mat(before + matlabs + after).end_state == "Finished"


def test_a_mat_file_that_is_cut_off_or_blown_up_is_refused():
    content = drive().mat()
    with pytest.raises(Unreadable, match="damaged: an element is cut off"):
        parse_mat(content[:-100])
    zeros = zlib.compress(bytes(65 * 2**20))
    bomb = content[:128] + struct.pack("<II", 15, len(zeros)) + zeros
    with pytest.raises(Unreadable, match="far too large"):
        parse_mat(bomb)


def test_no_damage_to_a_mat_file_ends_otherwise_than_with_a_reason():
    chance = random.Random(1)
    for packed in (False, True):
        content = drive().mat(packed=packed)
        for _ in range(500):
            damaged = bytearray(content)
            for _ in range(chance.choice((1, 3))):
                damaged[chance.randrange(124, 600)] = chance.randrange(256)
            with suppress(Unreadable):
                parse_mat(bytes(damaged))
