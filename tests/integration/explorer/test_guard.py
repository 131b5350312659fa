"""Who may ask, what a page may do, and that no address or database costs other pages anything."""

from __future__ import annotations

import asyncio
import logging
import re
import shutil
import socket

import pytest

from merge_runner.errors import UsageError
from merge_runner_analysis.explorer.app import PAGES, explorer, listen
from merge_runner_analysis.explorer.computing import Computing
from merge_runner_analysis.explorer.site import Site
from tests.support.serving import HOST, InProcess, client_of, held
from tests.support.studies import write_study, yielding

TRIAL = "/trials/o3/baseline/N_0_0/rep01"
PLACES = ("/trials", "/trials.csv", "/words")


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    return write_study(tmp_path_factory.mktemp("guard") / "t.duckdb", yielding("o3", reps=1))


@pytest.fixture(scope="module")
def client(study):
    client = client_of(study)
    yield client
    client.site.close()


def test_another_name_or_another_sites_page_is_refused(client):
    for headers in (
        {"host": "evil.example:8700"},
        {"host": "127.0.0.1.evil.example:8700"},
        {"host": "evil.example:8700", "origin": "http://evil.example:8700"},
        {"origin": "http://evil.example"},
        {"origin": "http://127.0.0.1:8701"},
        {"origin": "null"},
        {"sec-fetch-site": "cross-site", "sec-fetch-mode": "cors"},
    ):
        reply = client.get("/trials", headers=headers)
        assert reply.status_code == (400 if "host" in headers else 403), headers
        assert "content-security-policy" in reply.headers


def test_ours_and_a_link_from_elsewhere_are_answered(client):
    for headers in (
        {},
        {"origin": f"http://{HOST}"},
        {"host": "localhost:9000", "origin": "http://localhost:9000"},  # through ssh -L
        {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"},
    ):
        assert client.get("/trials", headers=headers).status_code == 200, headers


def test_no_page_runs_what_is_not_a_file_of_ours(client):
    for address in ("/trials", "/nowhere", "/static/keys.js"):
        reply = client.get(address)
        policy = reply.headers["content-security-policy"]
        assert "default-src 'none'; script-src 'self'; style-src 'self'" in policy
        assert "unsafe" not in policy
        inline = r"<script(?![^>]*(src=|application/json))|\son[a-z]+=|style="
        assert address.startswith("/static") or not re.search(inline, reply.text)


def test_the_explorer_is_bound_to_loopback_alone():
    with listen(0) as listener:
        assert listener.getsockname()[0] == "127.0.0.1"


async def test_a_port_that_is_taken_is_said_in_a_line(merge_runner, study):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        run = await merge_runner("view", "--db", study, "--port", port)
    assert run.code == 2
    assert f"nothing can listen at port {port} of 127.0.0.1" in run.err
    assert len(run.err.splitlines()) == 1


def test_a_database_that_is_not_there_is_told(tmp_path):
    with pytest.raises(UsageError, match="`merge-runner sweep baseline`"):
        Site(tmp_path / "none.duckdb").catalogue.refresh()


def test_while_the_trials_are_read_for_the_first_time_a_page_says_so(study, monkeypatch):
    monkeypatch.setattr(Site, "beginning", True)
    reply = client_of(study).get("/trials")
    assert "Reading the trials" in reply.text
    assert reply.headers["refresh"] == "1"


def test_a_fault_is_one_line_and_the_other_pages_go_on(study, monkeypatch, caplog):
    monkeypatch.setitem(PAGES, "/sweeps", lambda *_: 1 / 0)
    client = client_of(study)
    reply = client.get("/sweeps")
    assert reply.status_code == 500
    assert "A fault of the explorer: ZeroDivisionError" in reply.text
    assert client.get("/trials").status_code == 200
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == [
        "/sweeps: a fault of the explorer: ZeroDivisionError('division by zero')"
    ]


def test_an_odd_address_is_no_fault_and_no_markup_of_it_is_kept(client):
    odd = ("²", "٣", "9" * 5000, "99")
    for address, code in (
        *((f"{TRIAL}?side=left&decision={number}", 200) for number in odd),
        *((f"/trials?page={number}", 200) for number in ("٣", "99999999999")),
        ("/trials?sort=drop", 200),
        ("/trials/?q=rep01", 200),
        ("/trials.exe", 404),
        ("/trials/no/such/trial", 404),
        ("/sweeps/none", 404),
        ("/%3Cb%3Enowhere%3C/b%3E", 404),
    ):
        reply = client.get(address)
        assert reply.status_code == code, address
        assert "A fault" not in reply.text
        assert "<b>nowhere" not in reply.text
        assert "/?" not in str(reply.url)  # a list with a stroke behind it is the list


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


def test_nothing_long_in_an_address_is_a_fault(client):
    names = ("cell", "page", "sort", "sweep", "variant", "tactical", "planned_from", "seen", "run")
    for address in (*PLACES, "/sql"):
        for name in names:
            for value in ("9" * 5_000, "a " * 2_500):
                reply = client.get(address, params={name: value})
                assert reply.status_code < 500, (address, name, value[0])


def test_nothing_is_said_of_a_browser_that_left(study, caplog):
    scope = {
        "type": "http", "method": "POST", "path": "/notes", "query_string": b"",
        "http_version": "1.1",
        "headers": [(b"host", HOST.encode()), (b"origin", f"http://{HOST}".encode()),
                    (b"content-length", b"100")],
    }  # fmt: skip

    async def receive():
        return {"type": "http.disconnect"}

    async def send(message):
        pass

    with caplog.at_level(logging.DEBUG, "merge_runner_analysis"):
        asyncio.run(explorer(Site(study))(scope, receive, send))
    assert caplog.messages == []


def test_while_another_program_holds_the_database_the_last_list_is_shown(study, tmp_path):
    db = shutil.copy(study, tmp_path / "t.duckdb")
    # What is computed is not waited for: that process waits for the database.
    client = client_of(db, Computing(db, InProcess))
    told = "Another program holds the database"
    assert told not in client.get("/trials").text
    with held(db):
        for address in ("/trials", "/trials?condition=N_0_0", "/sweeps", "/tables"):
            reply = client.get(address)
            assert (reply.status_code, told in reply.text) == (200, True)
    assert told not in client.get("/trials").text
    client.site.close()
