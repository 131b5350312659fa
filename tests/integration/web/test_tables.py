"""Tables, figures and prompts: every number leads to its trials; and the process that computes."""

import os
import re
import shutil
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from contextvars import copy_context
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from html import unescape
from urllib.parse import parse_qs, unquote, urlsplit

import duckdb
import psutil
import pytest

from merge_runner.errors import UsageError
from merge_runner.registry import use
from merge_runner.results.store import results_digest
from merge_runner.study.parts import load_study
from merge_runner_analysis.cache import stamp_of
from merge_runner_analysis.explain import explain
from merge_runner_analysis.figures import FIGURES
from merge_runner_analysis.figures.gallery import MAKERS
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables.model import from_text
from merge_runner_analysis.web import computing as computing_module
from merge_runner_analysis.web.answers import answer, numbers
from merge_runner_analysis.web.computing import Computing
from tests.support.cases import cases
from tests.support.gate import HANGS_S
from tests.support.serving import Page, client_of, in_process, listed, never
from tests.support.studies import Said, damage, write_study, yielding

HOSTILE = '<img src=x onerror="alert(1)">'


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    """o3 with a variant that did some trials otherwise and lost one; a hostile name."""
    a1 = yielding("o3", "A1", reps=2)
    a1[0] = replace(a1[0], left=(0.0,), right=(0.0,))
    a1[3] = replace(a1[3], left=(0.0,), right=(0.5,) * 3)
    a1[7] = replace(a1[7], left=a1[7].right, right=a1[7].left)
    a1[4] = replace(a1[4], said={1: Said(("timeout",), lost=True)})
    drives = [*yielding("o3", reps=3), *a1, *yielding(HOSTILE, reps=1)]
    return write_study(tmp_path_factory.mktemp("pages") / "study.duckdb", drives)


@pytest.fixture(scope="module")
def client(db):
    return client_of(db)


def cells(text):
    return [to for to, _ in Page(text).to("/trials?cell=")]


@pytest.fixture
def ask(client):
    """Gets a page; returns its text."""

    def get(address, code=200):
        reply = client.get(address)
        assert reply.status_code == code, reply.text
        return reply.text

    return get


def answering(db, *answers):
    """A computation that gives these answers, or raises them, and what it was asked."""
    asked, left = [], iter(answers)

    def scripted(_, request):
        asked.append(request)
        answer = next(left)
        if isinstance(answer, Exception):
            raise answer
        return answer

    computing = in_process(db, scripted)
    return computing, asked, lambda state, *of: computing.ask(of, state, wait_s=HANGS_S).content


@pytest.mark.parametrize(("name", "every"), [("ablation-quantitative", 9), ("contrasts", 25)])
def test_every_number_leads_to_the_trials_that_explain_names(ask, db, name, every):
    study, table = StudyResults(db), from_text(answer(db, ("table", name))["table"])
    links = cells(ask(f"/tables/{name}"))
    assert len(links) > 20
    for link in links[::every]:
        (cell,) = parse_qs(urlsplit(link).query)["cell"]
        found, page = explain(study, table, cell.removeprefix(f"{name}/")), ask(link)
        trials = [s.numerator if s.counts else s.trials for s in found.sources]
        assert listed(page) == sum(map(len, trials))
        assert found.value in unescape(page)


def test_numbers_of_first_decisions_lead_to_what_they_rest_on_and_no_cell_leads_nowhere(
    prepare, tmp_path
):
    for more in ((), ("--first",), ("--first", "--model", "emulator+idm", "--mirror")):
        part = ("--conditions", "L_4_8,N_0_0", "--reps", 1, "--db", "t.duckdb")
        assert prepare(tmp_path, "sweep", "baseline", *part, *more).code == 0
    client = client_of(tmp_path / "t.duckdb")
    text = client.get("/tables/first-action").text
    found = [link for link in cells(text) if "asked" in link]
    assert len(found) > 10
    page = Page(client.get(found[-1]).text)
    assert "first decisions that were asked for alone" in page.text
    ((query, _),) = page.to("/sql?q=")
    trials = re.search(r"(\d+) of \d+ trials;", page.text)[1]
    assert f"<strong>{trials}</strong> rows" in client.get(query).text
    one_a_row = {link.rpartition("%3A")[0]: link for link in cells(text)}
    assert {client.get(link).status_code for link in one_a_row.values()} == {200}


