"""The figures: their data, their sizes, and that equal results give equal files."""

from __future__ import annotations

import re
import struct
from itertools import combinations

import duckdb
import matplotlib as mpl
import pytest
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from merge_runner.errors import UsageError
from merge_runner.scenarios.merge.conditions import CONDITIONS, HUMAN_CONDITIONS
from merge_runner_analysis.data.load import load
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.figures.figure_2 import (
    HUMAN_VELOCITIES_MPS,
    PAGE_IN,
    deviation,
    gap,
    left_first,
    left_traces,
    points,
    published_gap_line,
)
from merge_runner_analysis.figures.gallery import MAKERS, SETTINGS, rendered, write_figures
from merge_runner_analysis.stats.intervals import mean, proportion
from tests.support.studies import Drive, changed, write_study, yielding


@pytest.fixture(scope="module")
def written(small, tmp_path_factory):
    """A folder with all figures."""
    folder = tmp_path_factory.mktemp("figures")
    list(write_figures(small, folder))
    return folder


@pytest.mark.long
def test_equal_results_give_equal_files(small, written):
    again = Study(small.db)
    for name, form in (("figure2", "pdf"), ("first-action", "png")):
        assert rendered(again, name, form) == (written / f"{name}.{form}").read_bytes()
    assert rendered(again, "figure2", "svg") == rendered(small, "figure2", "svg")


def test_figures_are_written_as_vector_pdf_and_as_png_of_page_width(written):
    assert {p.name for p in written.iterdir()} == {
        f"{n}.{e}" for n in MAKERS for e in ("pdf", "png")
    }
    pdf = (written / "figure2.pdf").read_bytes()
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", pdf)
    assert float(box[1]) == pytest.approx(72 * PAGE_IN, abs=0.5)
    assert b"/Type /Font" in pdf, "text stays text"
    width, _ = struct.unpack(">II", (written / "figure2.png").read_bytes()[16:24])
    assert width == round(300 * PAGE_IN)


def test_a_folder_that_cannot_be_made_is_said(small, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match="cannot be made"):
        list(write_figures(small, tmp_path / "file"))


def test_panels_show_each_condition_of_a_relative_velocity_once_with_its_trials(study):
    group = study.models[0]
    firsts = {
        (velocity, x): estimate
        for velocity in HUMAN_VELOCITIES_MPS
        for x, estimate in points(group, velocity, left_first)
    }
    assert set(firsts) == {
        (c.relative_velocity_mps, c.projected_headway_m) for c in CONDITIONS.values()
    }
    for name, condition in CONDITIONS.items():
        trials = group.finished[group.finished["condition"] == name]
        found = firsts[condition.relative_velocity_mps, condition.projected_headway_m]
        assert found == proportion(int((trials["merged_first"] == "left").sum()), len(trials))
        (mean_gap,) = [
            estimate
            for x, estimate in points(group, condition.relative_velocity_mps, gap)
            if x == condition.projected_headway_m
        ]
        assert mean_gap == mean(trials["gap_m"])
        (deviations,) = [
            estimate
            for x, estimate in points(group, condition.relative_velocity_mps, deviation)
            if x == condition.projected_headway_m
        ]
        # Both vehicles of a conflict are correlated: a trial is one value.
        assert deviations == mean(trials["rmse_mps"])


def test_traces_are_those_of_the_left_vehicle_that_merges_first_or_second(study):
    group = study.models[0]
    for first in ("left", "right"):
        rows = load(
            "SELECT list(velocity_mps ORDER BY step) v FROM states JOIN trials "
            "USING (trial_id, spec_hash) WHERE side = 'left' AND status = 'finished' AND "
            f"spec_hash = 'o3-baseline' AND merged_first = '{first}' GROUP BY trial_id",
            study.db,
        )
        found = [t for traces in left_traces(study, group, first).values() for t in traces]
        assert sorted(tuple(trace[:, 1]) for trace in found) == sorted(tuple(v) for v in rows["v"])
        assert all(trace[0, 0] == 0 for trace in found)


OWN = (
    "UPDATE trials SET condition = 'own_' || rep, projected_headway_m = 8, "
    "relative_velocity_mps = 10 + rep WHERE condition = 'L_4_8'"
)


