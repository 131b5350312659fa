"""All trials of a condition in one picture: what is drawn of whom, and where it leads."""

from __future__ import annotations

import re

import duckdb
import pytest

from merge_runner_analysis.explorer.computing import Computing
from merge_runner_analysis.explorer.pages import conditions
from merge_runner_analysis.explorer.pages.conditions import BAND, PANELS, TRACES
from tests.support.serving import Never, Page, client_of
from tests.support.studies import Drive, as_humans, write_study, yielding

CRASH = Drive("o3", "baseline", "N_0_0", 9, (0.0,) * 9, (0.0,) * 9)
# The median of these three is the second one.
HUMANS = [Drive("human", "baseline", "N_0_0", i, (i / 10,) * 9, (-0.5,) * 9) for i in (1, 2, 3)]


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    """Two drivers, one with two prompts, a collision, and three humans in one condition."""
    path = tmp_path_factory.mktemp("conditions") / "t.duckdb"
    others = [*yielding("o3", "A1", reps=2), *yielding("o4", reps=2)]
    write_study(path, [*yielding("o3", reps=2), CRASH, *others, *HUMANS])
    as_humans(path)
    return client_of(path, Computing(path, Never))


@pytest.fixture(scope="module")
def query(client):
    with duckdb.connect(str(client.site.db), read_only=True) as connection:
        yield lambda *sql: connection.execute(*sql).fetchall()


def traces(text):
    """The trials of the picture by name, with the class of each line."""
    found = r'<a href="/trials/([^"?]*)[^>]*><title>[^<]*</title><path class="([^"]*)"'
    return dict(re.findall(found, text))


def read(client, sql, keys):
    """What the page reads of trials by (name, spec)."""
    with duckdb.connect(str(client.site.db), read_only=True) as connection:
        found = connection.execute(sql, [list(part) for part in zip(*keys, strict=True)])
        names = [column[0] for column in found.description]
        return [dict(zip(names, row, strict=True)) for row in found.fetchall()]


def test_the_picture_has_a_line_for_each_trial_of_a_driver_that_leads_to_it(client, query):
    text = client.get("/conditions/N_0_0").text
    there = dict(
        query(
            "SELECT trial_id, coalesce(merged_first || '-first', status) FROM trials "
            "WHERE condition = 'N_0_0' AND source <> 'human'"
        )
    )
    assert traces(text) == there
    assert there["o3/baseline/N_0_0/rep09"] == "collided"
    assert text.count(conditions.CROSS) == len(PANELS)
    said = Page(text).text
    assert f"{len(there)} trials of drivers are drawn." in said
    assert "N_0_0: the drivers' trials beside the humans' band" in said
    assert "3 human trials: their median" in said
    without = client.get("/conditions/L_4_0").text
    assert "No human trial of this condition is here." in without
    assert "beside the humans" not in without
    for address in ("nothing", "N_0_0?variant=A9"):
        assert client.get(f"/conditions/{address}").status_code == 404


@pytest.mark.parametrize(
    ("asked", "names"),
    [
        ("model=o4", {"o4/baseline"}),
        ("model=o3&model=o4&variant=baseline", {"o3/baseline", "o4/baseline"}),
        ("model=o3&variant=A1", {"o3/A1"}),
        ("variant=A1", {"o3/A1"}),
        ("sweep=sweep-1", {"o3/baseline", "o3/A1", "o4/baseline"}),
    ],
)
def test_picture_and_table_are_of_the_scope(client, asked, names):
    text = client.get(f"/conditions/N_0_0?{asked}").text
    assert {name.rpartition("/N_0_0")[0] for name in traces(text)} == names
    rows = re.findall(r'<tr><th scope="row">([^<]*)</th><td>([^<]*)</td>', text)
    assert {"/".join(row) for row in rows} == names


