"""The public velocity pages: the trials that the recordings give, told apart, stored once."""

from __future__ import annotations

import numpy as np
import pytest

from merge_runner.results.store import Store, query
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.human.archive import Unreadable
from merge_runner_analysis.human.load import import_trials, sort_files
from merge_runner_analysis.human.record import condition_of, trace_of, trials_of
from tests.support.pages import packed, velocity_page
from tests.support.recordings import drive, file, write_folder

DRIVEN = {
    name: {
        "1-1": drive(name),
        "3-12": drive(name, yields="left"),
        "9-110": drive(name, yields="nobody"),
    }
    for name in HUMAN_CONDITIONS
}
EXPERIMENTS = {"1": 4, "3": 6, "9": 13}


def paper_name(condition):
    return condition.split("_", 1)[1]


def pages(form=list):
    return {
        f"plots/{paper_name(name)}.html": velocity_page(trials, form)
        for name, trials in DRIVEN.items()
    }


def recordings():
    """Those of one condition as the experiment's recorder writes them."""
    return {
        f"experiment_{EXPERIMENTS[label[0]]}_iter_{label[2:]}.csv": recording.csv()
        for label, recording in DRIVEN["L_4_0"].items()
    }


def imported(db, files):
    download = sort_files(file(name, content) for name, content in files.items())
    return import_trials(download, Store(db))


def states(db, condition):
    return query(
        db,
        "SELECT trial_id, step, side, time_s, position_m, velocity_mps, acceleration_mps2 "
        f"FROM states WHERE trial_id LIKE '%/{condition}/%' ORDER BY ALL",
    )[1]


def test_the_pages_are_named_as_in_the_publications():
    assert [condition_of(f"docs/plots/{paper_name(name)}.html") for name in HUMAN_CONDITIONS] == [
        *HUMAN_CONDITIONS
    ]
    assert condition_of("L_4_-8.html") == "L_4_-8"
    assert condition_of("initial_action.html") is None
    assert condition_of("experiment_4_iter_1.csv") is None


@pytest.mark.long
@pytest.mark.parametrize("form", [list, packed])
def test_a_page_gives_the_trials_that_the_recordings_give(tmp_path, form):
    one, other = tmp_path / "pages.duckdb", tmp_path / "recordings.duckdb"
    found = imported(one, pages(form))
    assert (found.added, found.unreadable) == (33, [])
    imported(other, recordings())
    rows = "SELECT trial_id, pair, condition, rep, status, merged_first, end_time_s FROM trials "
    mine = query(one, f"{rows} WHERE condition = 'L_4_0' ORDER BY ALL")[1]
    assert mine == query(other, f"{rows} ORDER BY ALL")[1]
    assert {row[4] for row in mine} == {"finished", "collided"}
    left, right = (np.array([row[3:] for row in states(db, "L_4_0")]) for db in (one, other))
    assert [row[:3] for row in states(one, "L_4_0")] == [row[:3] for row in states(other, "L_4_0")]
    assert np.abs(left - right).max() < 1e-9


@pytest.mark.slow
def test_the_source_of_a_trial_is_told_and_none_is_stored_twice(human, tmp_path):
    folder = write_folder(tmp_path / "both", pages() | recordings())
    run = human("import", folder)
    assert run.code == 0
    # Three of the 33 trials on the pages are in the recordings, too.
    assert run.out.startswith("33 trials added, 3 there already, ")
    assert "30 of 33 trials are of the public velocity pages" in run.err
    assert "30 of 33 trials are of the public velocity pages" in human("status").out
    again = human("import", folder)
    assert again.out.startswith("0 trials added, 36 there already, ")
    study = Study(tmp_path / "results/merge.duckdb")
    assert len(study.human.trials) == 33
    assert any(said.startswith("30 of 33 trials are of the public") for said in study.findings)


@pytest.mark.slow
def test_recordings_after_pages_leave_these_as_they_are(tmp_path):
    db = tmp_path / "t.duckdb"
    imported(db, pages())
    report = imported(db, recordings())
    assert (report.added, report.there, report.differing) == (0, 3, [])


def test_one_page_in_a_folder_is_imported_by_its_name(human, tmp_path):
    write_folder(tmp_path / "pages", {"4_0.html": velocity_page(DRIVEN["L_4_0"])})
    assert human("import", "pages").out.startswith("3 trials added, 0 there already, 0 files")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda traces: traces.pop("right"), "it does not show both vehicles"),
        (lambda traces: traces["left"]["x"].pop(), "it does not show both vehicles"),
        (lambda traces: traces["left"]["x"].__setitem__(3, 0.3), "at equal steps from 0 s on"),
        (lambda traces: traces["left"]["x"].__setitem__(0, 0.05), "at equal steps from 0 s on"),
        (
            lambda traces: (traces["left"]["line"].update(dash="dash"),
                            traces["right"]["line"].update(dash="solid")),
            "its lines are dash and solid, but left is ahead at the end",
        ),
        (lambda traces: traces["left"]["line"].update(dash="dot"), "its lines are dot and dash"),
        (
            lambda traces: [each[axis].__delitem__(slice(120, None)) for each in traces.values()
                            for axis in "xy"],
            "with no vehicle beyond",
        ),
        (lambda traces: traces["left"]["y"].__setitem__(0, 12.0), None),
    ],
)  # fmt: skip
def test_a_trial_that_the_page_does_not_show_whole_says_why(change, says):
    ((_, _, traces),) = trials_of(velocity_page({"1-1": drive("L_4_0")}), "L_4_0")
    change(traces)
    if says is None:
        trace = trace_of(traces, "L_4_0")
        assert trace.velocities_mps["left"][0] == 12.0
        return
    with pytest.raises(Unreadable, match=says):
        trace_of(traces, "L_4_0")


def test_a_page_of_another_condition_is_refused_trial_by_trial(tmp_path):
    report = imported(tmp_path / "t.duckdb", {"4_8.html": velocity_page(DRIVEN["L_4_0"])})
    assert report.added == 0
    assert [name for name, _ in report.unreadable] == [
        "4_8.html: pair1, trial 1",
        "4_8.html: pair3, trial 12",
        "4_8.html: pair9, trial 110",
    ]
    assert report.unreadable[1][1] == "its speeds are not those of L_4_8"
    empty = imported(tmp_path / "t.duckdb", {"4_8.html": b"<html>"})
    assert empty.unreadable == [("4_8.html", "it is no page that Plotly wrote, or is cut off")]
