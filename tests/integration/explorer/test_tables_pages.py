"""Tables, figures and prompts in the explorer: every number leads to its trials."""

from __future__ import annotations

import os
import re
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from urllib.parse import parse_qs, urlsplit

import duckdb
import pytest
from starlette.testclient import TestClient

from merge_runner.errors import UsageError
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.explain import explain
from merge_runner_analysis.explorer import computing as worker
from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.computing import Computing, Numbers, Worker
from merge_runner_analysis.explorer.display_text import with_minus
from merge_runner_analysis.explorer.reading import stamp_of
from merge_runner_analysis.explorer.site import Site
from merge_runner_analysis.tables import make_tables
from merge_runner_analysis.tables.formats import printed
from tests.support.gate import HANGS_S
from tests.support.studies import Said, write_study, yielding

HERE = "127.0.0.1:8700"
HOSTILE = '<img src=x onerror="alert(1)">'


class InProcess(Worker):
    """Computes in a thread of this process."""

    def __init__(self, db):
        self._numbers = Numbers(db)
        self._pool = ThreadPoolExecutor(1)

    def answer(self, request):
        return self._numbers.answer(request)

    def submit(self, request):
        return self._pool.submit(self.answer, request)

    def close(self):
        self._pool.shutdown(wait=False, cancel_futures=True)


class Awaited(Computing):
    """Has a page wait for what is computed, so that it need not be asked again and again."""

    def ask(self, request, state, wait_s=0.0):
        return super().ask(request, state, HANGS_S)


class Addresses(HTMLParser):
    """All addresses of a page, and its attributes of style and script."""

    def __init__(self, text):
        super().__init__()
        self.to, self.inline = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        for name, value in attrs:
            if name == "href":
                self.to.append(value)
            if name == "style" or name.startswith("on"):
                self.inline.append((tag, name))


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    """o3 with a variant that did some trials otherwise and lost one; a hostile name."""
    variant = yielding("o3", "A1", reps=2)
    variant[0] = replace(variant[0], left=(0.0,), right=(0.0,))
    variant[3] = replace(variant[3], left=(0.0,), right=(0.5,) * 3)
    variant[7] = replace(variant[7], left=variant[7].right, right=variant[7].left)
    lost = replace(variant[4], said={1: Said(("timeout",), lost=True)})
    drives = [
        *yielding("o3", reps=3),
        *variant[:4],
        lost,
        *variant[5:],
        *yielding(HOSTILE, reps=1),
    ]
    return write_study(tmp_path_factory.mktemp("pages") / "study.duckdb", drives)


@pytest.fixture(scope="module")
def site(db):
    site = Site(db)
    site.computing = Awaited(db, InProcess)
    yield site
    site.computing.close()


@pytest.fixture(scope="module")
def ask(site):
    """Gets a page; returns its text."""
    client = TestClient(explorer(site), base_url=f"http://{HERE}")

    def get(address, code=200):
        reply = client.get(address)
        assert reply.status_code == code, reply.text
        return reply.text

    return get


def listed(text):
    """How many trials a list says there are."""
    return int(re.search(r"<strong>(\d+)</strong> trials", text)[1])


@pytest.mark.long
@pytest.mark.parametrize(("name", "every"), [("ablation-quantitative", 3), ("contrasts", 9)])
def test_every_number_leads_to_the_trials_that_explain_names(ask, db, name, every):
    study = Study(db)
    (table,) = make_tables(study, [name])
    links = [a for a in Addresses(ask(f"/tables/{name}")).to if a.startswith("/trials?cell=")]
    assert len(links) > 20
    for link in links[::every]:
        (cell,) = parse_qs(urlsplit(link).query)["cell"]
        assert cell.startswith(f"{name}/")
        found = explain(study, table, cell.removeprefix(f"{name}/"))
        page = ask(link)
        counted = any(c.counts for c in table.columns if cell.endswith(f":{c.name}"))
        assert listed(page) == sum(
            len(source.numerator if counted else source.trials) for source in found.sources
        )
        assert found.value in unescape(page)


