"""A driver is named with the endpoint that is not its provider's own, and found by that name."""

from __future__ import annotations

import html
import re
import time
from urllib.parse import parse_qs, urlsplit

import duckdb
import pytest
from starlette.testclient import TestClient

from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.pages.home import home_page
from merge_runner_analysis.explorer.pages.sweep import list_runs
from merge_runner_analysis.explorer.pages.trial import trial_page
from merge_runner_analysis.explorer.pages.trials import filter_of, trials_page
from merge_runner_analysis.explorer.site import Site
from tests.support.harness import FAST

SMALL = ("--reps", 1, "--conditions", "L_4_0,N_0_0", "--yes", *FAST)


@pytest.fixture(scope="module")
def hosts(emulator_url):
    host = emulator_url.removeprefix("http://").removesuffix("/v1")
    return host, host.replace("127.0.0.1", "localhost")


@pytest.fixture(scope="module")
def site(prepare, hosts, tmp_path_factory):
    """Three sweeps of one name, at two endpoints, one of them in a mixed pair and another set."""
    folder = tmp_path_factory.mktemp("hosts")
    for host, *options in (
        (hosts[0], "--model", "o3"),
        (hosts[1], "--model", "o3"),
        (hosts[1], "--model", "o3+constant", "--sample-set", 1),
    ):
        run = prepare(folder, "sweep", "baseline", *options, *SMALL,
                      OPENAI_API_KEY="x", OPENAI_BASE_URL=f"http://{host}/v1")  # fmt: skip
        assert run.code == 0, run.err
    found = Site(folder / "results/merge.duckdb")
    found.catalogue.refresh()
    return found


def browser(site):
    return TestClient(explorer(site), base_url="http://127.0.0.1:1")


def test_the_trials_of_two_endpoints_are_listed_apart(site, hosts):
    with duckdb.connect(str(site.db), read_only=True) as connection:
        view = connection.execute(
            "SELECT driver, count(*) FROM trial_drivers GROUP BY 1"
        ).fetchall()
    listed = site.catalogue.facets({})["model"]
    assert sorted(listed) == sorted(view)
    assert dict(view) == {
        f"o3 at {hosts[0]}": 2,
        f"o3 at {hosts[1]}": 2,
        f"o3 at {hosts[1]}+constant/set1": 2,
    }


def test_a_link_to_trials_of_a_driver_finds_them(site, hosts):
    client = browser(site)
    for driver in (f"o3 at {hosts[0]}", f"o3 at {hosts[1]}+constant/set1"):
        row = site.catalogue.every({"model": driver})[0]
        page = client.get(f"/trials/{row['trial_id']}", params={"spec": row["spec_hash"]}).text
        links = map(html.unescape, re.findall('href="(/trials[?][^"]*)"', page))
        link = next(each for each in links if "model=" in each)
        asked = {name: values[0] for name, values in parse_qs(urlsplit(link).query).items()}
        assert asked["model"] == driver
        assert [one["model"] for one in site.catalogue.every(filter_of(asked))] == [driver]
        assert html.escape(driver) in client.get(link).text


def test_a_sweep_is_named_by_its_driver_and_says_that_a_stand_in_answered(site, hosts):
    client = browser(site)
    names = [f"o3 at {hosts[1]}+constant", f"o3 at {hosts[1]}", f"o3 at {hosts[0]}"]
    runs = list_runs(site.catalogue)
    assert [run["driver"] for run in runs] == names
    shown = client.get("/sweeps").text
    for entry, name in zip(runs, names, strict=True):
        assert f"{name} (scripted stand-in)" in shown
        page = client.get(f"/sweeps/{entry['sweep_id']}").text
        assert f"{name} drives" in page
        assert "<strong>scripted stand-in, not o3.</strong>" in page


def computed(page, site):
    """A page once its numbers are there."""
    while "Computing, " in (text := page(site, {})):
        time.sleep(0.1)
    return text


def test_every_page_says_who_is_a_stand_in_and_for_whom(site):
    words = "scripted stand-in, not o3"
    site.catalogue.refresh()
    trials = site.catalogue.every({})
    assert [row["stand_in"] for row in trials] == [words] * len(trials)
    pages = {
        "trials": trials_page(site, {}),
        "trial": trial_page(site, trials[0]["trial_id"], {}),
        "study": computed(home_page, site),
        "csv": site.catalogue.export({}, "trial"),
    }
    assert [name for name, page in pages.items() if words not in page] == []
