"""Trial files: what is read of them, and what makes one unreadable."""

from __future__ import annotations

import pytest

from merge_runner_analysis.human.archive import Unreadable
from merge_runner_analysis.human.record import NEEDED, parse_csv
from tests.support.recordings import drive


def test_a_trace_holds_what_was_recorded_to_the_last_bit():
    recording = drive("L_2_-8")
    trace = parse_csv(recording.csv())
    assert trace.step_s == 0.05
    assert trace.end_state == "Finished"
    for side in ("left", "right"):
        assert trace.positions_m[side] == recording.columns[f"travelled_distance.{side}"]
        assert trace.velocities_mps[side] == recording.columns[f"velocities.{side}"]
    assert len(trace.positions_m["left"]) > 200


def test_what_is_not_needed_may_be_missing():
    recording = drive()
    recording.columns = {name: recording.columns[name] for name in NEEDED}
    assert parse_csv(recording.csv()).end_state == "Finished"


def test_missing_columns_are_named():
    recording = drive()
    for name in ("dt", "velocities.left"):
        del recording.columns[name]
    with pytest.raises(Unreadable, match=r"^it lacks dt, velocities\.left$"):
        parse_csv(recording.csv())


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["travelled_distance.left", "velocities.right"])
def test_a_value_that_is_not_finite_is_named_with_its_row(value, name):
    recording = drive()
    recording.columns[name][17] = value
    with pytest.raises(Unreadable, match=rf"^{name} is .*{value}.* in row 17, not a finite number"):
        parse_csv(recording.csv())


@pytest.mark.parametrize("value", ["", "fast"])
def test_a_csv_cell_that_is_no_number_is_named(value):
    recording = drive()
    recording.columns["velocities.left"][3] = value
    says = "velocities.left is nan in row 3" if not value else f"convert string to float: '{value}'"
    with pytest.raises(Unreadable, match=says):
        parse_csv(recording.csv())


@pytest.mark.parametrize("value", [0, -50, float("nan")])
def test_a_step_must_be_positive(value):
    recording = drive()
    recording.columns["dt"] = [value]
    with pytest.raises(Unreadable, match=r"^dt is "):
        parse_csv(recording.csv())


def test_two_rows_are_the_least():
    recording = drive()
    recording.columns = {name: values[:2] for name, values in recording.columns.items()}
    assert parse_csv(recording.csv()).positions_m["left"][0] == 4.0
    recording.columns = {name: values[:1] for name, values in recording.columns.items()}
    with pytest.raises(Unreadable, match="fewer than 2 rows"):
        parse_csv(recording.csv())


def test_a_series_that_ends_before_the_others_is_named():
    recording = drive()
    del recording.columns["velocities.left"][-1]
    with pytest.raises(Unreadable, match=r"velocities\.left is nan in row"):
        parse_csv(recording.csv())


@pytest.mark.parametrize("ending", [b"1.5,\r\n", b'"[1.0, 2.0'])
def test_a_csv_that_is_cut_off_says_so(ending):
    content = drive().csv()
    whole = b"".join(content.splitlines(keepends=True)[:100])
    with pytest.raises(Unreadable, match=r"is nan in row 99|EOF inside string"):
        parse_csv(whole + ending)


@pytest.mark.parametrize(
    ("content", "says"),
    [(b"", "not the CSV table"), (b"\xff\xfe\x00", "not the CSV"), (b"\x00" * 10, "it lacks dt")],
)
def test_what_is_no_csv_table_is_refused(content, says):
    with pytest.raises(Unreadable, match=says):
        parse_csv(content)


def test_blank_lines_and_a_byte_order_mark_do_not_matter():
    content = drive().csv()
    assert parse_csv(b"\xef\xbb\xbf" + content + b"\r\n\r\n") == parse_csv(content)
