"""What a newcomer finds from the first page without a manual, and a colleague in an export."""

from __future__ import annotations

from dataclasses import replace

import pytest
from playwright.sync_api import expect

from merge_runner.results.store import Store
from tests.support.exporting import export_with_a_table
from tests.support.serving import served
from tests.support.studies import Drive, as_humans, played, write_study

CRASHED = Drive("o3", "baseline", "N_0_0", 1, (0.5,) * 5, (0.4,) * 5, {})
DECIDED = Drive("o3", "baseline", "L_4_0", 1, (0.4,) * 3, (-0.4,) * 3, {})
HUMAN = Drive("human", "baseline", "N_0_0", 1, (0.4, 0.4, 0.4), (-0.4, -0.4, -0.4))
WRONG = "We are level, so I speed up and merge first."


def in_words(drive):
    """A trial whose drivers say what they do."""
    record = played(drive)
    said = [
        replace(row, decision=replace(row.decision, tactical="M", rationale=WRONG))
        for row in record.decisions
    ]
    return replace(record, decisions=tuple(said))


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    path = tmp_path_factory.mktemp("newcomer") / "study.duckdb"
    write_study(path, [DECIDED])
    Store(path).write("sweep-1", [in_words(CRASHED), played(HUMAN)], patience_s=5)
    as_humans(path)
    return path


@pytest.fixture(scope="module")
def site(db):
    with served(db) as address:
        yield address


def watch_the_worst(page):
    """From the first page to a trial of the condition that collides most."""
    page.locator("#collisions tbody td a").first.click()
    page.get_by_role("link", name="o3/baseline/N_0_0/rep01").click()
    expect(page.get_by_role("heading", level=1)).to_have_text("o3/baseline/N_0_0/rep01")
    page.wait_for_load_state()


@pytest.mark.long
def test_a_newcomer_finds_why_it_collides_most_and_a_colleague_sees_the_same(page, db, tmp_path):
    page.goto("/")
    watch_the_worst(page)

    # Why it happened.
    account = page.locator("details", has_text="Why it collided")
    expect(account).to_be_visible()
    expect(account).to_contain_text("could still have avoided it")
    page.locator("#moments").get_by_role("button", name="last moment to brake").first.click()

    # The sentence in which the driver went wrong: the panel shows this moment.
    expect(page.locator("#panel blockquote").first).to_contain_text(WRONG)

    # A human who solved it.
    page.get_by_role("button", name="nearest human").click()
    expect(page.locator("#ghost-key")).to_contain_text("human P1, N_0_0")
    expect(page.locator("#ghost-key")).to_contain_text("reached the merge point first")

    # A note with a tag, from the keyboard.
    page.keyboard.press("n")
    page.keyboard.type("speeds up when #level")
    page.keyboard.press("Enter")
    expect(page.locator("#noted")).to_contain_text("speeds up when #level")

    # A colleague opens the folder.
    export_with_a_table(db, tmp_path / "pages")
    page.goto((tmp_path / "pages/index.html").as_uri())
    watch_the_worst(page)
    expect(page.locator("details", has_text="Why it collided")).to_be_visible()
    expect(page.locator("#noted")).to_contain_text("speeds up when #level")
    page.locator("#moments").get_by_role("button", name="last moment to brake").first.click()
    expect(page.locator("#panel blockquote").first).to_contain_text(WRONG)