def test_a_table_leaves_out_columns_by_its_address(ask):
    text, shorter = ask("/tables/attempts"), ask("/tables/attempts?without=calls")
    assert shorter.count('<th scope="col"') == text.count('<th scope="col"') - 1


def test_facets_sorting_and_exports_keep_the_cell(ask):
    cell = "attempts/o3/A1:lost"
    text = ask(f"/trials?cell={cell}")
    assert listed(text) == 1
    kept = [a for a in Addresses(text).to if a.startswith(("/trials?", "/trials."))]
    assert len(kept) >= 8
    assert all(parse_qs(urlsplit(a).query)["cell"] == [cell] for a in kept)
    assert f'name="cell" value="{cell}"' in text
    assert listed(ask(f"/trials?cell={cell}&outcome=collided")) == 0
    assert len(ask(f"/trials.csv?cell={cell}").splitlines()) == 2


@pytest.mark.slow
def test_the_query_of_a_cell_leads_to_the_page_of_queries_and_finds_its_trials(ask):
    page = ask("/trials?cell=ablation-quantitative/o3/A1:gap_m")
    (link,) = (address for address in Addresses(page).to if address.startswith("/sql?q="))
    assert f"<strong>{listed(page)}</strong> rows" in ask(link)


def test_a_cell_that_is_none_says_so(ask):
    for address in ("/trials", "/trials.csv"):
        row = unescape(ask(f"{address}?cell=attempts/nobody:n", 404))
        assert "unknown row of attempts 'nobody'" in row
        column = unescape(ask(f"{address}?cell=attempts/o3/A1:nothing", 404))
        assert "unknown column of attempts 'nothing'" in column
    assert "TABLE/ROW:COLUMN" in ask("/trials?cell=nothing", 404)
    assert "who-first" in ask("/tables/nothing", 404)


def test_a_page_that_waits_for_a_cell_that_is_none_is_loaded_anew_and_says_so_at_once(db):
    asked = []

    class Counting(InProcess):
        def answer(self, request):
            asked.append(request)
            return super().answer(request)

    site = Site(db)
    site.computing = Computing(db, Counting)
    client = TestClient(explorer(site), base_url=f"http://{HERE}")
    address = "/trials?cell=attempts/nobody:n"
    while (waited := client.get(address)).status_code == 200:
        pass
    assert (waited.status_code, waited.headers["hx-refresh"]) == (404, "true")
    assert client.get(address).status_code == 404
    assert len(asked) == 1
    site.computing.close()


def test_that_a_cell_is_none_stands_as_long_as_the_state_that_it_was_looked_for_in(db):
    found = [{"absent": "no such row"}, {"value": "7"}]

    class Once(InProcess):
        def answer(self, request):
            return found.pop(0)

    computing = Computing(db, Once)
    cell = ("cell", "attempts", "o3/A9", "n")
    for state, content in (((1, 1), found[0]), ((1, 1), found[0]), ((2, 2), found[1])):
        assert computing.ask(cell, state, wait_s=5).content == content
    computing.close()


def test_the_database_is_read_anew_where_it_changed(db):
    first = worker.numbers(db, stamp_of(db))
    assert worker.numbers(db, stamp_of(db)) is first
    os.utime(db)
    assert worker.numbers(db, stamp_of(db)) is not first


def test_discordant_trials_are_the_pairs_that_differ(ask, db):
    text = ask("/discordant?model=o3&variant=A1")
    with duckdb.connect(str(db), read_only=True) as connection:
        pairs = connection.execute(
            "SELECT a.trial_id, b.trial_id FROM trials AS a JOIN trials AS b "
            "ON a.condition = b.condition AND a.rep = b.rep AND a.model_left = b.model_left "
            "WHERE a.model_left = 'o3' AND a.variant = 'A1' AND b.variant = 'baseline' "
            "AND (a.status, a.merged_first) IS DISTINCT FROM (b.status, b.merged_first)"
        ).fetchall()
    assert len(pairs) >= 3
    shown = [
        (
            urlsplit(a).path.removeprefix("/trials/"),
            parse_qs(urlsplit(a).query)["compare"][0].partition("@")[0],
        )
        for a in Addresses(text).to
        if "compare=" in a
    ]
    assert sorted(shown) == sorted(pairs)
    assert f"<strong>{len(pairs)}</strong> of 22 ended differently" in text
    assert "no trial of this variant" in ask("/discordant?model=o3&variant=A7")


