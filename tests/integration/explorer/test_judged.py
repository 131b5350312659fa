"""A replay shows what its own scenario takes for a collision, and control from its start."""

from __future__ import annotations

import re

import duckdb
import pytest
from playwright.sync_api import expect
from starlette.testclient import TestClient

from merge_runner.config import ScenarioConfig
from merge_runner.results.store import Store
from merge_runner.scenarios.merge.collision import collided
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.reading import reading
from merge_runner_analysis.explorer.site import Site
from merge_runner_analysis.explorer.views import collision_bounds, read_trial
from merge_runner_analysis.human.archive import open_files
from merge_runner_analysis.human.load import import_trials, sort_files
from tests.integration.explorer.test_listing import Texts
from tests.support.recordings import drive, write_folder
from tests.support.serving import served
from tests.support.studies import Drive, write_study

HOST = "127.0.0.1:8700"
# Both keep their speed and meet at the merge point.
MEETING = Drive("o3", "baseline", "N_0_0", 1, (0.0,), (0.0,))
PASSING = Drive("o3", "baseline", "N_0_0", 2, (0.6,) * 3, (-0.6,) * 3)
RULES = {
    "euclid2d": ("circle", "circles of 6 m"),
    "rectangle": ("rect", "outlines of 6 m by 2.4 m"),
    "shared_lane": ("rect", "bars of 6 m along the road"),
}


@pytest.fixture
def study_of(tmp_path):
    def write(rule):
        scenario = ScenarioConfig(vehicle_length_m=6, vehicle_width_m=2.4, collision_rule=rule)
        return write_study(tmp_path / f"{rule}.duckdb", [MEETING, PASSING], scenario)

    return write


@pytest.fixture(scope="module")
def humans(tmp_path_factory):
    """Two recorded trials; the first brakes hard within the tunnel."""
    folder = tmp_path_factory.mktemp("humans")
    recording = drive("N_0_0", yields="right")
    in_tunnel = recording.columns["velocities.left"]
    in_tunnel[5:] = [speed - 1 for speed in in_tunnel[5:]]
    files = {
        "experiment_4/experiment_4_iter_1.csv": recording.csv(),
        "experiment_4/experiment_4_iter_2.csv": drive("N_0_0", yields="nobody").csv(),
    }
    db = folder / "t.duckdb"
    with open_files(write_folder(folder / "recordings", files)) as found:
        import_trials(sort_files(found), Store(db))
    return db


def a_trial(db, number=0):
    with duckdb.connect(str(db), read_only=True) as connection:
        return connection.execute("SELECT trial_id, spec_hash FROM trials ORDER BY 1").fetchall()[
            number
        ]


def page_of(db, number=0):
    name, _ = a_trial(db, number)
    client = TestClient(explorer(Site(db)), base_url=f"http://{HOST}")
    return client.get(f"/trials/{name}").text


@pytest.mark.parametrize("rule", RULES)
def test_the_band_of_the_chart_holds_the_headways_that_collide(study_of, rule):
    db = study_of(rule)
    with reading(db) as connection:
        trial = read_trial(connection, *a_trial(db, 1))
    bounds = collision_bounds(trial)
    places = zip(*(samples["position_m"] for samples in trial.states.values()), strict=True)
    for bound, (left, right) in zip(bounds, places, strict=True):
        mean = (left + right) / 2
        assert collided(trial.scenario, TRACK, left, right) == (abs(left - right) < (bound or 0))
        if rule != "shared_lane":
            assert bound is None or collided(
                trial.scenario, TRACK, mean + bound / 2 - 0.01, mean - bound / 2 + 0.01
            )
    assert max(filter(None, bounds)) == pytest.approx(6, abs=0.2)


@pytest.mark.long
@pytest.mark.parametrize("rule", RULES)
def test_the_picture_draws_what_the_scenario_judges(page, study_of, rule):
    shape, words = RULES[rule]
    with served(study_of(rule)) as address:
        page.goto(f"{address}/trials/o3/baseline/N_0_0/rep01?t=3")
        expect(page.locator("#judged")).to_contain_text(words)
        drawn = page.locator(f"#track .own {shape}.judged")
        expect(drawn).to_have_count(2)
        assert page.locator("#track .judged").count() == 2
        size = drawn.first.evaluate(
            "it => Number(it.getAttribute('width') ?? 2 * it.getAttribute('r'))"
        )
        assert size == 6
        assert page.locator("#track .own.left rect").first.get_attribute("width") == "6"
        page.keyboard.press("5")
        page.locator("#play").click()
        expect(page.locator("#track.collided .crash")).to_be_visible()
        expect(drawn.first).to_be_visible()
        page.goto("about:blank")


def test_a_human_trial_is_judged_by_the_boxes(humans):
    text = page_of(humans, 1)
    assert "The vehicles collided" in text
    assert "outlines of 4.5 m by 1.8 m" in text


def test_beside_humans_who_say_nothing_stands_what_was_measured(humans):
    text = " ".join(Texts(page_of(humans)).said)
    assert "A human pair" in text
    assert "net gap when the first vehicle reaches the merge point" in text


@pytest.mark.long
def test_no_sign_stands_under_a_car_and_every_car_stands_within_the_picture(page, humans):
    box = "it => (b => [b.left, b.top, b.right, b.bottom])(it.getBoundingClientRect())"
    name, _ = a_trial(humans)
    with served(humans) as address:
        for width in (1440, 900):
            page.set_viewport_size({"width": width, "height": 900})
            page.goto(f"{address}/trials/{name}")
            expect(page.locator("#charts .chart")).to_have_count(3)
            left, top, right, bottom = page.locator("#track").evaluate(box)
            signs = [sign.evaluate(box) for sign in page.locator("#track .sign:visible").all()]
            assert len(signs) == 3
            assert all(x0 >= left and y0 >= top and x1 <= right and y1 <= bottom
                       for x0, y0, x1, y1 in signs)  # fmt: skip
            for time_s in (None, 0):
                if time_s is not None:
                    page.locator("#scrub").fill(str(time_s))
                for car in page.locator("#track .own > rect:first-child").all():
                    x0, y0, x1, y1 = car.evaluate(box)
                    assert x0 >= left
                    assert y0 >= top
                    assert x1 <= right
                    assert y1 <= bottom
                    assert not [
                        s for s in signs if s[0] < x1 and x0 < s[2] and s[1] < y1 and y0 < s[3]
                    ]
        page.goto("about:blank")


def test_the_hardest_acceleration_counts_from_control_on(humans):
    with reading(humans) as connection:
        trial = read_trial(connection, *a_trial(humans))
    samples = trial.states["left"]
    times, accelerations = samples["time_s"], samples["acceleration_mps2"]
    assert min(accelerations) == pytest.approx(-20, abs=0.1)
    own = [a for t, a in zip(times, accelerations, strict=True) if t > 0]
    page = page_of(humans).replace("−", "-")
    said = re.findall(r"hardest acceleration was ([+-][\d.]+) m/s²", page)
    assert said[0] == f"{max(own, key=abs):+z.1f}"
    with duckdb.connect(str(humans), read_only=True) as connection:
        (metric,) = connection.execute(
            "SELECT max_acceleration_mps2 FROM trial_metrics ORDER BY trial_id"
        ).fetchall()[0]
    assert max(abs(float(value)) for value in said) == pytest.approx(metric, abs=0.051)
