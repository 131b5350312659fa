"""Trial files: what is read of them, and what makes one unreadable."""

import pytest

from merge_runner_analysis.humans.archive import Unreadable
from merge_runner_analysis.humans.record import NEEDED, parse_csv
from tests.support.recordings import drive


def test_a_trace_holds_what_was_recorded_to_the_last_bit():
    recording = drive("L_2_-8")
    recording.columns = {name: recording.columns[name] for name in NEEDED}  # others may be missing
    trace = parse_csv(recording.csv())
    assert (trace.step_s, trace.end_state) == (0.05, "Finished")
    for side in ("left", "right"):
        assert trace.positions_m[side] == recording.columns[f"travelled_distance.{side}"]
        assert trace.velocities_mps[side] == recording.columns[f"velocities.{side}"]


@pytest.mark.parametrize(
    ("name", "row", "value", "says"),
    [
        *(
            (name, 17, value, rf"^{name} is .*{value}.* in row 17, not a finite number")
            for name in ("travelled_distance.left", "velocities.right")
            for value in (float("nan"), float("inf"))
        ),
        ("velocities.left", 3, "", "velocities.left is nan in row 3"),
        ("velocities.left", 3, "fast", "convert string to float: 'fast'"),
        ("dt", 0, 0, r"^dt is "),
        ("dt", 0, -50, r"^dt is "),
        ("dt", 0, float("nan"), r"^dt is "),
    ],
)
def test_a_value_that_is_no_finite_number_or_no_step_is_named(name, row, value, says):
    recording = drive()
    recording.columns[name][row] = value
    with pytest.raises(Unreadable, match=says):
        parse_csv(recording.csv())


def test_missing_columns_and_one_that_ends_before_the_others_are_named():
    recording = drive()
    del recording.columns["velocities.left"][-1]
    with pytest.raises(Unreadable, match=r"velocities\.left is nan in row"):
        parse_csv(recording.csv())
    for name in ("dt", "velocities.left"):
        del recording.columns[name]
    with pytest.raises(Unreadable, match=r"^it lacks dt, velocities\.left$"):
        parse_csv(recording.csv())


CUT_OFF = b"".join(drive().csv().splitlines(keepends=True)[:100])


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (CUT_OFF + b"1.5,\r\n", "is nan in row 99"),
        (CUT_OFF + b'"[1.0, 2.0', "EOF inside string"),
        (b"", "not the CSV table"),
        (b"\xff\xfe\x00", "not the CSV"),
        (b"\x00" * 10, "it lacks dt"),
    ],
)
def test_what_is_cut_off_or_no_csv_table_is_refused(content, says):
    with pytest.raises(Unreadable, match=says):
        parse_csv(content)


def test_blank_lines_and_a_byte_order_mark_do_not_matter():
    content = drive().csv()
    assert parse_csv(b"\xef\xbb\xbf" + content + b"\r\n\r\n") == parse_csv(content)
