"""Groups beside the humans: how each is drawn, what an import changes, and the axes."""

from __future__ import annotations

import re
from html import unescape

import pytest
from starlette.testclient import TestClient

from merge_runner.config import ScenarioConfig
from merge_runner.results.store import Store
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.explorer.analysis_worker import Numbers
from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.charts import Kind, chart, marks
from merge_runner_analysis.explorer.pictures import marker
from merge_runner_analysis.explorer.site import Site
from merge_runner_analysis.figures.styles import HUMAN_STYLE, MARKERS, driver_style
from merge_runner_analysis.human.archive import open_files
from merge_runner_analysis.human.load import import_trials, sort_files
from merge_runner_analysis.metrics import GAP, RMSE
from merge_runner_analysis.names import HUMAN
from tests.analysis.recordings import drive, write_folder
from tests.analysis.studies import Drive, write_study, yielding
from tests.explorer.test_tables_pages import Awaited, InProcess

HOST = "127.0.0.1:8700"
# A sweep that was killed: two trials of one condition that have nothing in common.
KILLED = [
    Drive("killed", "baseline", "L_4_0", 1, (1.0,) * 3, (-1.0,) * 3),
    Drive("killed", "baseline", "L_4_0", 2, (0.1,), (-0.1,)),
]


@pytest.fixture
def db(tmp_path):
    return write_study(
        tmp_path / "t.duckdb",
        [*yielding("o3", reps=5), *KILLED],
        ScenarioConfig(vehicle_length_m=4),
    )


@pytest.fixture
def ask(db):
    site = Site(db)
    site.computing = Awaited(db, InProcess)
    client = TestClient(explorer(site), base_url=f"http://{HOST}")

    yield lambda: unescape(client.get("/").text).split('id="panels"')[1].split("</section>")[0]
    site.computing.close()


def import_some(db, folder):
    """Two pairs in every condition, as a download that is not whole."""
    files = {}
    for experiment in (4, 6):
        for number, condition in enumerate(CONDITIONS):
            yields = "left" if "R" in condition else "right"
            name = f"experiment_{experiment}/experiment_{experiment}_iter_{number + 1}.csv"
            files[name] = drive(condition, yields=yields).csv()
    with open_files(write_folder(folder, files)) as found:
        import_trials(sort_files(found).trials, Store(db))


@pytest.mark.long
def test_the_charts_are_made_anew_after_an_import(ask, db, tmp_path):
    before = ask()
    assert "The recordings of the humans are not imported" in before
    assert "22 imported trials" not in before
    import_some(db, tmp_path / "recordings")
    after = ask()
    assert "The recordings of the humans are not imported" not in after
    assert "The database has changed" not in after
    assert "22 imported trials" in after


def test_a_driver_looks_as_in_the_figures_and_no_other_driver_does():
    groups = [{"id": HUMAN, "label": HUMAN}]
    groups += [{"id": f"{i}/baseline", "label": str(i)} for i in range(12)]
    human, *drivers = marks(groups).values()
    assert human.style == HUMAN_STYLE
    assert [mark.style for mark in drivers] == [driver_style(i) for i in range(12)]
    assert len({mark.style for mark in drivers}) == 12
    shapes = {mark.style.shape for mark in (human, *drivers)}
    assert shapes == set(MARKERS)
    assert len({marker(shape, 7, 7) for shape in shapes}) == len(shapes)


@pytest.mark.slow
def test_a_driver_of_two_trials_does_not_stretch_the_axes(ask, db):
    content = Numbers(db).answer(["home", ""])
    gap, rmse = Kind(GAP), Kind(RMSE)
    (killed,) = (group for group in content["groups"] if group["id"] == "killed/baseline")
    huge = killed["conditions"]["L_4_0"]["gap_m"]
    assert huge["low"] < -30
    assert huge["high"] > 50
    drawn = chart(gap, content["groups"], list(content["conditions"]), content["published"])
    ticks = [float(text) for _, text in drawn["axis"].marks]
    assert ticks[0] >= -10
    assert ticks[-1] <= 30
    assert drawn["cut"]
    (point,) = (
        point
        for panel in drawn["panels"]
        for point in panel["points"]
        if point["group"] == "killed/baseline"
    )
    assert [shape for shape, _ in point["arrows"]] == ["down", "triangle"]
    scale = drawn["axis"].scale
    assert scale.to <= point["ends"][1] <= point["y"] <= point["ends"][0] <= scale.from_
    assert chart(rmse, content["groups"], [], {})["axis"].marks[0][1] == "0"
    text = ask()
    assert len(re.findall(r'class="cut"', text)) >= 2
    assert "An arrow at the edge: an interval goes on beyond the axis. Its ends are in" in text
    assert f"{huge['value']:.2f} [{huge['low']:.2f}, {huge['high']:.2f}], n 2</" in text
