"""A database that another file takes the place of, under the server, gives no error page."""

from __future__ import annotations

import os
import shutil
import threading

import duckdb
import pytest
from starlette.testclient import TestClient

from merge_runner.results.database import SCHEMA_VERSION
from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.site import Site
from tests.support.studies import write_study, yielding

HOST = "127.0.0.1:8700"
TRIAL = "/trials/o3/baseline/N_0_0/rep01"
PAGES = ("/", "/sweeps", "/trials", TRIAL)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return write_study(tmp_path_factory.mktemp("good") / "t.duckdb", yielding("o3", reps=1))


@pytest.fixture(scope="module")
def bad(good, tmp_path_factory):
    """Files that are no database of ours, by what is wrong with them."""
    whole = good.read_bytes()
    foreign = tmp_path_factory.mktemp("bad") / "foreign.duckdb"
    with duckdb.connect(str(foreign)) as connection:
        connection.execute(f"CREATE TABLE meta AS SELECT {SCHEMA_VERSION} AS schema_version")
    return {
        "garbage": b"garbage" * 1000,
        "empty": b"",
        "half": whole[: len(whole) // 2],
        "zeros": whole[:12288] + bytes(len(whole) - 12288),
        "foreign": foreign.read_bytes(),
    }


def put(db, content, *, in_place):
    """Write over a file, which keeps its inode, or put another one in its place."""
    if in_place:
        db.write_bytes(content)
        return
    new = db.with_name("new")
    new.write_bytes(content)
    os.replace(new, db)


@pytest.fixture
def db(good, tmp_path):
    return shutil.copy(good, tmp_path / "t.duckdb")


@pytest.fixture
def client(db):
    application = explorer(Site(db))
    return TestClient(application, base_url=f"http://{HOST}", raise_server_exceptions=False)


@pytest.mark.parametrize("what", ["garbage", "empty", "half", "zeros", "foreign"])
@pytest.mark.parametrize("back_in_place", [True, False])
@pytest.mark.parametrize("in_place", [True, False])
def test_the_good_one_is_shown_again_after_a_plain_message(
    client, db, good, bad, what, in_place, back_in_place
):
    assert [client.get(page).status_code for page in PAGES] == [200] * 4
    put(db, bad[what], in_place=in_place)
    for page in PAGES:
        reply = client.get(page)
        assert (reply.status_code, "Not now" in reply.text) == (503, True)
        assert str(db) in reply.text
    put(db, good.read_bytes(), in_place=back_in_place)
    assert [client.get(page).status_code for page in PAGES] == [200] * 4


def test_nobody_who_asks_meanwhile_gets_an_error_page(client, db, good, bad):
    codes, done = [], threading.Event()

    def look(page):
        while not done.is_set():
            codes.append(client.get(page).status_code)

    threads = [threading.Thread(target=look, args=(page,)) for page in (*PAGES, TRIAL)]
    for thread in threads:
        thread.start()
    for content in 2 * [bad["garbage"], good.read_bytes(), bad["foreign"], good.read_bytes()]:
        put(db, content, in_place=False)
        before = len(codes)
        # More answers than were under way: one of them is of this content.
        while len(codes) <= before + len(threads):
            done.wait(0.01)
    done.set()
    for thread in threads:
        thread.join()
    assert set(codes) >= {200, 503}
    assert set(codes) <= {200, 404, 503}
