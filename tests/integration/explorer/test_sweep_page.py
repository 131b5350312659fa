"""The sweeps' pages: how far, how well, what went wrong; and how a page follows a sweep."""

from __future__ import annotations

import html
import re
from collections import Counter
from dataclasses import replace
from datetime import UTC, datetime
from urllib.parse import parse_qs, urlsplit

import duckdb
import pytest
from starlette.testclient import TestClient

from merge_runner.results.database import write_database
from merge_runner.results.store import Store, sweep_facts
from merge_runner.run.progress import remove_standing, write_standing
from merge_runner.run.stored_replay import audit_database
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.pages import sweep as page
from merge_runner_analysis.explorer.pages.sweep import list_runs, numbers_of, run_of
from merge_runner_analysis.explorer.pages.trials import filter_of
from merge_runner_analysis.explorer.site import Site
from tests.integration.explorer.test_tables_pages import Awaited, InProcess
from tests.support.serving import held
from tests.support.standings import progress, runner
from tests.support.studies import Said, write_study, yielding

URL = "/sweeps/sweep-1"
CONFIG = {
    "model": "o3",
    "models": {
        "o3": {"id": "o3", "provider": "openai", "aliases": ["o3-alias"], "note": "retires soon"}
    },
    "arms": [
        {
            "model": "o3",
            "variant": "baseline",
            "repetitions": 3,
            "sides": {"left": "o3", "right": "o3"},
            "factors": {},
            "label": "baseline",
        }
    ],
    "conditions": list(CONDITIONS),
    "max_cost_usd": 9.0,
    "typed": ["sweep", "baseline", "--model", "o3", "--db", "my results.duckdb", "--max-cost", "9"],
}
TYPED = "merge-runner sweep baseline --model o3 --db 'my results.duckdb' --max-cost 9"
TROUBLE = (
    Said(("refusal",), "refusal"),
    Said(failure="no_array"),
    Said(("timeout", "timeout"), lost=True),
    Said(("rate_limit", "ok")),
    Said(("unknown", "ok")),
    Said(served="another"),
    Said(served="o3-alias"),
)
END = datetime(2026, 11, 21, 1)  # noqa: DTZ001 # as the database keeps times
ROW = {"sweep_id": "s", "name": "baseline", "exit_code": 0, "trials": 1, "ended": 1, "failed": 0,
       "others": 0, "asked": 9, "invalid": 0, "faults": 0, "scripted": 0, "started_at": END,
       "ended_at": END}  # fmt: skip


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A sweep of 33 planned trials that holds 30, one of them failed, with troubles."""
    drives = yielding("o3")[:30]
    asked = [
        replace(drive, said={1: TROUBLE[i]} if i < len(TROUBLE) else {})
        for i, drive in enumerate(drives)
    ]
    path = tmp_path_factory.mktemp("study") / "m.duckdb"
    write_study(path, asked, config=CONFIG)
    with duckdb.connect(str(path)) as connection:
        connection.execute("UPDATE calls SET http_status = 200 WHERE model_served IS NOT NULL")
    return path


@pytest.fixture
def study(written, tmp_path):
    """The same, to change it."""
    path = tmp_path / "m.duckdb"
    path.write_bytes(written.read_bytes())
    return path


def browser(db):
    site = Site(db)
    site.computing = Awaited(db, InProcess)
    return TestClient(explorer(site), base_url="http://127.0.0.1:1")


def text_of(client, url=URL):
    reply = client.get(url)
    assert reply.status_code == 200
    return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", reply.text)).split())


def running(db, **changes):
    """Say that the sweep runs, in this process."""
    shown = progress(runner(), planned=3 * len(CONDITIONS))
    shown.outcome_counts = Counter(changes.pop("ended", {"finished": 2}))
    standing = shown.standing("sweep-1").model_copy(update={"left_s": 20.0, **changes})
    write_standing(db, standing)


def test_a_run_says_how_long_it_lasted(study):
    # Waits for the audit that a page has asked for, which reads the file in another process.
    with write_database(study) as connection:
        connection.execute("UPDATE sweeps SET ended_at = started_at + INTERVAL 2 HOURS")
    assert ">2.0 h<" in browser(study).get("/sweeps").text
    assert "lasted 2.0 h" in text_of(browser(study))


def test_runs_show_what_the_audit_finds_and_notes_and_keep_it(study):
    with write_database(study) as connection:
        connection.execute("UPDATE sweeps SET ended_at = started_at, exit_code = 1")
        connection.execute("UPDATE trials SET end_time_s = 99 WHERE status = 'finished'")
    for address in (URL, "/sweeps"):
        text = text_of(browser(study), address)
        assert "found: outcome: sweep-1" in text
    [run] = audit_database(study, "sweep-1")
    assert all(" ".join(note.split()) in text for note in run.notes)


def share(name, count, of, things):
    """A row of the page, as text."""
    part = f" ({100 * count / of:.1f} %)" if count else ""
    return f"{name} {count:,} of {of:,}{part} {things}"


def test_the_page_has_the_numbers_of_the_database(written):
    text, facts = text_of(browser(written)), sweep_facts(written, "sweep-1")
    with duckdb.connect(str(written), read_only=True) as connection:
        (answers,) = connection.execute(
            "SELECT count(*) FROM calls WHERE http_status = 200"
        ).fetchone()
        attempts, failures = connection.execute(
            "SELECT count(*), count(*) FILTER (outcome <> 'ok') FROM attempts"
        ).fetchone()
    collided = dict(facts["outcomes"]).get("collided", 0)
    for said in (
        share("collisions", collided, 29, "ended trials"),
        share("failed trials", len(facts["failed"]), 30, "stored trials"),
        share("invalid replies", facts["invalid"], facts["decisions"], "decisions asked"),
        share("fallbacks", facts["fallbacks"], facts["decisions"], "decisions asked"),
        share("faults", failures, attempts, "attempts"),
        share("another model answered", 1, answers, "answers"),
        "its runs could spend at most 9.00 USD; 1 attempts of unknown cost are not in it",
    ):
        assert said in text
    assert (facts["invalid"], facts["fallbacks"], len(facts["failed"])) == (2, 2, 1)


def test_every_arm_and_every_cause_leads_to_the_trials_that_it_counts(written):
    site = Site(written)
    shown = page_of(site)
    links = re.findall(r'id="[ac][^"]*" href="(/trials\?[^"]*)"[^>]*>(\d+)( trials?)?<', shown)
    kinds = [kind for _, _, kind in links]
    assert kinds.count("") == 1
    assert {kind for kind in kinds if "trial" in kind} == {" trial"}
    for url, count, _ in links:
        asked = {k: v[0] for k, v in parse_qs(urlsplit(html.unescape(url)).query).items()}
        totals = site.catalogue.counts(filter_of(asked))
        there = sum(part["trials" if "cause" in asked else "ended"] for part in totals)
        assert there == int(count), url
    causes = {parse_qs(urlsplit(html.unescape(url)).query)["cause"][0]
              for url, _, kind in links if "trial" in kind}  # fmt: skip
    assert causes == {
        "model: o3 → another",
        "plan: no_array",
        "plan: refusal",
        *(f"attempt: {name}" for name in ("refusal", "timeout", "rate_limit", "unknown")),
    }


def test_every_rate_that_may_cost_trust_leads_to_its_trials(written):
    site = Site(written)
    shown = page_of(site)
    links = dict(re.findall(r'id="(rate-\d)" href="([^"]*)"', shown))
    trials = {}
    for name, url in links.items():
        asked = {k: v[0] for k, v in parse_qs(urlsplit(html.unescape(url)).query).items()}
        assert asked["sweep"] == "sweep-1"
        trials[name] = [row["trial_id"] for row in site.catalogue.every(filter_of(asked))]
    with duckdb.connect(str(written), read_only=True) as connection:
        invalid = connection.execute(
            "SELECT DISTINCT trial_id FROM decisions WHERE NOT valid ORDER BY ALL"
        ).fetchall()
    assert len(invalid) == 2
    assert trials["rate-3"] == trials["rate-4"] == [name for (name,) in invalid]


def test_an_alias_is_nothing_that_went_wrong(study):
    site = Site(study)
    shown = html.unescape(page_of(site))
    assert "o3 → o3-alias" not in shown
    for alias in ("o3-alias", "o3"):
        assert site.catalogue.every(filter_of({"cause": f"model: o3 → {alias}"})) == []
    assert len(site.catalogue.every(filter_of({"cause": "model: o3 → another"}))) == 1
    with write_database(study) as connection:
        connection.execute("UPDATE calls SET outcome = 'ok', model_served = 'o3'")
        connection.execute("UPDATE decisions SET failure = NULL, valid = true, fallback = false")
        connection.execute("UPDATE trials SET status = 'finished' WHERE status = 'failed'")
    assert "What went wrong" not in page_of(Site(study))


def test_two_other_models_have_a_line_and_a_list_each(study):
    with write_database(study) as connection:
        connection.execute("UPDATE calls SET model_served = 'third' WHERE trial_id LIKE '%N_0_0%'")
    site = Site(study)
    shown = html.unescape(page_of(site))
    for name in ("another", "third"):
        assert f"model: o3 → {name}</th>" in shown
        assert site.catalogue.every(filter_of({"cause": f"model: o3 → {name}"}))


def page_of(site):
    site.catalogue.refresh()
    return page.sweep_page(site, "sweep-1", {})


def test_what_a_server_wrote_is_shown_as_text(study):
    hostile = "<script>alert(1)</script>\u202e<img src=x>"
    with write_database(study) as connection:
        connection.execute("UPDATE trials SET error = ? WHERE status = 'failed'", [hostile])
        connection.execute("UPDATE calls SET model_served = ? WHERE model_served = 'another'",
                           [hostile])  # fmt: skip
    running(study, rows=(("WARNING", f"another model answers: {hostile}"), ("waiting", hostile)))
    shown = browser(study).get(URL).text
    assert shown.count("&lt;script&gt;alert(1)&lt;/script&gt;[U+202E]&lt;img src=x&gt;") >= 3
    assert "<script>alert" not in shown
    assert "<img" not in shown


def test_while_it_runs_its_totals_are_its_progress_file_s_and_the_cells_those_stored(study):
    running(study, ended={"finished": 1, "failed": 1}, rows=(("cost", "1.50 USD"),))
    text = text_of(browser(study))
    assert "Running: 1 of 33 trials ended, 1 failed, about 20 s left." in text
    assert "cost 1.50 USD" in text
    assert "o3 baseline 29 1 " in text


@pytest.mark.parametrize(
    ("code", "ended", "failed", "kind", "words", "goes_on"),
    [
        (0, 33, 0, "finished", "Finished: all 33 trials ended, and no problems were found.", 0),
        (0, 30, 0, "stopped", "holds only 30 of its 33 trials", 0),
        (None, 30, 0, "stopped", "Stopped without a word", 1),
        (130, 30, 0, "stopped", "Stopped: it was interrupted (Ctrl-C). 30 of 33 trials", 1),
        (3, 30, 0, "stopped", "the account's quota or --max-cost was used up", 1),
        (4, 30, 3, "stopped", "a replay makes no calls", 0),
        (1, 31, 2, "stopped", "31 of 33 trials have an outcome, 2 failed", 1),
        (1, 33, 0, "stopped", "merge-runner audit --sweep s", 0),
    ],
)
def test_the_verdict_says_how_it_ended_and_what_to_type(code, ended, failed, kind, words, goes_on):
    row = {**ROW, "exit_code": code, "ended": ended, "failed": failed}
    if code is None:
        row["ended_at"] = None
    run = run_of(row, CONFIG, None)
    assert run["kind"] == kind
    assert words in run["text"]
    assert run["command"] == (TYPED if goes_on else "")
    assert run_of(row, CONFIG | {"typed": []}, None)["command"] == ""
    assert run_of(row, CONFIG, None, later="later")["command"] == ""


def test_a_finished_sweep_says_what_went_wrong_on_the_way():
    run = run_of(ROW | {"faults": 5, "invalid": 1, "ended": 33}, CONFIG, None)
    met = "failed attempts 5, invalid replies 1"
    assert run["text"] == f"Finished: all 33 trials ended; on the way: {met}."
    assert run["kind"] == "finished"


@pytest.mark.parametrize("doubt", [{"others": 7}, {"invalid": 8}])
def test_a_finished_sweep_of_another_model_or_without_valid_replies_is_doubtful(doubt):
    run = run_of(ROW | doubt, {}, None)
    assert run["kind"] == "doubtful"
    assert ("no problems" in run["text"]) == ("others" in doubt)


def test_what_runs_and_trials_share_counts_once_over_all_runs(study):
    with write_database(study) as connection:
        connection.execute(
            "INSERT INTO sweeps BY NAME SELECT * REPLACE ('newer' AS sweep_id) FROM sweeps;"
            "INSERT INTO sweep_trials SELECT 'newer', trial_id, spec_hash FROM sweep_trials;"
            "INSERT INTO calls BY NAME SELECT * REPLACE (other.trial_id AS trial_id) FROM calls, "
            "(SELECT max(trial_id) AS trial_id FROM trials) AS other WHERE calls.trial_id = "
            "(SELECT min(trial_id) FROM trials)"
        )
        calls, usd, shared = connection.execute(
            "SELECT count(*), sum(usd), count(*) FILTER (trials > 1) FROM (SELECT count(DISTINCT "
            "trial_id) AS trials, any_value(cost_usd) AS usd FROM calls GROUP BY call_key, attempt)"
        ).fetchone()
    catalogue = Site(study).catalogue
    assert len(list_runs(catalogue)) == 2
    for row in numbers_of(catalogue, {}).values():
        assert (row["replies"], row["shared"], row["ended"]) == (calls, shared, 29)
        assert row["cost_usd"] == pytest.approx(usd)
    assert shared > 0


def test_a_run_that_begins_while_its_page_is_made_has_counted_nothing_yet(study):
    catalogue = Site(study).catalogue
    catalogue.refresh()
    counted = numbers_of(catalogue, {})
    assert set(counted["begun since"].values()) == {0}
    assert counted["begun since"].keys() == counted[""].keys()


def test_a_scope_changes_what_is_counted_and_no_sentence(study):
    client = browser(study)
    whole, part = (text_of(client, f"/sweeps{scope}") for scope in ("", "?condition=N_0_0"))
    said = re.search(r"How each ended .*", whole)[0]
    assert said.split(" To go on")[0] in part
    assert "30 (3.3 %)" in whole
    assert "0 of 3 " in part
    assert "0 of 3 " not in whole


def test_a_page_follows_a_sweep_to_its_end_and_has_each_state_read_out_once(study):
    running(study)
    client = browser(study)
    look = news_of(client.get(URL).text)
    assert client.get(look).status_code == 204
    running(study, ended={"finished": 3})
    told = client.get(look).text
    # Who listens finds the same state, which is not read out again.
    assert '<span aria-live="off">Running: 3 of 33' in told
    Store(study).end_sweep("sweep-1", END, 130)
    remove_standing(study, "sweep-1")
    assert "<span>Stopped: it was interrupted" in client.get(news_of(told)).text


def test_a_sweep_that_slept_goes_on_on_the_same_page(study):
    running(study, updated_at=datetime(2026, 1, 1, tzinfo=UTC))
    client = browser(study)
    shown = client.get(URL).text
    assert "Stopped without a word" in shown
    running(study)
    assert "<span>Running: 2 of 33" in client.get(news_of(shown)).text


@pytest.mark.slow
def test_a_sweep_is_not_said_to_be_lost_while_its_end_cannot_be_read(study):
    running(study)
    client = browser(study)
    look = news_of(client.get(URL).text)
    with held(study):
        remove_standing(study, "sweep-1")
        assert client.get(look).status_code == 204
    assert "Stopped without a word" in client.get(look).text


def test_the_newest_sweep_is_the_first_of_the_list(study):
    client = browser(study)
    with write_database(study) as connection:
        connection.execute(
            "INSERT INTO sweeps BY NAME SELECT * REPLACE ('newer' AS sweep_id, "
            "started_at + INTERVAL 1 DAY AS started_at) FROM sweeps"
        )
    assert re.findall(r'<th scope="row"><a href="([^"]*)"', client.get("/sweeps").text) == [
        "/sweeps/newer",
        URL,
    ]
    assert "A later run went on with it." in text_of(client)


def test_a_page_that_looks_for_news_gets_them_once(study):
    Store(study).end_sweep("sweep-1", END, 0)
    client = browser(study)
    looks = {page: news_of(client.get(page).text) for page in ("/sweeps", "/trials", URL)}
    assert {page: client.get(look).status_code for page, look in looks.items()} == dict.fromkeys(
        looks, 204
    )
    with write_database(study) as connection:
        connection.execute(
            "INSERT INTO sweeps BY NAME SELECT * REPLACE ('newer' AS sweep_id, "
            "started_at + INTERVAL 1 DAY AS started_at) FROM sweeps"
        )
        connection.execute("DELETE FROM trials WHERE condition = 'N_0_0'")
    told = {page: client.get(look) for page, look in looks.items()}
    assert 'href="/sweeps/newer"' in told["/sweeps"].text
    assert "the database holds only" in told[URL].text
    assert "The database has changed since" in told["/trials"].text
    for reply in told.values():
        assert client.get(news_of(reply.text)).status_code == 204
    assert "seen=" not in re.search(r'<a href="([^"]*)">Show them', told["/trials"].text)[1]


def news_of(text):
    """Where a page looks for what is new."""
    return html.unescape(re.search(r'hx-get="([^"]*seen=[^"]*)"', text)[1])


def test_a_database_without_sweeps_says_what_plays_one(tmp_path):
    Store(tmp_path / "m.duckdb")
    client = browser(tmp_path / "m.duckdb")
    home = client.get("/")
    assert home.status_code == 200
    assert "No trial of a driver is stored. <code>merge-runner sweep baseline</code>" in home.text
    assert "holds no sweep" in client.get("/sweeps").text
    assert client.get("/sweeps/none").status_code == 404
