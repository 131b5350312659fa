"""Conditions: what they are called, and where their names lead."""

from __future__ import annotations

import re

import duckdb
import pytest
from starlette.testclient import TestClient

from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.site import Site
from tests.analysis.studies import Drive, as_humans, write_study, yielding

HOST = "127.0.0.1:8700"
CRASH = Drive("o3", "baseline", "N_0_0", 9, (0.0,) * 9, (0.0,) * 9)
# The median of these three is the second one.
HUMANS = [Drive("human", "baseline", "N_0_0", i, (i / 10,) * 9, (-0.5,) * 9) for i in (1, 2, 3)]


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    """Two drivers, one with two prompts, a collision, and three humans in one condition."""
    path = tmp_path_factory.mktemp("conditions") / "t.duckdb"
    others = [*yielding("o3", "A1", reps=2), *yielding("o4", reps=2)]
    write_study(path, [*yielding("o3", reps=2), CRASH, *others, *HUMANS])
    as_humans(path)
    return path


@pytest.fixture
def ask(db):
    site = Site(db)
    client = TestClient(explorer(site), base_url=f"http://{HOST}")
    yield client.get
    site.close()


def test_the_first_page_leads_to_every_condition_and_each_leads_back(ask, db):
    text = ask("/").text
    with duckdb.connect(str(db), read_only=True) as connection:
        names = connection.execute("SELECT DISTINCT condition FROM trials").fetchall()
    for (name,) in names:
        assert f'href="/trials?condition={name}"' in text


@pytest.mark.parametrize("address", ["/"])
def test_the_code_of_a_condition_says_itself_in_words_on_every_page(ask, address):
    text = ask(address).text
    (told,) = set(re.findall(r'title="([^"]*)"[^>]*>(?:<[^>]*>\s*)*R_-2_8[< ]', text)) or {None}
    assert told == "the right vehicle would be 2 m ahead at the merge point, and the left one is " \
        "0.8 m/s faster"  # fmt: skip
