"""The page on which a query is written, run and read."""

from __future__ import annotations

import html
import re
import shlex
import threading
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import parse_qs, urlsplit

import pytest
from starlette.testclient import TestClient

from merge_runner.errors import UsageError
from merge_runner.results.export import tables
from merge_runner.results.store import query
from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.pages.sql import EXAMPLES
from merge_runner_analysis.explorer.queries import QueryResult
from merge_runner_analysis.explorer.site import Site
from tests.support.harness import PROJECT
from tests.support.studies import write_study, yielding

HOST = "127.0.0.1:8700"
FIRST = next(iter(EXAMPLES.values()))
NAVIGATION = {"sec-fetch-mode": "navigate", "sec-fetch-dest": "document"}


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sql")
    site = Site(write_study(folder / "study.duckdb", yielding("o3", reps=1)[:2]))
    site.queries.longest_s = 60  # others may use the machine
    return site


@pytest.fixture
def client(site):
    with TestClient(explorer(site), base_url=f"http://{HOST}") as client:
        yield client


@pytest.fixture
def asked(site, monkeypatch):
    """The queries that would have been run; each finds one row."""
    queries = []

    def result(sql):
        queries.append(sql)
        return QueryResult([("x", "INTEGER")], [[("1", 0)]], False, 0.0)

    monkeypatch.setattr(site.queries, "result", result)
    monkeypatch.setattr(site.queries, "csv", lambda sql: queries.append(sql) or "x\n1\n")
    return queries


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


def test_the_examples_are_the_queries_of_the_readme_and_run(site):
    text = (PROJECT / "README.md").read_text()
    commands = [shlex.split(line) for line in re.findall(r"^make sql Q=.*$", text, re.MULTILINE)]
    written = [command[2].removeprefix("Q=") for command in commands]
    assert [one_line(sql) for sql in EXAMPLES.values()] == written
    assert all(query(site.db, sql)[0] for sql in EXAMPLES.values())


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
def test_a_result_is_a_table_with_types_and_links_to_trials(client, site, monkeypatch, spec):
    name = "o3/baseline/L_0_8/rep01"
    columns = {"trial_id": ("VARCHAR", name), "rep": ("INTEGER", "1")}
    columns |= {"spec_hash": ("VARCHAR", "o3-baseline")} if spec else {"x": ("INTEGER[]", None)}
    result = QueryResult(
        [(name, kind) for name, (kind, _) in columns.items()],
        [[text and (text, 0) for _, text in columns.values()]],
        False,
        0.0123,
    )
    monkeypatch.setattr(site.queries, "result", lambda sql: result)
    page = client.get("/sql?q=select").text
    assert '<th scope="col" class="n">rep <small>INTEGER</small>' in page
    assert '<td class="n">1</td>' in page
    assert spec or '<td><span class="quiet">NULL</span></td>' in page
    assert "<strong>1</strong> row, in 0.01 s" in page
    found = urlsplit(link(page, "/trials/"))
    assert (found.path, found.query) == (f"/trials/{name}", "spec=o3-baseline" if spec else "")


def test_a_cut_result_says_so(client, site, monkeypatch):
    result = QueryResult([("trial_id", "VARCHAR")], [[("x" * 2000, 1234)]] * 2, True, 0.0)
    monkeypatch.setattr(site.queries, "result", lambda sql: result)
    page = client.get("/sql?q=select").text
    assert "The first <strong>2</strong> rows of more" in page
    assert "… 1,234 characters more" in page
    assert 'href="/trials/' not in page


def test_nothing_in_a_result_or_an_error_is_more_than_text(client, site, monkeypatch):
    hostile = "'<script>alert(1)</script>' || chr(8238) || chr(0)"
    address = {"q": f'select {hostile} as x, 1 as "<img src=x>\u202e"'}
    pages = [client.get("/sql", params=address).text]

    def failing(sql):
        raise UsageError("no <script>alert(1)</script>\u202e\0")

    monkeypatch.setattr(site.queries, "result", failing)
    pages.append(client.get("/sql", params=address).text)
    for page in pages:
        shown = page[page.index('id="result"') : page.index("</section>")]
        assert "&lt;script&gt;alert(1)&lt;/script&gt;[U+202E][U+0000]" in shown
        assert not re.search("<script|<img|\u202e|\0", shown)


def test_the_page_holds_no_style_and_no_script_of_its_own(client, asked):
    page = client.get("/sql?q=select+1").text
    assert not re.search(r"\bstyle=|<style|\bon\w+=|<script(?![^>]* src=)", page)
    assert "style-src 'self'" in client.get("/sql").headers["content-security-policy"]


@pytest.mark.slow
def test_a_download_is_a_file_or_says_why_not(client):
    reply = client.get("/sql.csv", params={"q": "select 1 as x, 'a' as y"})
    assert (reply.status_code, reply.text) == (200, "x,y\n1,a\n")
    assert reply.headers["content-type"] == "text/csv; charset=utf-8"
    assert reply.headers["content-disposition"] == 'attachment; filename="query.csv"'
    reply = client.get("/sql.csv", params={"q": "selekt"})
    assert reply.status_code == 503
    assert "syntax error at or near &#34;selekt&#34;</p>" in reply.text


def test_a_slow_query_keeps_nobody_waiting(client, site, monkeypatch):
    running, answered = threading.Event(), threading.Event()

    def result(sql):
        running.set()
        assert answered.wait(60)
        raise UsageError("stopped after 10 s")

    monkeypatch.setattr(site.queries, "result", result)
    with ThreadPoolExecutor() as others:
        slow = others.submit(client.get, "/sql?q=select")
        assert running.wait(60)
        assert client.get("/sql").status_code == 200
        assert client.get("/trials").status_code == 200
        assert not slow.done()
        answered.set()
        assert "stopped after 10 s" in slow.result().text


def test_the_schema_stands_beside_with_what_is_said_of_it(site, client, asked):
    found = {table.name: table for table in tables()}
    rows = query(
        site.db,
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