def drawn(study, name="figure2"):
    """The panels of Figure 2, by row, and its legend."""
    figure = MAKERS[name](study)
    rows = [figure.axes[i : i + 5] for i in range(0, len(figure.axes), 5)]
    return rows, figure.legends[0].legend_handles


def test_where_no_human_drove_no_human_line_is_drawn(tmp_path):
    study = changed(write_study(tmp_path / "t.duckdb", yielding("o3", reps=1)), OWN)
    (human, _), keys = drawn(study)
    assert len(keys) == 4 + 2, "a velocity that no human drove, and how humans are shown"
    assert sum(line.get_linestyle() == "--" for line in human[3].lines) == 3


def test_conditions_that_were_not_played_are_not_drawn(tmp_path):
    drives = [d for d in yielding("o3", reps=1) if d.condition in {"N_0_0", "L_4_0"}]
    study = Study(write_study(tmp_path / "t.duckdb", drives))
    assert {*study.conditions} == {"N_0_0", "L_4_0"}
    (human, _), keys = drawn(study)
    assert len(keys) == 1 + 2, "one relative velocity, and how humans are shown"
    assert sorted({round(x) for line in human[2].lines for x in line.get_xdata()}) == [0, 4]
    humans = Study(write_study(tmp_path / "h.duckdb", []))
    assert {*humans.conditions} == {*HUMAN_CONDITIONS}


@pytest.mark.slow
def test_panels_reach_as_far_as_the_conditions_and_the_published_line_as_the_humans(tmp_path):
    db = write_study(tmp_path / "t.duckdb", yielding("o3", reps=1))
    for study, farthest in ((Study(db), 4), (changed(db, OWN), 8)):
        for row in drawn(study)[0]:
            assert [list(axis.get_xticks()) for axis in row[2:]] == [[-farthest, 0, farthest]] * 3
    headways, gaps = published_gap_line(0)
    assert headways[[0, -1]] == pytest.approx([-4, 4])
    assert gaps[[40, -1]] == pytest.approx([3.54, 3.54 + 4 * 0.17])


@pytest.mark.slow
def test_no_two_relative_velocities_look_alike(tmp_path):
    study = changed(write_study(tmp_path / "t.duckdb", yielding("o3", reps=7)), OWN)
    keys = drawn(study)[1][:-2]
    assert len(keys) == len({(key.get_color(), key.get_marker()) for key in keys}) == 3 + 7


def test_a_dollar_in_a_name_is_no_formula(tmp_path):
    study = Study(write_study(tmp_path / "t.duckdb", yielding(r"a$\b$", reps=1)[:2]))
    assert rendered(study, "figure2", "svg")


BASELINES = {"figure2", "first-action"}
LONG = "gemini-2.5-pro-preview-05-06+constant"


@pytest.fixture(scope="module")
def long_names(tmp_path_factory):
    """A model with a long name, at an endpoint of its own, in whose name stand-ins answered too."""
    drives = [
        *yielding(LONG, reps=2)[:4],
        *yielding(LONG, "A2", reps=2)[:4],
        *yielding("o3", "A7", 1),
        *yielding("o3", reps=1),
        *yielding("other", "A1", reps=1),
    ]
    path = write_study(tmp_path_factory.mktemp("long") / "t.duckdb", drives)
    with duckdb.connect(str(path)) as connection:
        connection.execute("UPDATE trials SET scripted = trial_id NOT LIKE 'o3/%'")
    return Study(path)


def written_words(figure):
    """The texts of a figure that hold words, with the boxes that they fill."""
    figure.draw_without_rendering()
    return {
        text: text.get_window_extent()
        for text in figure.findobj(Text)
        if text.get_visible() and re.search("[a-z]{2}", text.get_text())
    }


@pytest.mark.parametrize("name", MAKERS)
def test_no_name_is_cut_and_none_lies_over_another(name, long_names):
    with mpl.rc_context(SETTINGS):
        figure = MAKERS[name](long_names)
        words = written_words(figure)
    for text, box in words.items():
        assert Bbox.union([figure.bbox, box]).bounds == pytest.approx(figure.bbox.bounds, abs=1), (
            text
        )
    for (one, box), (other, another) in combinations(words.items(), 2):
        assert not box.padded(-1).overlaps(another.padded(-1)), (one, other)


