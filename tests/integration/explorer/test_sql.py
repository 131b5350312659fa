"""The page on which a query is written, run and read."""

from __future__ import annotations

import html
import re
import shlex
import threading
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import parse_qs, urlsplit

import pytest

from merge_runner.errors import UsageError
from merge_runner.results.export import tables
from merge_runner.results.store import query
from merge_runner_analysis.explorer.pages.sql import EXAMPLES
from merge_runner_analysis.explorer.queries import QueryResult
from tests.support.gate import HANGS_S
from tests.support.harness import PROJECT
from tests.support.serving import client_of
from tests.support.studies import write_study, yielding

FIRST = next(iter(EXAMPLES.values()))
NAVIGATION = {"sec-fetch-mode": "navigate", "sec-fetch-dest": "document"}


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
    return next(
        html.unescape(href)
        for href in re.findall(r'href="([^"]*)"', page)
        if href.startswith(start)
    )


def one_line(sql):
    return " ".join(sql.split())


def test_the_examples_are_the_queries_of_the_readme_and_run(running):
    text = (PROJECT / "README.md").read_text()
    commands = [shlex.split(line) for line in re.findall(r"^make sql Q=.*$", text, re.MULTILINE)]
    written = [command[2].removeprefix("Q=") for command in commands]
    assert [one_line(sql) for sql in EXAMPLES.values()] == written
    assert all(query(running.site.db, sql)[0] for sql in EXAMPLES.values())


def test_without_a_query_the_first_example_waits_to_be_run(client, asked):
    for address in ("/sql", "/sql?q=", "/sql?q=%0D%0A"):
        page = client.get(address)
        assert (page.status_code, box(page.text)) == (200, FIRST)
        assert 'id="result"' not in page.text
    assert asked == []
    assert parse_qs(urlsplit(link(page.text, "/sql?")).query) == {"q": [FIRST]}


@pytest.mark.parametrize(
    "sql",
    [
        "select 'é — 漢字 🙂 e\u0301'",
        "select '100 %' || '+&=#?;' -- \"<b>&amp;</textarea>",
        "select 1\n\n  , 2\t-- two\n",
        "\n\nselect 1",
        "select '\u202e\u200b\ufeff\u2028'",
    ],
)
def test_a_query_is_in_the_address_and_back_in_the_box(client, asked, sql):
    page = client.get("/sql", params={"q": sql}).text
    assert box(page) == sql
    client.get(link(page, "/sql.csv"))
    # A form sends the ends of lines like this.
    assert box(client.get("/sql", params={"q": sql.replace("\n", "\r\n")}).text) == sql
    assert asked == [sql, sql, sql]


def test_a_query_of_another_site_is_refused(client, asked):
    for site in ("cross-site", "same-site"):
        for mode in ("navigate", "no-cors"):
            headers = {"sec-fetch-site": site, "sec-fetch-mode": mode}
            for address in ("/sql?q=select+1", "/sql.csv?q=select+1"):
                assert client.get(address, headers=headers).status_code == 403
    assert asked == []
    for site in ("same-origin", "none"):
        client.get("/sql?q=select+1", headers={**NAVIGATION, "sec-fetch-site": site})
    assert asked == ["select 1", "select 1"]


@pytest.mark.parametrize("spec", [True, False])
def test_a_result_is_a_table_with_types_and_links_to_trials(client, spec):
    name = "o3/baseline/L_0_8/rep01"
    columns = {"trial_id": ("VARCHAR", name), "rep": ("INTEGER", "1")}
    columns |= {"spec_hash": ("VARCHAR", "o3-baseline")} if spec else {"x": ("INTEGER[]", None)}
    client.site.queries.found = QueryResult(
        [(name, kind) for name, (kind, _) in columns.items()],
        [[text and (text, 0) for _, text in columns.values()]],
        False,
        0.0123,
    )
    page = client.get("/sql?q=select").text
    assert '<th scope="col" class="n">rep <small>INTEGER</small>' in page
    assert '<td class="n">1</td>' in page
    assert spec or '<td><span class="quiet">NULL</span></td>' in page
    assert "<strong>1</strong> row, in 0.01 s" in page
    found = urlsplit(link(page, "/trials/"))
    assert (found.path, found.query) == (f"/trials/{name}", "spec=o3-baseline" if spec else "")


def test_a_cut_result_says_so(client):
    cut = [[("x" * 2000, 1234)]] * 2
    client.site.queries.found = QueryResult([("trial_id", "VARCHAR")], cut, True, 0.0)
    page = client.get("/sql?q=select").text
    assert "The first <strong>2</strong> rows of more" in page
    assert "… 1,234 characters more" in page
    assert 'href="/trials/' not in page


def test_nothing_in_a_result_or_an_error_is_more_than_text(running):
    text = "'<script>alert(1)</script>' || chr(8238) || chr(0)"
    for asked in (f'select {text} as x, 1 as "<img src=x>\u202e"', f"select error({text})"):
        page = running.get("/sql", params={"q": asked}).text
        shown = page[page.index('id="result"') : page.index("</section>")]
        assert "&lt;script&gt;alert(1)&lt;/script&gt;[U+202E]" in shown
        assert not re.search("<script|<img|\u202e|\0", shown)
        assert not re.search(r"\bstyle=|<style|\bon\w+=|<script(?![^>]* src=)", page)


def test_a_download_is_a_file_or_says_why_not(running):
    reply = running.get("/sql.csv", params={"q": "select 1 as x, 'a' as y"})
    assert (reply.status_code, reply.text) == (200, "x,y\n1,a\n")
    assert reply.headers["content-type"] == "text/csv; charset=utf-8"
    assert reply.headers["content-disposition"] == 'attachment; filename="query.csv"'
    reply = running.get("/sql.csv", params={"q": "selekt"})
    assert reply.status_code == 503
    assert "syntax error at or near &#34;selekt&#34;</p>" in reply.text


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
    rows = query(
        client.site.db,
        "SELECT table_name, list(column_name ORDER BY column_index) FROM duckdb_columns() "
        "WHERE NOT internal AND database_name = current_database() GROUP BY ALL",
    )[1]
    shown = {name: [column.name for column in table.columns] for name, table in found.items()}
    assert shown == dict(rows)
    assert found["attempts"].comment.startswith("The ledger of attempts")
    columns = {column.name: column for column in found["states"].columns}
    assert columns["time_s"].kind == "DOUBLE"
    assert columns["time_s"].comment == "0 where the drivers take control"
    page = client.get("/sql").text
    assert page.count('<details class="schema"') == len(found)
    assert "<strong>trial_metrics</strong>" in page
