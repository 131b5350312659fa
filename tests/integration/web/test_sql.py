"""The page on which a query is written, run and read."""

import html
import re
import threading
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import parse_qs, urlsplit

import pytest

from merge_runner.errors import UsageError
from merge_runner.results.export import tables
from merge_runner.results.store import query
from merge_runner_analysis.web.pages.sql import EXAMPLES
from merge_runner_analysis.web.queries import QueryResult
from tests.support.gate import HANGS_S
from tests.support.serving import client_of
from tests.support.studies import write_study, yielding


class Asked:
    """Runs no query: it finds ``found``, and keeps what was asked."""

    found = QueryResult([("x", "INTEGER")], [[("1", 0)]], False, 0.0)

    def __init__(self):
        self.queries = []

    def result(self, sql):
        self.queries.append(sql)
        return self.found

    def csv(self, sql):
        self.queries.append(sql)
        return "x\n1\n"


@pytest.fixture(scope="module")
def running(tmp_path_factory):
    """A client whose queries are run."""
    folder = tmp_path_factory.mktemp("sql")
    client = client_of(write_study(folder / "study.duckdb", yielding("o3", reps=1)[:2]))
    client.site.queries.longest_s = HANGS_S  # others may use the machine
    return client


@pytest.fixture
def client(running):
    """A client whose queries are only asked."""
    client = client_of(running.site.db)
    client.site.queries = Asked()
    return client


@pytest.fixture
def asked(client):
    return client.site.queries.queries


def box(page):
    """What stands in the box, as a browser reads it."""
    text = re.search(r"<textarea[^>]*>(.*?)</textarea>", page, re.DOTALL)[1]
    return html.unescape(text.removeprefix("\n"))


def link(page, start):
    found = map(html.unescape, re.findall(r'href="([^"]*)"', page))
    return next(href for href in found if href.startswith(start))


def test_the_examples_have_results_and_the_first_waits_to_be_run(running, client, asked):
    assert all(query(running.site.db, sql)[0] for sql in EXAMPLES.values())
    first = next(iter(EXAMPLES.values()))
    for address in ("/sql", "/sql?q=", "/sql?q=%0D%0A"):
        page = client.get(address).text
        assert (box(page), 'id="result"' in page) == (first, False)
    assert parse_qs(urlsplit(link(page, "/sql?")).query) == {"q": [first]}
    assert asked == []


def test_a_query_is_in_the_address_and_back_in_the_box(client, asked):
    sql = "\n\nselect 'é — 🙂 e\u0301'\n\n || '+&=#?;\u202e\u200b\u2028' -- \"<b>&amp;</textarea>\n"
    page = client.get("/sql", params={"q": sql}).text
    assert box(page) == sql
    client.get(link(page, "/sql.csv"))
    # A form sends the ends of lines like this.
    assert box(client.get("/sql", params={"q": sql.replace("\n", "\r\n")}).text) == sql
    assert asked == [sql, sql, sql]


def test_a_query_of_another_site_is_refused(client, asked):
    def status(address, site, mode):
        return client.get(address, headers={"sec-fetch-site": site, "sec-fetch-mode": mode})

    for site in ("cross-site", "same-site"):
        for address in ("/sql?q=select+1", "/sql.csv?q=select+1"):
            for mode in ("navigate", "no-cors"):
                assert status(address, site, mode).status_code == 403
    assert asked == []
    for site in ("same-origin", "none"):
        status("/sql?q=select+1", site, "navigate")
    assert asked == ["select 1", "select 1"]


@pytest.mark.parametrize("spec", [True, False])
def test_a_result_is_a_table_with_types_and_links_to_trials(client, spec):
    name = "o3/baseline/L_0_8/rep01"
    columns = [("trial_id", "VARCHAR"), ("rep", "INTEGER"),
               ("spec_hash", "VARCHAR") if spec else ("x", "INTEGER[]")]  # fmt: skip
    row = [(name, 0), ("1", 0), ("o3-baseline", 0) if spec else None]
    client.site.queries.found = QueryResult(columns, [row], False, 0.0123)
    page = client.get("/sql?q=select").text
    assert '<th scope="col" class="n" title="INTEGER">rep</th>' in page
    assert '<td class="n">1</td>' in page
    assert spec or '<td><span class="quiet">NULL</span></td>' in page
    assert "<strong>1</strong> row, in 0.01 s" in page
    found = urlsplit(link(page, "/trials/"))
    assert (found.path, found.query) == (f"/trials/{name}", "spec=o3-baseline" if spec else "")
    cut = [[("x" * 2000, 1234)]] * 2
    client.site.queries.found = QueryResult([("trial_id", "VARCHAR")], cut, True, 0.0)
    page = client.get("/sql?q=select").text
    assert "The first <strong>2</strong> rows of more" in page
    assert "… 1,234 characters more" in page
    assert 'href="/trials/' not in page


def test_nothing_in_a_result_or_an_error_is_more_than_text_and_a_download_is_a_file(running):
    text = "'<script>alert(1)</script>' || chr(8238) || chr(0)"
    for asked in (f'select {text} as x, 1 as "<img src=x>\u202e"', f"select error({text})"):
        page = running.get("/sql", params={"q": asked}).text
        shown = page[page.index('id="result"') : page.index("</section>")]
        assert "&lt;script&gt;alert(1)&lt;/script&gt;[U+202E]" in shown
        assert not re.search("<script|<img|\u202e|\0", shown)
        assert not re.search(r"\bstyle=|<style|\bon\w+=|<script(?![^>]* src=)", page)
    reply = running.get("/sql.csv", params={"q": "select 1 as x, 'a' as y"})
    assert (reply.status_code, reply.text) == (200, "x,y\n1,a\n")
    assert reply.headers["content-type"] == "text/csv; charset=utf-8"
    assert reply.headers["content-disposition"] == 'attachment; filename="query.csv"'
    reply = running.get("/sql.csv", params={"q": "selekt"})
    said = "syntax error at or near &#34;selekt&#34;"
    assert (reply.status_code, said in reply.text) == (503, True)


def test_a_slow_query_keeps_nobody_waiting(client):
    runs, answered = threading.Event(), threading.Event()

    class Slow(Asked):
        def result(self, sql):
            runs.set()
            assert answered.wait(HANGS_S)
            raise UsageError("stopped after 10 s")

    client.site.queries = Slow()
    with ThreadPoolExecutor() as others:
        slow = others.submit(client.get, "/sql?q=select")
        assert runs.wait(HANGS_S)
        assert client.get("/sql").status_code == 200
        assert client.get("/trials").status_code == 200
        assert not slow.done()
        answered.set()
        assert "stopped after 10 s" in slow.result().text


def test_the_schema_stands_beside_with_what_is_said_of_it(client):
    found = {table.name: table for table in tables()}
    sql = (
        "SELECT table_name, list(column_name ORDER BY column_index) FROM duckdb_columns() "
        "WHERE NOT internal AND database_name = current_database() GROUP BY ALL"
    )
    shown = {name: [column.name for column in table.columns] for name, table in found.items()}
    assert shown == dict(query(client.site.db, sql)[1])
    assert found["attempts"].comment.startswith("One row per attempt")
    (time,) = (column for column in found["states"].columns if column.name == "time_s")
    assert (time.kind, time.comment) == ("DOUBLE", "0 at the start of control")
    page = client.get("/sql").text
    assert page.count('<details class="schema"') == len(found)
    assert "<strong>trial_metrics</strong>" in page
