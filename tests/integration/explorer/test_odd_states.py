"""Addresses, rows and databases that are not as they should be cost no other page anything."""

from __future__ import annotations

import shutil
import socket
import threading
from contextlib import closing

import duckdb
import pytest
from starlette.testclient import TestClient

from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.computing import Computing, Worker
from merge_runner_analysis.explorer.site import Site
from tests.integration.explorer.test_tables_pages import InProcess
from tests.support.serving import held

HOST = "127.0.0.1:8700"
TRIAL = "/trials/emulator/baseline/N_0_0/rep01"


@pytest.fixture
def db(study, tmp_path):
    """A copy of the study, to change it."""
    return shutil.copy(study, tmp_path / "study.duckdb")


def ask(site, address):
    return TestClient(explorer(site), base_url=f"http://{HOST}").get(address)


def change(db, sql):
    with duckdb.connect(str(db)) as connection:
        connection.execute(sql)


@pytest.mark.parametrize(
    ("address", "code"),
    [
        (f"{TRIAL}?side=left&decision=²", 200),
        (f"{TRIAL}?side=left&decision=٣", 200),
        (f"{TRIAL}?side=left&decision={'9' * 5000}", 200),
        (f"{TRIAL}?side=left&decision=99", 200),
        ("/trials?page=٣", 200),
        ("/trials?page=99999999999", 200),
        ("/trials?sort=drop", 200),
        ("/trials.exe", 404),
        ("/trials/no/such/trial", 404),
        ("/sweeps/none", 404),
    ],
)
def test_an_odd_address_is_no_fault(study, address, code):
    reply = ask(Site(study), address)
    assert reply.status_code == code
    assert "A fault" not in reply.text


def test_a_list_with_a_stroke_behind_it_is_the_list(study):
    assert ask(Site(study), "/trials/?q=rep01").url.query == b"q=rep01"


def test_odd_rows_cost_no_other_row_its_page(db):
    change(
        db,
        "UPDATE trials SET condition = 'X_1_1' WHERE trial_id LIKE 'o4/%';"
        "DELETE FROM states WHERE side = 'right' AND trial_id LIKE '%N_0_0/rep01'",
    )
    site = Site(db)
    text = ask(site, "/trials/o4/baseline/L_4_0/rep01").text
    assert "X_1_1" in text
    assert "the left vehicle would be 4 m ahead" in text
    assert ask(site, "/trials?condition=N_0_0").text.count('<th scope="row">') == 4
    assert ask(site, TRIAL).status_code == 200


def test_a_long_rationale_begins_and_the_rest_is_folded(db):
    change(
        db,
        "UPDATE decisions SET rationale = repeat('🚗', 20000) WHERE trial_id LIKE '%N_0_0/rep01'",
    )
    text = ask(Site(db), TRIAL).text
    quote = text[text.index('<blockquote class="said"') :]
    beginning, rest = quote[: quote.index("</blockquote>")].split("<details>")
    assert 500 < beginning.count("🚗") < 1000
    assert beginning.count("🚗") + rest.count("🚗") == 20_000


def test_a_trial_that_failed_again_shows_its_new_error(db):
    site = Site(db)
    site.catalogue.refresh()
    state = site.catalogue.state()
    change(db, "UPDATE trials SET error = 'left: another one' WHERE trial_id LIKE 'o4/%'")
    assert "another one" in ask(site, "/trials/o4/baseline/L_4_0/rep01").text
    assert site.catalogue.find("o4/baseline/L_4_0/rep01")["error"] == "left: another one"
    assert site.catalogue.state() != state


@pytest.mark.slow
def test_while_another_program_holds_the_database_the_last_list_is_shown(db):
    site = Site(db)
    assert "holds the database" not in ask(site, "/trials").text
    with held(db):
        for address in ("/trials", "/trials?condition=N_0_0", "/sweeps", "/tables"):
            reply = ask(site, address)
            assert reply.status_code == 200
            assert "Another program holds the database" in reply.text
    assert "holds the database" not in ask(site, "/trials").text


async def test_a_port_that_is_taken_is_said_in_a_line(merge_runner, study):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        run = await merge_runner("view", "--db", study, "--port", port)
    assert run.code == 2
    assert f"nothing can listen at port {port} of 127.0.0.1" in run.err
    assert len(run.err.splitlines()) == 1


def test_a_file_of_the_users_own_is_not_taken_for_ours(study, tmp_path, monkeypatch):
    (tmp_path / "analysis.py").write_text("print('MINE')")
    monkeypatch.chdir(tmp_path)
    with closing(Worker(study)) as worker:
        found = worker.submit(("table", "attempts")).result(timeout=60)
    assert found["counted"] > 0


def test_a_worker_that_is_closed_leaves_no_thread_that_a_program_could_stumble_over(study):
    before = set(threading.enumerate())
    with closing(Worker(study)) as worker:
        worker.submit(("table", "attempts"))
    assert set(threading.enumerate()) <= before


def test_a_fault_in_a_computation_does_not_stay(study):
    answers = iter([ValueError("a fault"), {"counted": 1}])

    class Faulty(InProcess):
        def answer(self, request):
            answer = next(answers)
            if isinstance(answer, Exception):
                raise answer
            return answer

    computing = Computing(study, Faulty)
    with pytest.raises(ValueError, match="a fault"):
        computing.ask(("tables",), (1, 1), wait_s=5)
    assert computing.ask(("tables",), (1, 1), wait_s=5).content == {"counted": 1}
    computing.close()
