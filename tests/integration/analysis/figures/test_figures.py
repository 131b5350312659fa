"""The figures: their data, their sizes, and that equal results give equal files."""

import re
from dataclasses import replace
from itertools import combinations

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from merge_runner.scenarios.merge.conditions import CONDITIONS, HUMAN_CONDITIONS
from merge_runner_analysis.figures.figure2 import (
    HUMAN_VELOCITIES_MPS,
    deviation,
    gap,
    left_first,
    left_traces,
    points,
    published_gap_line,
)
from merge_runner_analysis.figures.gallery import MAKERS, rendered
from merge_runner_analysis.figures.style import SETTINGS
from merge_runner_analysis.frames import load
from merge_runner_analysis.stats.intervals import mean, proportion
from merge_runner_analysis.study import StudyResults
from tests.support.studies import Drive, changed, write_study, yielding
from tests.support.tables import values_of


def test_panels_show_each_condition_of_a_relative_velocity_once_with_its_trials(study):
    group = study.models[0]
    shown = {
        summary: {
            (velocity, x): estimate
            for velocity in HUMAN_VELOCITIES_MPS
            for x, estimate in points(group, velocity, summary)
        }
        for summary in (left_first, gap, deviation)
    }
    places = {(c.relative_velocity_mps, c.projected_headway_m): n for n, c in CONDITIONS.items()}
    assert set(shown[left_first]) == set(places)
    for at, name in places.items():
        trials = group.finished[group.finished["condition"] == name]
        first = int((trials["merged_first"] == "left").sum())
        assert shown[left_first][at] == proportion(first, len(trials))
        assert shown[gap][at] == mean(trials["gap_m"])
        # Both vehicles of a conflict are correlated: a trial is one value.
        rmse = mean(trials["rmse_mps"])
        assert shown[deviation][at] == replace(rmse, low=max(0.0, rmse.low))


def test_traces_are_those_of_the_left_vehicle_that_merges_first_or_second(study):
    group = study.models[0]
    for first in ("left", "right"):
        rows = load(
            "SELECT list(velocity_mps ORDER BY step) v FROM states JOIN trials "
            "USING (trial_id, spec_hash) WHERE side = 'left' AND status = 'finished' AND "
            f"spec_hash = 'o3-baseline' AND merged_first = '{first}' GROUP BY trial_id",
            study.db,
        )
        found = [
            t for at, some in left_traces(study, group).items() for t in some if at[0] == first
        ]
        assert sorted(tuple(trace[:, 1]) for trace in found) == sorted(tuple(v) for v in rows["v"])
        assert all(trace[0, 0] == 0 for trace in found)


OWN = (
    "UPDATE trials SET condition = 'own_' || rep, projected_headway_m = 8, "
    "relative_velocity_mps = 10 + rep WHERE condition = 'L_4_8'"
)


def marks(axis):
    """The lines of estimates in a panel: intervals and ticks are others."""
    return [line for line in axis.lines if line.get_markerfacecolor() == "white"]


def drawn(study, name="figure2"):
    """The panels of Figure 2, by row, and its legend."""
    with mpl.rc_context(SETTINGS):
        figure = MAKERS[name](study)
    rows = [figure.axes[i : i + 5] for i in range(0, len(figure.axes), 5)]
    return rows, figure.legends[0].legend_handles


def dashed(axis):
    return sum(line.get_linestyle() == "--" for line in axis.lines)


def ticks(rows):
    return {tuple(axis.get_xticks()) for row in rows for axis in row[2:]}


def test_conditions_that_no_human_drove_have_no_human_line_and_their_own_look(tmp_path):
    drives = [d for d in yielding("o3", reps=7) if d.rep == 1 or d.condition == "L_4_8"]
    study = StudyResults(write_study(tmp_path / "t.duckdb", drives))
    assert ticks(drawn(study)[0]) == {(-4, 0, 4)}
    rows, keys = drawn(changed(study.db, OWN))
    assert dashed(rows[0][3]) == 3
    assert ticks(rows) == {(-8, 0, 8)}
    # Seven velocities that no human drove, and how humans are shown.
    assert len({(key.get_color(), key.get_marker()) for key in keys[:-2]}) == len(keys) - 2 == 3 + 7
    headways, gaps = published_gap_line(0)
    assert headways[[0, -1]] == pytest.approx([-4, 4])
    assert gaps[[40, -1]] == pytest.approx([3.54, 3.54 + 4 * 0.17])


def test_conditions_that_were_not_played_are_not_drawn(tmp_path):
    drives = [d for d in yielding(r"a$\b$", reps=1) if d.condition in {"N_0_0", "L_4_0"}]
    study = StudyResults(write_study(tmp_path / "t.duckdb", drives))
    assert {*study.conditions} == {"N_0_0", "L_4_0"}
    (human, _), keys = drawn(study)
    assert len(keys) == 1 + 2, "one relative velocity, and how humans are shown"
    assert sorted({round(x) for line in marks(human[2]) for x in line.get_xdata()}) == [0, 4]
    assert rendered(study, "figure2", "svg").startswith(b"<?xml"), "a dollar is no formula"
    humans = StudyResults(write_study(tmp_path / "h.duckdb", []))
    assert {*humans.conditions} == {*HUMAN_CONDITIONS}


LONG = "gemini-2.5-pro-preview-05-06+constant"


