"""Why a trial went as it did: in the list of trials, on a trial's page, and in what is exported."""

from __future__ import annotations

import csv
import io
import json
import re
import shutil

import duckdb
import pytest
from starlette.testclient import TestClient

from merge_runner.results.store import Store
from merge_runner_analysis.explorer import catalogue as catalogue_module
from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.catalogue import Catalogue
from merge_runner_analysis.explorer.site import Site
from tests.support.crashes import CLOSING_IN, EXAMPLES, drive
from tests.support.studies import as_humans, played, write_study

HOST = "127.0.0.1:8700"


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    """A trial of each account by o3, and one each of two other drivers and a human pair."""
    path = tmp_path_factory.mktemp("accounts") / "t.duckdb"
    write_study(path, [*(drive(account) for account in EXAMPLES), CLOSING_IN])
    others = [played(drive("both insisted", "o4")), played(drive("no action", "human"))]
    Store(path).write("sweep-1", others, patience_s=5)
    as_humans(path)
    return path


@pytest.fixture(scope="module")
def client(db):
    return TestClient(explorer(Site(db)), base_url=f"http://{HOST}")


@pytest.fixture
def catalogue(db):
    catalogue = Site(db).catalogue
    catalogue.refresh()
    return catalogue


def address(account):
    return f"/trials/{played(drive(account)).spec.trial_id}"


def test_each_trial_is_listed_with_its_account(catalogue):
    found = {row["rep"]: row["account"] for row in catalogue.every({"model": "o3"})}
    assert found == {drive(account).rep: account for account in EXAMPLES}


def test_a_follower_that_closes_in_is_a_near_miss_whatever_the_gap(catalogue):
    (row,) = catalogue.every({"model": "o5"})
    assert (row["gap_m"], row["min_ttc_s"]) == (pytest.approx(1.99, abs=0.01), pytest.approx(0.95))
    assert row["account"] == "near miss"


def test_accounts_are_counted_by_driver_and_variant_and_filtered(catalogue):
    counts = {
        (row["model"], row["variant"], row["account"]): row["trials"]
        for row in catalogue.counts({}, "model", "variant", "account")
        if row["account"]
    }
    o3 = {("o3", "baseline", account): 1 for account in EXAMPLES if account}
    assert counts == {
        **o3,
        ("o5", "baseline", "near miss"): 1,
        ("o4", "baseline", "both insisted"): 1,
        ("human", None, "no action"): 1,
    }
    (alone,) = catalogue.counts({"model": "human"}, "account")
    assert alone["account"] == "no action"
    assert ("both insisted", 2) in catalogue.facets({})["account"]


def test_what_is_stored_later_has_its_account_too(db, tmp_path):
    path = tmp_path / "t.duckdb"
    write_study(path, [drive("no action")])
    catalogue = Site(path).catalogue
    catalogue.refresh()
    Store(path).write("sweep-1", [played(drive("invalid plan"))], patience_s=5)
    catalogue.refresh()
    assert [row["account"] for row in catalogue.counts({}, "account")] == [
        "invalid plan",
        "no action",
    ]


def test_what_was_measured_once_is_measured_again_only_where_rows_or_rules_differ(
    db, tmp_path, monkeypatch
):
    path = shutil.copy(db, tmp_path / "t.duckdb")
    stored, measured = path.read_bytes(), []
    judge = catalogue_module.collision_class
    monkeypatch.setattr(
        catalogue_module, "collision_class", lambda *of: measured.append(of) or judge(*of)
    )

    def listed():
        measured.clear()
        catalogue = Catalogue(path)
        catalogue.refresh()
        return catalogue.every({}), len(measured)

    def without_numbers(rows):
        return [{**row, "number": 0} for row in rows]

    rows, collisions = listed()
    assert collisions > 3
    assert path.read_bytes() == stored
    again, measured_again = listed()
    assert (without_numbers(again), measured_again) == (without_numbers(rows), 0)
    with duckdb.connect(str(path)) as connection:
        connection.execute("UPDATE decisions SET fallback = true WHERE trial_id LIKE 'o4/%'")
    changed, measured_again = listed()
    assert measured_again == 1
    assert {row["validity"] for row in changed if row["model"] == "o4"} == {"fallbacks"}
    monkeypatch.setattr(catalogue_module, "program", lambda: "other rules")
    assert listed()[1] == collisions
    catalogue_module.measured_beside(path).write_text("no Parquet")
    assert listed()[1] == collisions


@pytest.mark.parametrize(
    "damage",
    [
        "DELETE FROM states WHERE side = 'left'",
        "DELETE FROM states WHERE side = 'right' AND step = 3",
        'UPDATE specs SET spec = \'{"scenario": {"step_s": -1}}\'',
    ],
)
def test_a_collision_that_cannot_be_judged_is_listed_without_an_account(tmp_path, damage):
    path = write_study(tmp_path / "t.duckdb", [drive("no action")])
    with duckdb.connect(str(path)) as connection:
        connection.execute(damage)
    catalogue = Site(path).catalogue
    catalogue.refresh()
    (row,) = catalogue.every({})
    assert (row["outcome"], row["account"]) == ("collided", None)


def test_the_list_is_filtered_by_account_and_downloaded_with_it(client):
    text = client.get("/trials?account=near+miss&model=o3").text
    assert len(re.findall(r'<th scope="row">', text)) == 1
    assert re.search(r"<(span|small)[^>]*>near miss</", text)
    assert '<option value="near miss" selected>near miss (1)</option>' in text
    rows = csv.DictReader(io.StringIO(client.get("/trials.csv?account=both+insisted").text))
    assert [row["account"] for row in rows] == ["both insisted"] * 2


@pytest.mark.parametrize(
    ("account", "heading"),
    [
        ("both gave way", "Why it collided"),
        ("near miss", "Why it came close"),
        ("long wait", "Why it took so long"),
    ],
)
def test_the_page_of_a_trial_says_why_it_went_so(client, account, heading):
    text = client.get(address(account)).text
    assert f"<summary>{heading}</summary>" in text


def test_where_there_is_nothing_to_explain_nothing_is_explained(client):
    text = client.get(address(None)).text
    assert "Why it" not in text
    assert {mark["kind"] for mark in marks_in(text)} == {"merge"}


def marks_in(text):
    return json.loads(re.search(r'id="replay-data">(.*?)</script>', text, re.DOTALL)[1])["marks"]


def test_a_replay_is_given_its_marks(client):
    text = client.get(address("both insisted")).text
    assert [mark for mark in marks_in(text) if mark["kind"] == "last chance"] == [
        {"t": 1.6, "side": "left", "kind": "last chance", "text": "last moment to brake"},
        {"t": 2.0, "side": "right", "kind": "last chance", "text": "last moment to brake"},
    ]