@pytest.mark.parametrize("name", MAKERS)
def test_every_figure_says_who_is_a_stand_in_and_names_its_variant(name, long_names):
    figure = MAKERS[name](long_names)
    texts = [text.get_text().replace("\n", " ") for text in figure.findobj(Text)]
    shown = {text.replace("+ ", "+").replace("- ", "-") for text in texts}
    marked = [text for text in shown if "scripted stand-in, not" in text]
    assert any(LONG in text for text in marked)
    assert not any("o3" in text and "not o3" in text for text in shown)
    if name not in BASELINES:
        assert any("A2" in text for text in marked)
        assert any("A1" in text for text in marked)
        assert any("A7" in text and "o3" in text for text in shown)


@pytest.mark.slow
def test_each_group_has_a_row_of_its_own_with_its_trials(study):
    rows, _ = drawn(study, "figure2-variants")
    assert len(rows) == len(study.groups) == 5
    for group, row in zip(study.groups[1:], rows[1:], strict=True):
        firsts = group.finished["merged_first"].value_counts()
        for axis, side in zip(row[:2], ("left", "right"), strict=True):
            assert sum(len(c.get_segments()) for c in axis.collections[:3]) == firsts[side]
        for axis, summary in zip(row[2:], (left_first, gap, deviation), strict=True):
            for index, velocity in enumerate(HUMAN_VELOCITIES_MPS):
                found = points(group, velocity, summary)
                line = axis.containers[index].lines[0]
                assert list(line.get_ydata()) == [estimate.value for _, estimate in found]
                assert line.get_xdata() == pytest.approx([x + 0.3 * (index - 1) for x, _ in found])


@pytest.mark.slow
def test_variants_are_shown_by_the_same_scales_and_before_an_import_humans_as_published(study):
    rows, _ = drawn(study, "figure2-variants")
    for row in rows:
        assert row[0].get_ylim() == row[1].get_ylim()
        assert [axis.get_ylim() for axis in row] == [axis.get_ylim() for axis in rows[0]]
    human = rows[0]
    assert [any("not imported" in t.get_text() for t in axis.texts) for axis in human] == [
        True, True, False, False, True,
    ]  # fmt: skip
    assert sum(line.get_linestyle() == "--" for line in human[3].lines) == 3
    assert sum(len(c.lines[0].get_xdata()) for c in human[2].containers) == len(CONDITIONS)


@pytest.mark.slow
def test_one_very_wide_interval_leaves_the_others_readable(tmp_path):
    """Two trials of a condition that differ by 10 m have an interval of 130 m."""
    drives = [*yielding("o3", reps=10), *yielding("o3", "A1", reps=4)]
    drives += [
        Drive("o3", "A2", "L_4_0", rep, (strength,) * 3, (-strength,) * 3)
        for rep, strength in enumerate((0.3, 0.7), 1)
    ]
    study = Study(write_study(tmp_path / "t.duckdb", drives))
    low, high = drawn(study, "figure2-variants")[0][0][3].get_ylim()
    found = [
        estimate
        for group in study.groups
        for velocity in HUMAN_VELOCITIES_MPS
        for _, estimate in points(group, velocity, gap)
    ]
    assert max(one.high - one.low for one in found) > 2 * (high - low)
    assert all(low < one.value < high for one in found)
    assert sum(low < one.low and one.high < high for one in found) >= 0.8 * len(found)


@pytest.mark.long
@pytest.mark.parametrize(
    "drives",
    [
        [],
        [Drive("o3", "baseline", "N_0_0", 1, (0.0,), (0.0,))],
        yielding("o3", "A1", reps=1)[:1],
        [Drive("o3", "A1", name, 1, (0.0,), (0.0,)) for name in CONDITIONS],
    ],
)
def test_figures_of_next_to_nothing_are_drawn_all_the_same(drives, tmp_path, recwarn):
    study = Study(write_study(tmp_path / "t.duckdb", drives))
    for draw in MAKERS.values():
        draw(study).draw_without_rendering()
    assert [str(w.message) for w in recwarn.list] == []
