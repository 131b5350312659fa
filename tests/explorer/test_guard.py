"""Who may ask, and what a page may do."""

from __future__ import annotations

import re

import pytest
from starlette.testclient import TestClient

from analysis.explorer.app import explorer
from analysis.explorer.server import names_of
from analysis.explorer.site import Site
from merge_runner.errors import UsageError

HOST = "127.0.0.1:8700"


@pytest.fixture
def client(study):
    with TestClient(explorer(Site(study), {HOST}), base_url=f"http://{HOST}") as client:
        yield client


@pytest.mark.parametrize(
    "headers",
    [
        {"host": "evil.example:8700"},
        {"host": "127.0.0.1:8701"},
        {"host": "127.0.0.1"},
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"sec-fetch-site": "cross-site", "sec-fetch-mode": "cors"},
    ],
)
def test_another_name_or_another_sites_page_is_refused(client, headers):
    assert client.get("/trials", headers=headers).status_code == 403


def test_ours_and_a_link_from_elsewhere_are_answered(client):
    for headers in (
        {},
        {"origin": f"http://{HOST}"},
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


@pytest.fixture
def with_token(study):
    """What answers at one address of many, or with ``0.0.0.0`` at all, to who has the token."""

    def client(host, *hosts):
        app = explorer(Site(study), hosts or {host}, token="the-token")
        return TestClient(app, base_url=f"http://{host}", follow_redirects=False)

    return client


def test_at_another_address_one_needs_the_token(with_token):
    client = with_token("10.0.0.5:8700")
    assert client.get("/trials").status_code == 403
    assert client.get("/trials?token=another").status_code == 403
    assert client.get("/trials?token=anöther").status_code == 403
    told = client.get("/trials?token=the-token&model=o3")
    assert (told.status_code, told.headers["location"]) == (303, "/trials?model=o3")
    assert "httponly" in told.headers["set-cookie"].lower()
    assert client.get("/trials").status_code == 200


@pytest.mark.parametrize(
    ("cookie", "code"),
    [
        (b"merge-runner-8700=the-token", 200),
        (b'bad(=1; {"a": "b=c"}; n\xf6; x="y;merge-runner-8700=the-token', 200),
        (b"merge-runner-8700=old; merge-runner-8700=the-token", 200),
        (b"merge-runner-8700=th\xe9-token", 403),
        (b"merge-runner-8700", 403),
        (b"merge-runner-8701=the-token", 403),
        (b"not-merge-runner-8700=the-token", 403),
        (b"a=merge-runner-8700=the-token", 403),
    ],
)
def test_the_cookie_is_found_among_those_of_other_programs(with_token, cookie, code):
    client = with_token("10.0.0.5:8700")
    assert client.get("/trials", headers={b"cookie": cookie}).status_code == code


def test_two_explorers_on_one_host_keep_their_cookies_apart(with_token):
    said = [
        with_token(f"10.0.0.5:{port}").get("/?token=the-token").headers["set-cookie"]
        for port in (8700, 8701)
    ]
    assert [cookie.partition("=")[0] for cookie in said] == [
        "merge-runner-8700",
        "merge-runner-8701",
    ]


@pytest.mark.parametrize(
    ("hosts", "asked", "answered"),
    [
        (["10.0.0.5:8700"], "10.0.0.5:8700", True),
        (["10.0.0.5:8700"], "10.0.0.6:8700", False),
        (["10.0.0.5:8700"], "evil.example:8700", False),
        (["10.0.0.5:8700"], "10.0.0.5:8701", False),
        (["10.0.0.5:8700"], "10.0.0.5", False),
        (["10.0.0.5:80"], "10.0.0.5", True),
        (["[::1]:80"], "[::1]", True),
        (["0.0.0.0:8700", "box:8700"], "10.0.0.5:8700", True),
        (["0.0.0.0:8700", "box:8700"], "box:8700", True),
        (["0.0.0.0:8700", "box:8700"], "evil.example:8700", False),
        (["0.0.0.0:8700", "box:8700"], "10.0.0.5.evil.example:8700", False),
        (["0.0.0.0:8700", "box:8700"], "10.0.0.5:8701", False),
        (["0.0.0.0:80"], "10.0.0.5", True),
        (["[::]:8700"], "[fe80::1]:8700", True),
        (["[::]:8700"], "evil.example:8700", False),
    ],
)
def test_with_the_token_too_the_host_is_one_of_ours(with_token, hosts, asked, answered):
    reply = with_token(asked, *hosts).get("/trials?token=the-token")
    assert reply.status_code == (303 if answered else 403)
    assert answered or "this host name" in reply.text


@pytest.mark.parametrize(
    ("bind", "address", "names"),
    [
        ("127.0.0.1", "127.0.0.1", ["127.0.0.1", "localhost"]),
        ("localhost", "127.0.0.1", ["localhost", "127.0.0.1"]),
        ("::1", "::1", ["[::1]", "localhost"]),
        ("10.0.0.5", "10.0.0.5", ["10.0.0.5"]),
        ("Box", "10.0.0.5", ["box", "10.0.0.5"]),
        ("FE80::5", "fe80::5", ["[fe80::5]"]),
        ("0.0.0.0", "0.0.0.0", ["127.0.0.1", "0.0.0.0", "localhost", "box", "box.lan"]),
        ("", "0.0.0.0", ["127.0.0.1", "0.0.0.0", "localhost", "box", "box.lan"]),
        ("::", "::", ["[::1]", "[::]", "localhost", "box", "box.lan"]),
    ],
)
def test_the_names_are_those_under_which_it_is_reached(monkeypatch, bind, address, names):
    monkeypatch.setattr("socket.gethostname", lambda: "Box")
    monkeypatch.setattr("socket.getfqdn", lambda: "box.lan")
    assert list(dict.fromkeys(names_of(bind, address))) == names


def test_a_database_that_is_not_there_is_told(tmp_path):
    with pytest.raises(UsageError, match="`merge-runner sweep baseline`"):
        Site(tmp_path / "none.duckdb").catalogue.refresh()


def test_while_the_trials_are_read_for_the_first_time_a_page_says_so(study, monkeypatch):
    site = Site(study)
    monkeypatch.setattr(Site, "beginning", True)
    with TestClient(explorer(site, {HOST}), base_url=f"http://{HOST}") as client:
        reply = client.get("/trials")
    assert "Reading the trials" in reply.text
    assert reply.headers["refresh"] == "1"


def test_a_fault_is_one_line_and_the_other_pages_go_on(study, monkeypatch, caplog):
    site = Site(study)
    monkeypatch.setattr("analysis.explorer.pages.sweep.sweeps_page", lambda *_, **__: 1 / 0)
    app = explorer(site, {HOST})
    with TestClient(app, base_url=f"http://{HOST}", raise_server_exceptions=False) as client:
        reply = client.get("/sweeps")
        assert reply.status_code == 500
        assert "A fault of the explorer: ZeroDivisionError" in reply.text
        assert client.get("/trials").status_code == 200
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == [
        "/sweeps: a fault of the explorer: ZeroDivisionError('division by zero')"
    ]
