"""All trials of a condition in one picture: what is drawn of whom, and where it leads."""

import re

import duckdb
import pytest

from merge_runner_analysis.web.pages import conditions
from merge_runner_analysis.web.pages.conditions import BAND, PANELS, TRACES
from merge_runner_analysis.web.reading import records
from merge_runner_analysis.web.scope import scope_of
from tests.support.serving import Page, client_of, in_process, never
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
    return client_of(path, in_process(path, never))


@pytest.fixture(scope="module")
def query(client):
    """Asks the database; gives rows as dicts."""
    with duckdb.connect(str(client.site.db), read_only=True) as connection:
        yield lambda sql, keys=(): records(connection, sql, [*map(list, zip(*keys, strict=True))])


def test_a_driver_is_looked_at_with_the_prompts_that_it_was_given(client):
    client.site.refresh()
    chosen = {name: scope_of(client.site, {}, name).prompts for name in ("o3", "o4")}
    assert {name: [prompt for prompt, _ in prompts] for name, prompts in chosen.items()} == {
        "o3": ["A1", "baseline"],
        "o4": ["baseline"],
    }


def traces(text):
    """The trials of the picture by name, with the class of each line."""
    found = r'<a href="/trials/([^"?]*)[^>]*><title>[^<]*</title><path class="([^"]*)"'
    return dict(re.findall(found, text))


def test_the_picture_has_a_line_for_each_trial_of_a_driver_that_leads_to_it(
    client, query, monkeypatch
):
    text = client.get("/conditions/N_0_0").text
    there = {
        row["trial_id"]: row["shown"]
        for row in query(
            "SELECT trial_id, coalesce(merged_first || '-first', status) AS shown FROM trials "
            "WHERE condition = 'N_0_0' AND source <> 'human'"
        )
    }
    assert traces(text) == there
    assert there["o3/baseline/N_0_0/rep09"] == "collided"
    assert text.count(conditions.CROSS) == len(PANELS)
    said = Page(text).text
    assert f"{len(there)} trials of drivers are drawn." in said
    assert "N_0_0: the drivers' trials beside the people's band" in said
    assert "3 trials of people: their median" in said
    without = client.get("/conditions/L_4_0").text
    assert "No trial of people in this situation is here." in without
    assert "beside the people" not in without
    for address in ("nothing", "N_0_0?variant=A9"):
        assert client.get(f"/conditions/{address}").status_code == 404
    monkeypatch.setattr(conditions, "MOST", 3)
    text = client.get("/conditions/N_0_0").text
    assert len(traces(text)) == 3
    assert "3 trials of drivers are drawn, taken evenly from the list of 7" in Page(text).text


def test_picture_and_table_are_of_the_scope_and_the_first_page_leads_there_and_back(client, query):
    for asked, names in {
        "model=o4": {"o4/baseline"},
        "model=o3&model=o4&variant=baseline": {"o3/baseline", "o4/baseline"},
        "sweep=sweep-1&variant=A1": {"o3/A1"},
    }.items():
        text = client.get(f"/conditions/N_0_0?{asked}").text
        assert {name.rpartition("/N_0_0")[0] for name in traces(text)} == names
        rows = re.findall(r'<tr><th scope="row">([^<]*)</th><td>([^<]*)</td>', text)
        assert {"/".join(row) for row in rows} == names
    home = Page(client.get("/").text)
    for row in query("SELECT DISTINCT condition FROM trials"):
        address = f"/conditions/{row['condition']}"
        assert home.to(address)
        assert Page(client.get(address).text).to("/#collisions")
    for address, to in (
        ("/?variant=baseline&condition=N_0_0", "/conditions/N_0_0?variant=baseline"),
        ("/trials/o3/baseline/N_0_0/rep09", "/conditions/N_0_0"),
    ):
        assert Page(client.get(address).text).to(to)
    words = "the right vehicle would be 2 m ahead at the merge point, and the left one is 0.8 m/s"
    assert f"{words} faster R_-2_8" in home.text


def test_the_humans_are_a_median_and_a_band_from_the_10th_to_the_90th_percentile(query):
    keys = [(f"human/baseline/N_0_0/rep0{i}", "human-baseline") for i in (1, 2, 3)]
    band, own = query(BAND, keys), {row["trial_id"]: row for row in query(TRACES, keys)}
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


def test_the_first_vehicle_is_the_one_that_merged_first_or_was_ahead_at_the_end(query):
    rows = query(
        "SELECT trial_id, spec_hash, coalesce(any_value(merged_first), if("
        "arg_max(position_m, time_s) FILTER (side = 'left') >= "
        "arg_max(position_m, time_s) FILTER (side = 'right'), 'left', 'right')) AS first, "
        "arg_max(velocity_mps, time_s) FILTER (side = 'left') AS left, "
        "arg_max(velocity_mps, time_s) FILTER (side = 'right') AS right "
        "FROM trials JOIN states USING (trial_id, spec_hash) GROUP BY ALL"
    )
    assert {row["first"] for row in rows} == {"left", "right"}
    found = query(TRACES, [(row["trial_id"], row["spec_hash"]) for row in rows])
    assert {row["time_s"][0] for row in found} == {0}
    assert min(row["headway_m"][-1] for row in found) >= 0
    last = {
        (row["trial_id"], row["spec_hash"]): (row["first_mps"][-1], row["second_mps"][-1])
        for row in found
    }
    for row in rows:
        speeds = (row["left"], row["right"])
        ordered = speeds if row["first"] == "left" else speeds[::-1]
        assert last[row["trial_id"], row["spec_hash"]] == ordered
    picture = conditions.picture([{"outcome": "collided", **row} for row in found[:2]], [])
    assert [panel["heading"] for panel in picture["panels"]] == [*PANELS.values()]
    assert picture["seconds"][0] == (picture["left"], 0)
    assert picture["seconds"][-1][0] == picture["right"]
    ends = [(panel["top"], panel["top"] + picture["panel"]) for panel in picture["panels"]]
    assert ends[-1][1] < picture["height"]
    for panel, (top, bottom) in zip(picture["panels"], ends, strict=True):
        places = [place for place, _ in panel["ticks"]]
        assert (min(places), max(places)) == (top, bottom)
    for _, path in picture["lines"]:
        starts = re.findall(r"M(\d+) (\d+)l", path)
        for (top, bottom), (x, y) in zip(ends, starts, strict=True):
            assert (int(x), top <= int(y) <= bottom) == (picture["left"], True)
