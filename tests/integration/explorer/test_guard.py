"""Who may ask, and what a page may do."""

from __future__ import annotations

import re

import pytest
from starlette.testclient import TestClient

from merge_runner.errors import UsageError
from merge_runner_analysis.explorer.app import PAGES, explorer, listen
from merge_runner_analysis.explorer.site import Site

HOST = "127.0.0.1:8700"


@pytest.fixture
def client(study):
    with TestClient(explorer(Site(study)), base_url=f"http://{HOST}") as client:
        yield client


@pytest.mark.parametrize(
    "headers",
    [
        {"host": "evil.example:8700"},
        {"host": "127.0.0.1.evil.example:8700"},
        {"host": "evil.example:8700", "origin": "http://evil.example:8700"},
        {"origin": "http://evil.example"},
        {"origin": "http://127.0.0.1:8701"},
        {"origin": "null"},
        {"sec-fetch-site": "cross-site", "sec-fetch-mode": "cors"},
    ],
)
def test_another_name_or_another_sites_page_is_refused(client, headers):
    reply = client.get("/trials", headers=headers)
    assert reply.status_code == (400 if "host" in headers else 403)
    assert "content-security-policy" in reply.headers


def test_ours_and_a_link_from_elsewhere_are_answered(client):
    for headers in (
        {},
        {"origin": f"http://{HOST}"},
        {"host": "localhost:9000", "origin": "http://localhost:9000"},  # through ssh -L
        {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"},
    ):
        assert client.get("/trials", headers=headers).status_code == 200


@pytest.mark.parametrize("address", ["/trials", "/nowhere", "/static/keys.js"])
def test_no_page_runs_what_is_not_a_file_of_ours(client, address):
    policy = client.get(address).headers["content-security-policy"]
    assert "default-src 'none'; script-src 'self'; style-src 'self'" in policy
    assert "unsafe" not in policy
    text = client.get(address).text
    assert not re.search(r"<script(?![^>]*(src=|application/json))|\son[a-z]+=|style=", text) or (
        address.startswith("/static")
    )


def test_what_is_not_there_is_said_and_no_markup_of_the_address_is_kept(client):
    reply = client.get("/<b>nowhere</b>")
    assert reply.status_code == 404
    assert "there is no page" in reply.text
    assert "<b>nowhere" not in reply.text


def test_the_explorer_is_bound_to_loopback_alone():
    with listen(0) as listener:
        assert listener.getsockname()[0] == "127.0.0.1"


def test_a_database_that_is_not_there_is_told(tmp_path):
    with pytest.raises(UsageError, match="`merge-runner sweep baseline`"):
        Site(tmp_path / "none.duckdb").catalogue.refresh()


def test_while_the_trials_are_read_for_the_first_time_a_page_says_so(study, monkeypatch):
    site = Site(study)
    monkeypatch.setattr(Site, "beginning", True)
    with TestClient(explorer(site), base_url=f"http://{HOST}") as client:
        reply = client.get("/trials")
    assert "Reading the trials" in reply.text
    assert reply.headers["refresh"] == "1"


def test_a_fault_is_one_line_and_the_other_pages_go_on(study, monkeypatch, caplog):
    site = Site(study)
    monkeypatch.setitem(PAGES, "/sweeps", lambda *_: 1 / 0)
    app = explorer(site)
    with TestClient(app, base_url=f"http://{HOST}", raise_server_exceptions=False) as client:
        reply = client.get("/sweeps")
        assert reply.status_code == 500
        assert "A fault of the explorer: ZeroDivisionError" in reply.text
        assert client.get("/trials").status_code == 200
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == [
        "/sweeps: a fault of the explorer: ZeroDivisionError('division by zero')"
    ]
