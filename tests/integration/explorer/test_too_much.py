"""Addresses that ask for more than a query may hold, and browsers that leave."""

from __future__ import annotations

import asyncio
import logging

import pytest
from starlette.testclient import TestClient

from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.site import Site
from tests.support.studies import write_study, yielding

HOST = "127.0.0.1:8700"
PLACES = ("/trials", "/trials.csv", "/words")


@pytest.fixture(scope="module")
def app(tmp_path_factory):
    folder = tmp_path_factory.mktemp("much")
    site = Site(write_study(folder / "t.duckdb", yielding("o3", reps=1)[:2]))
    site.refresh()
    return explorer(site)


@pytest.fixture
def client(app):
    return TestClient(app, base_url=f"http://{HOST}")


@pytest.mark.parametrize("address", PLACES)
@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"q": "a " * 1_100}, "up to 12 words and 300 characters, this one 1,100 and 2,200"),
        ({"q": "b" * 301}, "up to 12 words and 300 characters"),
        ({f"factor.f{i}": "x" for i in range(1_100)}, "up to 30 parts"),
        ({"model": "x" * 60_000}, "of up to 1,000 characters"),
    ],
)
def test_a_filter_that_is_too_long_is_refused_in_a_line(client, caplog, address, asked, said):
    reply = client.get(address, params=asked)
    assert (reply.status_code, said in reply.text) == (400, True)
    assert caplog.messages == []


@pytest.mark.parametrize("address", PLACES)
def test_a_search_as_long_as_it_may_be_is_answered(client, address):
    words = " ".join("x" * 24 for _ in range(12))
    assert client.get(address, params={"q": words, "model": "x" * 1_000}).status_code == 200


@pytest.mark.parametrize("address", [*PLACES, "/sql"])
def test_nothing_long_in_an_address_is_a_fault(client, address):
    names = ("cell", "page", "sort", "sweep", "variant", "tactical", "planned_from", "seen", "run")
    for name in names:
        for value in ("9" * 5_000, "a " * 2_500):
            assert client.get(address, params={name: value}).status_code < 500, name


def test_nothing_is_said_of_a_browser_that_left(app, caplog):
    scope = {
        "type": "http", "method": "POST", "path": "/notes", "query_string": b"",
        "http_version": "1.1",
        "headers": [(b"host", HOST.encode()), (b"origin", f"http://{HOST}".encode()),
                    (b"content-length", b"100")],
    }  # fmt: skip
    sent = []

    async def receive():
        return {"type": "http.disconnect"}

    async def send(message):
        sent.append(message)

    with caplog.at_level(logging.DEBUG, "merge_runner_analysis"):
        asyncio.run(app(scope, receive, send))
    assert caplog.messages == []
