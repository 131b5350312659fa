"""The figures: their data, their sizes, and that equal results give equal files."""

from __future__ import annotations

import re
import struct

import pytest
from studies import Drive, write_study, yielding

from analysis.figures import FIGURES, PAGE_IN, figure_2, rendered, write_figures
from analysis.intervals import mean, proportion
from analysis.load import load
from analysis.panels import VELOCITIES_MPS, deviations, gaps, left_first, left_traces
from analysis.study import Study
from merge_runner.errors import UsageError
from merge_runner.simulator.conditions import CONDITIONS


@pytest.fixture(scope="module")
def written(small, tmp_path_factory):
    """A folder with all figures."""
    folder = tmp_path_factory.mktemp("figures")
    list(write_figures(small, folder))
    return folder


def test_equal_results_give_equal_files(small, written):
    again = Study(small.db)
    for name, form in (("figure2", "pdf"), ("distributions", "png")):
        assert rendered(again, name, form) == (written / f"{name}.{form}").read_bytes()
    assert rendered(again, "figure2", "svg") == rendered(small, "figure2", "svg")


def test_figures_are_written_as_vector_pdf_and_as_png_of_page_width(written):
    assert {p.name for p in written.iterdir()} == {
        f"{n}.{e}" for n in FIGURES for e in ("pdf", "png")
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
    points = {
        (velocity, point.headway_m): point.estimate
        for velocity in VELOCITIES_MPS
        for point in left_first(group, velocity)
    }
    assert set(points) == {
        (c.relative_velocity_mps, c.projected_headway_m) for c in CONDITIONS.values()
    }
    for condition in CONDITIONS.values():
        trials = group.finished[group.finished["condition"] == condition.name]
        found = points[condition.relative_velocity_mps, condition.projected_headway_m]
        assert found == proportion(int((trials["merged_first"] == "left").sum()), len(trials))
        (gap,) = [
            point.estimate
            for point in gaps(group, condition.relative_velocity_mps)
            if point.headway_m == condition.projected_headway_m
        ]
        assert gap == mean(trials["gap_m"])
        (both,) = [
            point.estimate
            for point in deviations(group, condition.relative_velocity_mps)
            if point.headway_m == condition.projected_headway_m
        ]
        assert both.n == 2 * len(trials), "each trial gives two values"
        assert both.value == pytest.approx(trials["rmse_mps"].mean())


def test_traces_are_those_of_the_left_vehicle_that_merges_first_or_second(study):
    group = study.models[0]
    for first in ("left", "right"):
        rows = load(
            "SELECT list(velocity_mps ORDER BY step) v FROM states JOIN trials "
            "USING (trial_id, spec_hash) WHERE side = 'left' AND status = 'finished' AND "
            f"spec_hash = 'o3-baseline' AND merged_first = '{first}' GROUP BY trial_id",
            study.db,
        )
        found = left_traces(study, group, first)
        assert sorted(tuple(trace[:, 1]) for trace in found) == sorted(tuple(v) for v in rows["v"])
        assert all(trace[0, 0] == 0 for trace in found)


def test_before_an_import_the_figure_says_what_is_missing_and_draws_the_published_line(study):
    figure = figure_2(study)
    texts = [t.get_text() for sub in figure.subfigs for axis in sub.axes for t in axis.texts]
    assert sum("recordings" in text for text in texts) == 2 + 3  # A and B; E for each velocity
    lines = [
        line
        for axis in figure.subfigs[1].axes[3:6]
        for line in axis.lines
        if line.get_linestyle() == "--"
    ]
    assert len(lines) == 3
    heights = dict(zip(*lines[1].get_data(), strict=True))
    assert heights[0] == pytest.approx(3.54)
    assert heights[4] == pytest.approx(3.54 + 4 * 0.17)


@pytest.mark.usefixtures("few_draws")
@pytest.mark.parametrize(
    "drives",
    [
        [],
        [Drive("o3", "baseline", "N_0_0", 1, (0.0,), (0.0,))],
        yielding("o3", "A1", reps=1)[:1],
    ],
)
def test_figures_of_next_to_nothing_are_drawn_all_the_same(drives, tmp_path, recwarn):
    study = Study(write_study(tmp_path / "t.duckdb", drives))
    for draw, _ in FIGURES.values():
        draw(study).draw_without_rendering()
    assert [str(w.message) for w in recwarn.list] == []