def test_the_humans_are_a_median_and_a_band_from_the_10th_to_the_90th_percentile(client):
    keys = [(f"human/baseline/N_0_0/rep0{i}", "human-baseline") for i in (1, 2, 3)]
    band = read(client, BAND, keys)
    own = {row["trial_id"]: row for row in read(client, TRACES, keys)}
    one, middle, other = (own[name] for name, _ in keys)
    at = {round(t, 3): v for t, v in zip(middle["time_s"], middle["first_mps"], strict=True)}
    assert len(at) > 10
    for row in band[:20]:  # while all of them go on
        low, median, high = row["first_mps"]
        assert median == pytest.approx(at.get(round(row["time_s"], 3), median))
        assert low <= median <= high
    assert band[-1]["time_s"] > 5
    # The 10th percentile of three is a fifth of the way from the first to the second.
    low, median, high = band[20]["first_mps"]
    first, last = (row["first_mps"][row["time_s"].index(4.0)] for row in (one, other))
    assert low == pytest.approx(first + (median - first) / 5)
    assert high == pytest.approx(last - (last - median) / 5)


def test_the_first_vehicle_is_the_one_that_merged_first_or_was_ahead_at_the_end(client, query):
    rows = query(
        "SELECT trial_id, spec_hash, coalesce(any_value(merged_first), if("
        "arg_max(position_m, time_s) FILTER (side = 'left') >= "
        "arg_max(position_m, time_s) FILTER (side = 'right'), 'left', 'right')), "
        "arg_max(velocity_mps, time_s) FILTER (side = 'left'), "
        "arg_max(velocity_mps, time_s) FILTER (side = 'right') "
        "FROM trials JOIN states USING (trial_id, spec_hash) GROUP BY ALL"
    )
    assert {first for _, _, first, *_ in rows} == {"left", "right"}
    found = read(client, TRACES, [(trial, spec) for trial, spec, *_ in rows])
    assert {row["time_s"][0] for row in found} == {0}
    assert min(row["headway_m"][-1] for row in found) >= 0
    assert {
        (row["trial_id"], row["spec_hash"], row["first_mps"][-1], row["second_mps"][-1])
        for row in found
    } == {
        (trial, spec, *((left, right) if first == "left" else (right, left)))
        for trial, spec, first, left, right in rows
    }


def test_all_lines_lie_in_their_panels_over_one_axis_of_time(client):
    keys = [("o3/baseline/N_0_0/rep09", "o3-baseline"), ("o3/A1/N_0_0/rep01", "o3-A1")]
    drawn = [{"outcome": "collided", **row} for row in read(client, TRACES, keys)]
    picture = conditions.picture(drawn, [])
    assert [panel["heading"] for panel in picture["panels"]] == [*PANELS.values()]
    bottom = picture["panels"][-1]["top"] + picture["panel"]
    assert bottom < picture["height"]
    for panel in picture["panels"]:
        places = [place for place, _ in panel["ticks"]]
        assert (min(places), max(places)) == (panel["top"], panel["top"] + picture["panel"])
    assert picture["seconds"][0] == (picture["left"], 0)
    assert picture["seconds"][-1][0] == picture["right"]
    for _, path in picture["lines"]:
        starts = re.findall(r"M(\d+) (\d+)l", path)
        assert [x for x, _ in starts] == [str(picture["left"])] * len(PANELS)
        for panel, (_, y) in zip(picture["panels"], starts, strict=True):
            assert panel["top"] <= int(y) <= panel["top"] + picture["panel"]


def test_of_too_many_trials_a_part_is_drawn_and_the_page_says_so(client, monkeypatch):
    monkeypatch.setattr(conditions, "MOST", 3)
    text = client.get("/conditions/N_0_0").text
    assert len(traces(text)) == 3
    assert "3 trials of drivers are drawn, taken evenly from the list of 7" in Page(text).text


def test_the_first_page_leads_to_every_condition_in_words_and_each_leads_back(client, query):
    home = Page(client.get("/").text)
    for (name,) in query("SELECT DISTINCT condition FROM trials"):
        assert home.to(f"/conditions/{name}")
        assert Page(client.get(f"/conditions/{name}").text).to("/#collisions")
    assert Page(client.get("/?variant=baseline&condition=N_0_0").text).to(
        "/conditions/N_0_0?variant=baseline"
    )
    assert Page(client.get("/trials/o3/baseline/N_0_0/rep09").text).to("/conditions/N_0_0")
    words = "the right vehicle would be 2 m ahead at the merge point, and the left one is 0.8 m/s"
    assert f"{words} faster R_-2_8" in home.text
