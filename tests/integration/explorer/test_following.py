"""A page follows a sweep that another process plays, and says when nobody answers it any more."""

from __future__ import annotations

import os
import subprocess
import time

import pytest
from anyio.from_thread import start_blocking_portal
from playwright.sync_api import expect

from tests.support.axe import serious
from tests.support.gate import Gate
from tests.support.harness import PROGRAM, environment, watched
from tests.support.serving import served


@pytest.fixture
def held_server(tmp_path):
    """The address of an emulator that holds all but a few answers, and what lets them go."""
    gate = Gate(10, tmp_path)
    with (
        start_blocking_portal() as elsewhere,
        elsewhere.wrap_async_context_manager(watched(gate.middle)) as server,
    ):
        yield server.url, lambda: elsewhere.call(gate.open)


def test_a_sweep_is_followed_to_its_end_without_a_reload(page, tmp_path, held_server):
    url, let_go = held_server
    db = tmp_path / "merge.duckdb"
    sweep = subprocess.Popen(
        [
            *(PROGRAM, "sweep", "baseline", "--reps", "1", "--conditions", "L_4_0,N_0_0"),
            *("--db", db, "--cache", tmp_path / "cache"),
        ],
        cwd=tmp_path,
        env=environment(EMULATOR_BASE_URL=f"{url}/v1"),
        stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )
    while not (tmp_path / "merge.duckdb.progress").is_dir():
        assert sweep.poll() is None
        time.sleep(0.05)
    with served(db) as address:
        listing, trials = page.context.new_page(), page.context.new_page()
        listing.goto(f"{address}/sweeps")
        expect(listing.locator(".state")).to_have_text("running")
        trials.goto(f"{address}/trials?condition=N_0_0")
        study = page.context.new_page()
        study.goto(address)
        expect(study.locator("#strip")).to_contain_text("Running")
        page.goto(address)
        # It is drawn anew each second, which a click on a busy machine may never outrun.
        page.locator("#strip a").dispatch_event("click")
        verdict = page.locator(".sweep-verdict")
        expect(verdict).to_contain_text("Running")
        assert serious(page) == []
        page.evaluate("window.stayed = true")
        let_go()
        expect(verdict).to_contain_text("Finished: all 2 trials ended")
        assert page.evaluate("window.stayed")
        expect(page.locator(".heard")).to_have_text(verdict.locator("strong").inner_text())
        # The list and the trials have noticed its end too.
        expect(listing.locator(".state")).to_have_text("finished")
        expect(listing.locator("tbody tr")).to_contain_text("2 of 2")
        # So has the study, in its strip and in its counts.
        expect(study.locator("#strip")).to_contain_text("Finished: all 2 trials ended")
        expect(study.locator("#answers .n a").first).to_have_text("2")
        trials.get_by_role("link", name="Show them").click()
        expect(trials.locator("tbody tr")).to_have_count(1)
        assert "condition=N_0_0" in trials.url
        for other in (listing, trials, study):
            other.close()
        page.get_by_role("link", name="Trials").first.click()
        expect(page.locator("tbody tr")).to_have_count(2)
        page.goto("about:blank")  # it asks for nothing more before the server ends
    assert sweep.wait() == 0


@pytest.mark.long
@pytest.mark.parametrize("address", ["/trials", "/trials/emulator/baseline/N_0_0/rep01"])
def test_a_page_says_when_nobody_answers_it_any_more(browser, study, address):
    context = browser.new_context()
    page = context.new_page()
    port = 10_000 + os.getpid() % 20_000  # none that a socket gets that names no port
    with served(study, port) as site:
        page.goto(f"{site}{address}")
        expect(page.locator("footer")).to_contain_text(f"view --db {study} --export")
        expect(page.locator("#lost")).to_be_hidden()
    if address == "/trials":
        page.get_by_label("outcome").select_option("collided")
    else:
        page.keyboard.press("]")
    expect(page.locator("#lost")).to_contain_text("merge-runner view has ended")
    with served(study, port):
        if address == "/trials":
            page.get_by_label("outcome").select_option("left first")
        else:
            page.keyboard.press("]")
        expect(page.locator("#lost")).to_be_hidden()
    context.close()


def test_a_link_of_another_page_runs_no_query_and_a_typed_address_does(browser, site, tmp_path):
    page = browser.new_page()  # whose console says what was refused
    query = f"{site}/sql?q=select+count(*)+from+trials"
    (tmp_path / "other.html").write_text(f'<a href="{query}">here</a>')
    page.goto((tmp_path / "other.html").as_uri())
    page.get_by_role("link").click()
    expect(page.locator("body")).to_contain_text("another site's page may not ask here")
    page.goto("about:blank")
    page.goto(query)
    expect(page.locator("#result tbody tr")).to_have_count(1)
    page.close()