@pytest.fixture(scope="module")
def long_names(tmp_path_factory):
    """A model with a long name, at an endpoint of its own, for which mock models answered too."""
    drives = [
        *yielding(LONG, reps=2)[:4],
        *yielding(LONG, "A2", reps=2)[:4],
        *yielding("o3", "A7", 1),
        *yielding("o3", reps=1),
        *yielding("other", "A1", reps=1),
    ]
    path = write_study(tmp_path_factory.mktemp("long") / "t.duckdb", drives)
    return changed(path, "UPDATE trials SET scripted = trial_id NOT LIKE 'o3/%'")


def written_words(figure):
    """The texts of a figure that hold words, with the boxes that they fill."""
    figure.draw_without_rendering()
    return {
        text: text.get_window_extent()
        for text in figure.findobj(Text)
        if text.get_visible() and re.search("[a-z]{2}", text.get_text())
    }


@pytest.mark.parametrize("name", MAKERS)
def test_no_name_is_cut_or_hidden_and_stand_ins_are_named(name, long_names):
    with mpl.rc_context(SETTINGS):
        figure = MAKERS[name](long_names)
        words = written_words(figure)
    for text, box in words.items():
        whole = Bbox.union([figure.bbox, box]).bounds
        assert whole == pytest.approx(figure.bbox.bounds, abs=1), text
    for (one, box), (other, another) in combinations(words.items(), 2):
        assert not box.padded(-1).overlaps(another.padded(-1)), (one, other)
    texts = [text.get_text().replace("\n", " ") for text in figure.findobj(Text)]
    shown = {text.replace("+ ", "+").replace("- ", "-") for text in texts}
    marked = [text for text in shown if "mock model, not" in text]
    assert any(LONG in text for text in marked)
    assert not any("o3" in text and "not o3" in text for text in shown)
    if name not in {"figure2", "first-action"}:  # these show baselines alone
        # A prompt is a line of its own beside the marks of drivers.
        prompts = shown if name == "effects" else marked
        assert any("A2" in text for text in prompts)
        assert any("A1" in text for text in prompts)
        assert any("A7" in text and ("o3" in text or name == "effects") for text in shown)


def test_each_group_has_a_row_of_its_own_by_the_same_scales(study):
    rows, _ = drawn(study, "figure2-variants")
    assert len(rows) == len(study.groups) == 5
    for row in rows:
        assert row[0].get_ylim() == row[1].get_ylim()
        assert [axis.get_ylim() for axis in row] == [axis.get_ylim() for axis in rows[0]]
    for group, row in zip(study.groups[1:], rows[1:], strict=True):
        firsts = group.finished["merged_first"].value_counts()
        for axis, side in zip(row[:2], ("left", "right"), strict=True):
            assert sum(len(c.get_segments()) for c in axis.collections[:3]) == firsts[side]
        for axis, summary in zip(row[2:], (left_first, gap, deviation), strict=True):
            for index, velocity in enumerate(HUMAN_VELOCITIES_MPS):
                found = points(group, velocity, summary)
                line = marks(axis)[index]
                assert list(line.get_ydata()) == [estimate.value for _, estimate in found]
                ends = axis.lines[axis.lines.index(line) - 1].get_ydata()
                known = [end for _, one in found for end in (one.low, one.high) if end is not None]
                assert list(ends[~np.isnan(ends)]) == known
                assert line.get_xdata() == pytest.approx([x + 0.3 * (index - 1) for x, _ in found])
    human = rows[0]
    missing = [any("not imported" in t.get_text() for t in axis.texts) for axis in human]
    assert missing == [True, True, False, False, True]
    assert dashed(human[3]) == 3
    assert sum(len(line.get_xdata()) for line in marks(human[2])) == len(CONDITIONS)


@pytest.mark.parametrize(
    "drives", [[], [yielding("o3", "A1", reps=1)[0], Drive("crash", "A1", "N_0_0", 1, (0,), (0,))]]
)
def test_figures_of_next_to_nothing_are_drawn_all_the_same(drives, tmp_path, recwarn):
    study = StudyResults(write_study(tmp_path / "t.duckdb", drives))
    for draw in MAKERS.values():
        draw(study).draw_without_rendering()
    assert [str(w.message) for w in recwarn.list] == []


def test_the_axis_of_speed_deviation_begins_at_0_where_two_trials_make_wide_intervals(tmp_path):
    drives = [d for d in yielding("o3", reps=2) if d.condition in {"N_0_0", "L_4_0"}]
    drives = [
        replace(d, right=tuple(0.2 * x for x in d.right)) if d.rep == 2 else d for d in drives
    ]
    study = StudyResults(write_study(tmp_path / "t.duckdb", drives))
    wide = mean(study.models[0].finished.query("condition == 'N_0_0'")["rmse_mps"])
    assert wide.low < 0
    rows, _ = drawn(study)
    low, high = rows[1][4].get_ylim()
    assert low >= 0
    assert high < 2 * study.models[0].finished["rmse_mps"].max()


def test_levels_are_drawn_as_the_table_of_effects_has_them(tmp_path):
    drives = [*yielding("o3", reps=2), *yielding("o3", "A1", 2), *yielding("o1", reps=2)]
    study = StudyResults(write_study(tmp_path / "t.duckdb", drives))
    panels = {axis.get_xlabel(): axis for axis in MAKERS["effects"](study).axes}
    first, *_ = panels.values()
    lines = [text.get_text() for text in first.get_yticklabels()]
    assert lines == ["prompt: baseline", "prompt: A1"]
    rows = values_of(study, "factors")
    drawn_m = {round(float(x), 6) for line in panels["gap (m)"].lines for x in line.get_xdata()}
    assert round(rows["prompt=A1/gap_m"]["value"], 6) in drawn_m
    assert panels["joint (%)"].get_xlim()[1] < 103