def test_facets_sorting_and_exports_keep_the_cell_and_a_table_leaves_out_columns(ask):
    cell = "attempts/o3/A1:lost"
    text = ask(f"/trials?cell={cell}")
    page = Page(text)
    kept = [to for to, _ in [*page.to("/trials?"), *page.to("/trials.")]]
    assert (listed(text), len(kept) >= 8) == (1, True)
    assert all(parse_qs(urlsplit(to).query)["cell"] == [cell] for to in kept)
    assert f'name="cell" value="{cell}"' in text
    assert listed(ask(f"/trials?cell={cell}&outcome=collided")) == 0
    assert len(ask(f"/trials.csv?cell={cell}").splitlines()) == 2
    tables = [ask(f"/tables/attempts{without}") for without in ("", "?without=calls")]
    whole, part = (re.findall(r'<th scope="col"[^>]*>(.*?)</th>', table) for table in tables)
    assert (len(whole) - 1, all(Page(head).text for head in whole)) == (len(part), True)
    for table in (*tables, ask("/tables")):
        assert (HOSTILE in table, Page(table).inline) == (False, [])


@pytest.mark.parametrize("case", cases("explorer", "not-there"))
def test_what_is_none_says_what_there_is(ask, case):
    assert case["told"] in unescape(ask(case["address"], 404))


def test_a_page_that_waits_for_a_cell_that_is_none_is_loaded_anew_and_says_so_at_once(db):
    computing, asked, _ = answering(db, {"absent": "no such row"})
    client = client_of(db, computing)
    address = "/trials?cell=attempts/nobody:n"
    while (waited := client.get(address)).status_code == 200:
        pass
    assert waited.status_code == 404
    assert client.get(address).status_code == 404
    assert len(asked) == 1


def test_that_a_cell_is_none_stands_as_long_as_its_state_and_a_fault_does_not_stay(db):
    absent, there = {"absent": "no such row"}, {"value": "7"}
    computing, _, ask = answering(db, absent, there, ValueError("a fault"), {"counted": 1})
    cell = ("cell", "attempts", "o3/A9", "n")
    for state, content in (((1, 1), absent), ((1, 1), absent), ((2, 2), there)):
        assert ask(state, *cell) == content
    with pytest.raises(ValueError, match="a fault"):
        ask((1, 1), "tables")
    assert ask((1, 1), "tables") == {"counted": 1}
    computing.close()


def test_the_database_is_read_anew_where_it_changed(db):
    first = numbers(db, stamp_of(db))
    assert numbers(db, stamp_of(db)) is first
    os.utime(db)
    assert numbers(db, stamp_of(db)) is not first


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
    shown = re.findall(r'href="/trials/([^"?]+)\?[^"]*compare=([^"@&]+)', unescape(text))
    assert sorted((one, unquote(other).partition("@")[0]) for one, other in shown) == sorted(pairs)
    assert f"<strong>{len(pairs)}</strong> of 22 ended differently" in text
    assert "no trial of this variant" in ask("/discordant?model=o3&variant=A7")


def test_every_figure_is_offered_and_comes_as_svg_and_png_and_is_cited(client, ask, db):
    offered = {to for to, _ in Page(ask("/tables")).to("/figures/")}
    assert offered == {f"/figures/{name}{end}" for name in MAKERS for end in ("", ".svg")}
    assert list(FIGURES) == list(MAKERS)
    reply = client.get("/figures/first-action.svg")
    assert reply.headers["content-type"].startswith("image/svg+xml")
    assert "</svg>" in reply.text
    policy = reply.headers["content-security-policy"]
    assert "style-src 'unsafe-inline'; img-src data:; sandbox" in policy
    assert client.get("/figures/first-action.png").content.startswith(b"\x89PNG")
    text = ask("/figures/first-action")
    for said in ('src="data:image/svg+xml;base64,', results_digest(db)[0], "arXiv:2604.09609"):
        assert said in text
    assert Page(text).to("/tables/first-action.csv")


def test_a_page_is_served_while_a_computation_runs_and_a_failure_is_said(db):
    going, asked = threading.Event(), threading.Event()

    def slow(*_):
        asked.set()
        going.wait()
        raise UsageError("it broke <off>")

    client = client_of(db, in_process(db, slow))
    waiting = client.get("/tables/attempts").text
    assert asked.wait(HANGS_S)
    assert listed(client.get("/trials").text) == 66
    assert "Computing the table " in client.get("/prompts").text
    going.set()
    while "Computing the table " in (later := client.get("/tables/attempts").text):
        pass
    assert "This could not be computed:</strong> it broke &lt;off&gt;" in later
    assert "Computing the table attempts, 0" in Page(waiting).text
    assert re.search('<noscript><meta http-equiv="refresh" content="[1-9]"></noscript>', waiting)
    assert "http-equiv" not in later


