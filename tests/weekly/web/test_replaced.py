"""A database that another file takes the place of, under the server, gives no error page."""

import shutil
import threading
from concurrent.futures import ThreadPoolExecutor
from itertools import product

import duckdb
import pytest

from merge_runner.results.database import SCHEMA_VERSION
from tests.support.serving import client_of, in_process
from tests.support.studies import write_study, yielding

TRIAL = "/trials/o3/baseline/N_0_0/rep01"
PAGES = ("/", "/sweeps", "/trials", TRIAL)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return write_study(tmp_path_factory.mktemp("good") / "t.duckdb", yielding("o3", reps=1))


@pytest.fixture(scope="module")
def bad(good, tmp_path_factory):
    """Contents that cannot be shown, by their names."""
    folder, content = tmp_path_factory.mktemp("bad"), good.read_bytes()
    with duckdb.connect(str(folder / "foreign.duckdb")) as connection:
        connection.execute("CREATE TABLE meta AS SELECT ? AS schema_version", [SCHEMA_VERSION])
    return {
        "garbage": b"not a database at all",
        "empty": b"",
        "half": content[: len(content) // 2],
        "zeros": bytes(len(content)),
        "foreign": (folder / "foreign.duckdb").read_bytes(),
    }


def put(db, content, *, in_place):
    """Write over a file, which keeps its inode, or put another one in its place."""
    new = db if in_place else db.with_name("new")
    new.write_bytes(content)
    new.rename(db)


@pytest.fixture
def db(good, tmp_path):
    return shutil.copy(good, tmp_path / "t.duckdb")


@pytest.mark.parametrize("what", ["garbage", "empty", "half", "zeros", "foreign"])
@pytest.mark.parametrize("in_place", list(product([True, False], repeat=2)))
def test_the_good_one_is_shown_again_after_a_plain_message(db, good, bad, what, in_place):
    client = client_of(db, in_process(db))
    assert [client.get(page).status_code for page in PAGES] == [200] * 4
    put(db, bad[what], in_place=in_place[0])
    for page in PAGES:
        reply = client.get(page)
        told = (reply.status_code, "Not now" in reply.text, str(db) in reply.text)
        assert told == (503, True, True)
    put(db, good.read_bytes(), in_place=in_place[1])
    assert [client.get(page).status_code for page in PAGES] == [200] * 4


def test_nobody_who_asks_meanwhile_gets_an_error_page(db, good, bad):
    client, codes, done = client_of(db, in_process(db)), [], threading.Event()

    def look(page):
        while not done.is_set():
            codes.append(client.get(page).status_code)

    with ThreadPoolExecutor(5) as others:
        looks = [others.submit(look, page) for page in (*PAGES, TRIAL)]
        for content in 2 * [bad["garbage"], good.read_bytes(), bad["foreign"], good.read_bytes()]:
            put(db, content, in_place=False)
            before = len(codes)
            # More answers than were under way: one of them is of this content.
            while len(codes) <= before + len(looks):
                done.wait(0.01)
        done.set()
    assert {200, 503} <= set(codes) <= {200, 404, 503}
