"""What is shown of drivers that were only asked for their first decision."""

from __future__ import annotations

import re
from html import unescape

import pytest
from starlette.testclient import TestClient

from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.site import Site
from merge_runner_analysis.tables import TABLES
from tests.integration.explorer.test_tables_pages import Addresses, Awaited, InProcess


@pytest.fixture(scope="module")
def ask(prepare, tmp_path_factory):
    """Gets a page on the emulator, which was asked and drove, and on a pair, which was asked."""
    folder = tmp_path_factory.mktemp("asked")
    sweep = ("sweep", "baseline", "--conditions", "L_4_8,N_0_0", "--reps", 1, "--db", "t.duckdb")
    for more in ((), ("--first",), ("--first", "--model", "emulator+idm", "--mirror")):
        run = prepare(folder, *sweep, *more)
        assert run.code == 0, run.err
    site = Site(folder / "t.duckdb")
    site.computing = Awaited(site.db, InProcess)
    client = TestClient(explorer(site), base_url="http://127.0.0.1:8700")
    yield client.get
    site.computing.close()


def cells(ask, table):
    links = Addresses(ask(f"/tables/{table}").text).to
    return [link for link in links if link.startswith("/trials?cell=")]


@pytest.mark.slow
def test_every_number_of_first_decisions_leads_to_what_it_rests_on(ask):
    found = [link for link in cells(ask, "first-action") if "asked" in link]
    assert len(found) > 10
    for link in found[::5]:
        reply = ask(link)
        assert reply.status_code == 200, link
        assert "first decisions that were asked for alone" in " ".join(reply.text.split())
        (query,) = (a for a in Addresses(reply.text).to if a.startswith("/sql?q="))
    trials = re.search(r"(\d+) of \d+ trials;", unescape(reply.text))[1]
    assert f"<strong>{trials}</strong> rows" in ask(query).text


@pytest.mark.long
@pytest.mark.parametrize("table", TABLES)
def test_no_number_of_a_table_leads_nowhere(ask, table):
    one_a_row = {link.rpartition("%3A")[0]: link for link in cells(ask, table)}
    assert {ask(link).status_code for link in one_a_row.values()} <= {200}