def test_a_page_says_when_the_trials_were_played_and_no_time_at_which_it_was_made(db, tmp_path):
    copy = shutil.copy(db, tmp_path / "t.duckdb")
    begun, ended = "2026-11-21 10:00", "2026-11-22 03:04"
    for end, said in (("NULL", " UTC, not all ended"), (f"'{ended}:05'", f" to {ended} UTC")):
        damage(copy, f"UPDATE sweeps SET started_at = '{begun}:00', ended_at = {end}")
        with client_of(copy) as client:
            for page in ("/tables/attempts", "/cite", "/prompts"):
                text = client.get(page).text
                assert f" trials, played {begun}{said}" in Page(text).text
                assert f"{datetime.now(UTC):%Y-%m-%d}" not in text
    damage(
        copy,
        "INSERT INTO sweeps BY NAME SELECT * REPLACE ('newer' AS sweep_id, NULL AS ended_at, "
        "TIMESTAMP '2026-11-23 00:00:00' AS started_at) FROM sweeps",
    )
    text = Page(client_of(copy).get("/cite").text).text
    assert f"played in 2 runs {begun} to 2026-11-23 00:00 UTC, not all ended;" in text


def test_an_older_answer_stands_for_a_while_and_until_there_is_a_newer_one(db, monkeypatch):
    made, going = [], threading.Event()

    def counting(_, request):
        made.append(request)
        assert len(made) == 1 or going.wait(HANGS_S)
        return {"counted": len(made)}

    computing = in_process(db, counting)
    first = computing.ask(("home", ""), (1, 1), wait_s=HANGS_S)
    assert computing.ask(("home", ""), (2, 2)) == replace(first, older=True)
    assert len(made) == 1
    monkeypatch.setattr(computing_module, "STANDS_S", 0.0)
    assert computing.ask(("home", ""), (1, 1)) == first
    assert computing.ask(("home", ""), (2, 2)) == replace(first, older=True)
    going.set()
    second = computing.ask(("home", ""), (2, 2), wait_s=HANGS_S)
    assert (second.state, second.content) == ((2, 2), {"counted": 2})
    computing.close()


def test_a_process_of_its_own_answers_alike_takes_no_file_of_the_users_and_is_replaced(
    db, tmp_path, monkeypatch
):
    (tmp_path / "analysis.py").write_text("print('MINE')")
    monkeypatch.chdir(tmp_path)
    computing, threads = Computing(db), set(threading.enumerate())
    before = set(psutil.Process().children(recursive=True))

    def ask(*request):
        return computing.ask(request, (1, 1), wait_s=HANGS_S)

    assert ask("table", "attempts").content == answer(db, ("table", "attempts"))
    assert ask("nothing").failure == "nothing answers ('nothing',)"
    computing.ask(("table", "gap"), (1, 1))
    for child in set(psutil.Process().children(recursive=True)) - before:
        if "spawn_main" in " ".join(child.cmdline()):
            child.send_signal(signal.SIGKILL)
    assert "ended without an answer" in ask("table", "gap").failure
    assert ask("table", "criticality").content == answer(db, ("table", "criticality"))
    computing.close()
    with closing(Computing(db)) as computing:
        computing.ask(("table", "attempts"), (1, 1))
    assert set(threading.enumerate()) <= threads, "a program could stumble over it"


def test_a_kept_table_is_shown_at_once_and_computed_again_once_the_results_differ(tmp_path):
    db = write_study(tmp_path / "study.duckdb", yielding("o3", reps=1))
    request = ("table", "attempts", "", "")
    made = answer(db, request)
    with closing(Computing(db, never, partial(ThreadPoolExecutor, 1))) as computing:
        assert computing.ask(request, (1, 1)).content == made
        assert computing.ask(("table", "gap", "", ""), (1, 1), HANGS_S).failure == "not now"
    os.utime(db)
    with closing(Computing(db, never, partial(ThreadPoolExecutor, 1))) as computing:
        assert computing.ask(request, (1, 1), HANGS_S).failure == "not now"


def test_what_the_pages_compute_knows_the_study_as_the_explorer_was_given_it(golden_copy):
    db, plugin = golden_copy / "golden.duckdb", golden_copy / "mine.py"
    with duckdb.connect(str(db)) as connection:
        connection.execute("DELETE FROM trials WHERE model_left <> 'cheap'")

    def compute():
        use(load_study(str(golden_copy / "mine.toml"), trust=True)[1])
        plugin.write_text("raise RuntimeError('nobody agreed to this')")
        with closing(Computing(db)) as computing:
            return computing.ask(("table", "factors"), (1, 1), wait_s=HANGS_S).content

    assert "opponent=sleepy/duration_s" in copy_context().run(compute)["table"]