def test_the_page_of_prompts_has_the_differences_of_the_table(ask, db):
    (contrasts,) = make_tables(Study(db), ["contrasts"])
    text = ask("/prompts")
    shown = [row for row in contrasts.rows if row.values["difference"] is not None]
    assert shown
    for row in shown:
        told = {name: with_minus(value) for name, value in printed(contrasts, row).items()}
        assert f"{told['difference']}</a>\n<small>{told['ci']}, Holm {told['p_holm']}" in text
    assert "/discordant?model=o3&amp;variant=A1" in text


@pytest.mark.parametrize("address", ["/tables/attempts", "/prompts", "/tables"])
def test_a_name_is_shown_as_text_and_nothing_is_inline(ask, address):
    text = ask(address)
    assert HOSTILE not in text
    assert Addresses(text).inline == []


def test_a_page_is_served_while_a_computation_runs_and_a_failure_is_said(db):
    going, asked = threading.Event(), threading.Event()

    class Slow(InProcess):
        def answer(self, request):
            asked.set()
            going.wait()
            raise UsageError("it broke <off>")

    site = Site(db)
    site.computing = Computing(db, Slow)
    client = TestClient(explorer(site), base_url=f"http://{HERE}")
    first = client.get("/tables/attempts").text
    assert "Computing, " in first
    assert asked.wait(60)
    assert listed(client.get("/trials").text) == 66
    assert "Computing, " in client.get("/prompts").text
    going.set()
    while "Computing, " in (later := client.get("/tables/attempts").text):
        pass
    assert "This could not be computed:</strong> it broke &lt;off&gt;" in later
    site.computing.close()


def test_an_older_answer_stands_for_a_while_and_until_there_is_a_newer_one(db, monkeypatch):
    made, going = [], threading.Event()

    class Counting(InProcess):
        def answer(self, request):
            made.append(request)
            assert len(made) == 1 or going.wait(HANGS_S)
            return {"counted": len(made)}

    computing = Computing(db, Counting)
    first = computing.ask(("home", ""), (1, 1), wait_s=5)
    assert computing.ask(("home", ""), (2, 2)) == replace(first, older=True)
    assert len(made) == 1
    monkeypatch.setattr(worker, "STANDS_S", 0.0)
    assert computing.ask(("home", ""), (1, 1)) == first
    assert computing.ask(("home", ""), (2, 2)) == replace(first, older=True)
    going.set()
    second = computing.ask(("home", ""), (2, 2), wait_s=5)
    assert (second.state, second.content) == ((2, 2), {"counted": 2})
    computing.close()


@pytest.mark.long
def test_a_process_of_its_own_answers_alike_and_another_one_takes_its_place(db):
    computing = Computing(db)
    request = ("table", "attempts")
    found = computing.ask(request, (1, 1), wait_s=HANGS_S)
    assert found.content == Numbers(db).answer(request)
    failed = computing.ask(("nothing",), (1, 1), wait_s=HANGS_S)
    assert failed.failure == "nothing answers ('nothing',)"
    computing.ask(("table", "gap"), (1, 1))
    os.kill(computing._worker._pid.result(), signal.SIGKILL)
    failed = computing.ask(("table", "gap"), (1, 1), wait_s=HANGS_S)
    assert "ended without an answer" in failed.failure
    request = ("table", "indicators")
    found = computing.ask(request, (1, 1), wait_s=HANGS_S)
    assert found.content == Numbers(db).answer(request)
    computing.close()
