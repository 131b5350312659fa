"""Who may ask, what a page may do, and that no address or database costs other pages anything."""

import asyncio
import logging
import re
import shutil
from itertools import product
from unittest.mock import AsyncMock

import pytest

from merge_runner.errors import UsageError
from merge_runner_analysis.web.app import PAGES, explorer, listen
from merge_runner_analysis.web.site import Site
from tests.support.cases import cases
from tests.support.serving import HOST, client_of, held, in_process
from tests.support.studies import write_study, yielding

TRIAL = "/trials/o3/baseline/N_0_0/rep01"
PLACES = ("/trials", "/trials.csv", "/words")


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    return write_study(tmp_path_factory.mktemp("guard") / "t.duckdb", yielding("o3", reps=1))


@pytest.fixture(scope="module")
def client(study):
    return client_of(study)


@pytest.mark.parametrize("case", cases("explorer", "headers"))
def test_another_name_or_another_sites_page_is_refused(client, case):
    reply = client.get("/trials", headers=case["headers"])
    told = (reply.status_code, "content-security-policy" in reply.headers)
    assert told == (case["status"], True)


def test_no_page_runs_what_is_not_a_file_of_ours(client):
    for address in ("/trials", "/nowhere", "/static/keys.js"):
        reply = client.get(address)
        policy = reply.headers["content-security-policy"]
        assert "default-src 'none'; script-src 'self'; style-src 'self'" in policy
        assert "unsafe" not in policy
        inline = r"<script(?![^>]*(src=|application/json))|\son[a-z]+=|style="
        assert address.startswith("/static") or not re.search(inline, reply.text)


async def test_the_explorer_is_bound_to_loopback_alone(merge_runner, study):
    with listen(0) as taken:
        host, port = taken.getsockname()
        assert host == "127.0.0.1"
        run = await merge_runner("view", "--db", study, "--port", port)
    assert (run.code, len(run.err.splitlines())) == (2, 1)
    assert f"nothing can listen at port {port} of 127.0.0.1" in run.err


def test_what_is_not_there_is_told_and_a_page_that_is_still_read_says_so(
    study, tmp_path, monkeypatch
):
    with pytest.raises(UsageError, match="`merge-runner sweep baseline`"):
        Site(tmp_path / "none.duckdb").trial_index.refresh()
    monkeypatch.setattr(Site, "beginning", True)
    reply = client_of(study).get("/trials")
    assert ("Reading the trials" in reply.text, reply.headers["refresh"]) == (True, "1")


def test_a_fault_is_one_line_and_the_other_pages_go_on(study, monkeypatch, caplog):
    monkeypatch.setitem(PAGES, "/sweeps", lambda *_: 1 / 0)
    client = client_of(study)
    reply = client.get("/sweeps")
    told = "A fault of the explorer: ZeroDivisionError"
    assert (reply.status_code, told in reply.text) == (500, True)
    assert client.get("/trials").status_code == 200
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == [
        "/sweeps: a fault of the explorer: ZeroDivisionError('division by zero')"
    ]


@pytest.mark.parametrize("case", cases("explorer", "odd-addresses"))
def test_an_odd_address_is_no_fault_and_no_markup_of_it_is_kept(client, case):
    reply = client.get(case["address"])
    assert reply.status_code == case["status"]
    assert not re.search("A fault|<b>nowhere", reply.text)
    assert "/?" not in str(reply.url)  # a list with a stroke behind it is the list


def test_nothing_long_in_an_address_is_a_fault(client):
    names = ("cell", "page", "sort", "sweep", "variant", "tactical", "planned_from", "seen", "run")
    for address, name, value in product((*PLACES, "/sql"), names, ("9" * 5_000, "a " * 2_500)):
        reply = client.get(address, params={name: value})
        assert reply.status_code < 500, (address, name, value[0])
    of_a_trial = {"side": "left", "decision": "9" * 5_000}
    assert client.get(TRIAL, params=of_a_trial).status_code == 200


def test_a_filter_that_is_too_long_is_refused_in_a_line(client, caplog):
    for asked, said in (
        ({"q": "a " * 1_100}, "up to 12 words and 300 characters, this one 1,100 and 2,200"),
        ({"q": "b" * 301}, "up to 12 words and 300 characters"),
        ({f"factor.f{i}": "x" for i in range(1_100)}, "up to 30 parts"),
        ({"model": "x" * 60_000}, "of up to 1,000 characters"),
        ({"q": " ".join("x" * 24 for _ in range(12)), "model": "x" * 1_000}, ""),
    ):
        for address in PLACES:
            reply = client.get(address, params=asked)
            assert (reply.status_code, said in reply.text) == (400 if said else 200, True)
    assert caplog.messages == []


def test_nothing_is_said_of_a_browser_that_left(study, caplog):
    headers = {"host": HOST, "origin": f"http://{HOST}", "content-length": "100"}
    raw = [(name.encode(), value.encode()) for name, value in headers.items()]
    asked = {"type": "http", "http_version": "1.1", "method": "POST", "path": "/notes"}
    asked |= {"query_string": b"", "headers": raw}
    leaves = AsyncMock(return_value={"type": "http.disconnect"})
    with caplog.at_level(logging.DEBUG, "merge_runner_analysis"):
        asyncio.run(explorer(Site(study))(asked, leaves, AsyncMock()))
    assert (leaves.called, caplog.messages) == (True, [])


def test_while_another_program_holds_the_database_the_last_list_is_shown(study, tmp_path):
    db = shutil.copy(study, tmp_path / "t.duckdb")
    # What is computed is not waited for: that process waits for the database.
    client = client_of(db, in_process(db))
    told = "Another program holds the database"
    assert told not in client.get("/trials").text
    with held(db):
        for address in ("/trials", "/trials?condition=N_0_0", "/sweeps", "/tables"):
            reply = client.get(address)
            assert (reply.status_code, told in reply.text) == (200, True)
    assert told not in client.get("/trials").text
