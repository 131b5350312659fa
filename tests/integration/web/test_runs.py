"""The pages of runs: how far, how well, what went wrong; and how a page follows one."""

import html
import json
import re
import shutil
from collections import Counter
from dataclasses import replace
from datetime import UTC, datetime
from urllib.parse import parse_qs, urlsplit

import duckdb
import pytest

from merge_runner.audit.checks import audited_database, sweep_facts
from merge_runner.errors import UsageError
from merge_runner.records import ANSWERS
from merge_runner.results.database import write_database
from merge_runner.results.store import Store, query
from merge_runner.run.progress_file import remove_snapshot, write_snapshot
from merge_runner.run.stored_replay import audit_database
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.selection import Selection
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.web.pages.sweep import sweep_page
from merge_runner_analysis.web.runs import list_runs, numbers_of, repeats, standing_of
from merge_runner_analysis.web.scope import filter_of, scope_of
from merge_runner_analysis.web.site import Site
from tests.support.serving import Page, client_of, held
from tests.support.snapshots import progress, runner
from tests.support.studies import Said, write_study, yielding

URL = "/sweeps/sweep-1"
ARM = {"model": "o3", "variant": "baseline", "repetitions": 3, "factors": {}, "label": "baseline"}
CONFIG = {
    "model": "o3",
    "models": {
        "o3": {"id": "o3", "provider": "openai", "aliases": ["o3-alias"], "note": "retires soon"}
    },
    "arms": [{**ARM, "sides": {"left": "o3", "right": "o3"}}],
    "conditions": list(CONDITIONS),
    "max_cost_usd": 9.0,
}
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


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A sweep of 33 planned trials that holds 30, one of them failed, with troubles."""
    said = dict(enumerate(TROUBLE))
    drives = [
        replace(drive, said={1: said[i]} if i in said else {})
        for i, drive in enumerate(yielding("o3")[:30])
    ]
    path = write_study(tmp_path_factory.mktemp("study") / "m.duckdb", drives, config=CONFIG)
    with duckdb.connect(str(path)) as connection:
        connection.execute("UPDATE calls SET http_status = 200 WHERE model_served IS NOT NULL")
    return path


@pytest.fixture
def study(written, tmp_path):
    """The same, to change it."""
    return shutil.copy(written, tmp_path / "m.duckdb")


def change(db, *statements):
    # Waits for the audit that a page has asked for.
    with write_database(db) as connection:
        for statement in statements:
            connection.execute(statement)


def text_of(client, url=URL):
    reply = client.get(url)
    assert reply.status_code == 200
    return Page(reply.text).text


def page_of(site):
    site.trial_index.refresh()
    return html.unescape(sweep_page(site, "sweep-1", {}))


def asked_by(url):
    return {name: value for name, [value] in parse_qs(urlsplit(url).query).items()}


def news_of(client, url):
    """Where a page looks for what is new."""
    text = url if "<" in url else client.get(url).text
    return html.unescape(re.search(r'data-from="([^"]*seen=[^"]*)"', text)[1])


def running(db, ended=None, **changes):
    """Say that the sweep runs, in this process."""
    shown = progress(runner(), Counter(baseline=3 * len(CONDITIONS)))
    shown.outcome_counts = Counter(ended or {"finished": 2})
    write_snapshot(db, shown.snapshot("sweep-1").model_copy(update={"left_s": 20.0, **changes}))


def test_the_page_has_the_numbers_of_the_database_and_every_rate_leads_to_its_trials(written):
    with audited_database(written) as connection:
        facts = sweep_facts(connection, "sweep-1")
    with duckdb.connect(str(written), read_only=True) as connection:
        ((answers, attempts, failures),) = connection.execute(
            "SELECT (SELECT count(*) FROM calls WHERE http_status = 200), count(*), "
            f"count(*) FILTER (outcome NOT IN {ANSWERS}) FROM attempts"
        ).fetchall()
        invalid = connection.execute(
            "SELECT DISTINCT trial_id FROM decisions WHERE NOT valid ORDER BY ALL"
        ).fetchall()
    client = client_of(written)
    text = text_of(client)
    for name, count, of, things in (
        ("crashes", dict(facts["outcomes"]).get("collided", 0), 29, "ended trials"),
        ("failed trials", 1, 30, "stored trials"),
        ("invalid replies", 2, facts["decisions"], "decisions asked"),
        ("fallbacks", 2, facts["decisions"], "decisions asked"),
        ("failed requests (retried)", failures, attempts, "requests"),
        ("wrong model", 1, answers, "answers"),
    ):
        part = f" ({100 * count / of:.2f} %)" if count else ""
        assert f"{name} {count:,} of {of:,}{part} {things}" in text
    assert "its runs could spend at most 9.00 USD; 1 attempts of unknown cost are not in it" in text
    assert (facts["invalid"], facts["fallbacks"], len(facts["failed"])) == (2, 2, 1)
    trials = {}
    for name, url in re.findall(r'id="(rate-\d)" href="([^"]*)"', page_of(client.site)):
        asked = asked_by(url)
        assert asked["sweep"] == "sweep-1"
        found = client.site.trial_index.every(filter_of(asked))
        trials[name] = [(row["trial_id"],) for row in found]
    assert trials["rate-3"] == trials["rate-4"] == invalid
    assert len(invalid) == 2


def test_every_arm_and_every_cause_leads_to_the_trials_that_it_counts(written):
    site = Site(written)
    links = re.findall(r'id="[ac][^"]*" href="(/trials\?[^"]*)"[^>]*>(\d+)', page_of(site))
    causes = set()
    for url, count in links:
        asked = asked_by(url)
        causes.add(asked.get("cause"))
        totals = site.trial_index.counts(filter_of(asked))
        there = sum(part["trials" if "cause" in asked else "ended"] for part in totals)
        assert there == int(count), url
    attempts = {f"attempt: {name}" for name in ("timeout", "rate_limit", "unknown")}
    assert causes == {None, "model: o3 → another", "plan: no_array", "plan: refusal"} | attempts


def test_trials_are_filtered_by_their_errors_and_by_validity_where_an_address_does(written):
    client = client_of(written)
    for of, shown in (("", ["cause"]), ("?validity=fallbacks", ["cause", "validity"])):
        page = client.get(f"/trials{of}").text
        assert re.findall(r'id="facet-(validity|cause)"', page) == shown


def test_an_alias_is_nothing_that_went_wrong_and_two_other_models_have_a_line_each(study):
    change(study, "UPDATE calls SET model_served = 'third' WHERE trial_id LIKE '%N_0_0%'")
    site = Site(study)
    lines = re.findall(r"model: o3 → ([^<]*)</th>", page_of(site))
    assert sorted(lines) == ["another", "third"]
    for name, trials in (("o3-alias", 0), ("o3", 0), ("another", 1), ("third", 3)):
        found = site.trial_index.every(filter_of({"cause": f"model: o3 → {name}"}))
        assert len(found) == trials
    change(
        study,
        "UPDATE calls SET outcome = 'ok', model_served = 'o3'",
        "UPDATE decisions SET failure = NULL, valid = true, fallback = false",
        "UPDATE trials SET status = 'finished' WHERE status = 'failed'",
    )
    assert "What went wrong" not in page_of(Site(study))


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
    trial_index = Site(study).trial_index
    assert (len(list_runs(trial_index)), shared > 0) == (2, True)
    counted = numbers_of(trial_index, {})
    for row in counted.values():
        assert (row["replies"], row["shared"], row["ended"]) == (calls, shared, 29)
        assert row["cost_usd"] == pytest.approx(usd)
    # A run that begins while its page is made has counted nothing yet.
    assert counted["begun since"] == dict.fromkeys(counted[""], 0)


def test_runs_show_how_they_ended_and_what_the_audit_finds_and_a_scope_changes_numbers_alone(
    study, tmp_path
):
    change(
        study,
        "UPDATE sweeps SET ended_at = started_at + INTERVAL 2 HOURS, exit_code = 1",
        "UPDATE calls SET attempt = attempt + 1 WHERE decision = 0",
    )
    client = client_of(study)
    text, whole, part = (
        text_of(client, f"/sweeps{of}") for of in ("/sweep-1", "", "?condition=N_0_0")
    )
    assert ("lasted 2.0 h" in text, " 2.0 h " in whole) == (True, True)
    assert "The audit found “attempt” in sweep-1" in text
    assert "The audit found “attempt” in sweep-1" in whole
    [run] = audit_database(study, ["sweep-1"])
    assert all(" ".join(note.split()) in text for note in run.notes)
    said = re.search(r"How each ended .*", whole)[0]
    assert said.split(" To go on")[0] in part
    assert "30 (3.33 %)" in whole
    assert ("0 of 3 " in whole, "0 of 3 " in part) == (False, True)
    assert re.search(r"all runs together 3 ", part)
    Store(tmp_path / "none.duckdb")
    client = client_of(tmp_path / "none.duckdb")
    assert "No trial of a driver is stored. merge-runner sweep baseline" in text_of(client, "/")
    assert "holds no run" in text_of(client, "/sweeps")
    assert client.get("/sweeps/none").status_code == 404


def test_a_page_follows_a_sweep_to_its_end_and_has_each_state_read_out_once(study):
    running(study, updated_at=datetime(2026, 1, 1, tzinfo=UTC))
    client = client_of(study)
    shown = client.get(URL).text
    assert "The run was cut off" in shown
    hostile = "<script>alert(1)</script>\u202e<img src=x>"
    rows = (("WARNING", f"another model answers: {hostile}"), ("cost", "1.50 USD"))
    running(study, ended={"finished": 1, "failed": 1}, rows=rows)  # it had slept
    text = text_of(client)
    for said in (
        "Running: 1 of 33 trials ended, 1 failed, about 20 s left.",
        "cost 1.50 USD",
        "o3 29 1 ",
        "<script>alert(1)</script>[U+202E]<img src=x>",
    ):
        assert said in text
    told = client.get(news_of(client, shown)).text
    assert "<span>Running: 1 of 33" in told
    assert not re.search("<script>alert|<img", told + client.get(URL).text)
    look = news_of(client, told)
    assert client.get(look).status_code == 204
    running(study, ended={"finished": 3})
    told = client.get(look).text
    # Who listens finds the same state, which is not read out again.
    assert '<span aria-live="off">Running: 3 of 33' in told
    look = news_of(client, told)
    with held(study):  # its end cannot be read: it is not said to be lost
        remove_snapshot(study, "sweep-1")
        assert client.get(look).status_code == 204
    assert "The run was cut off" in client.get(look).text
    Store(study).end_sweep("sweep-1", END, 130)
    assert "<span>Stopped: it was interrupted" in client.get(look).text


def test_a_page_that_looks_for_news_gets_them_once_and_the_newest_run_is_first(study):
    Store(study).end_sweep("sweep-1", END, 0)
    client = client_of(study)
    pages = ("/sweeps", "/trials", "/conditions/N_0_0", URL)
    looks = {page: news_of(client, page) for page in pages}
    assert [client.get(look).status_code for look in looks.values()] == [204] * 4
    change(
        study,
        "INSERT INTO sweeps BY NAME SELECT * REPLACE ('newer' AS sweep_id, "
        "started_at + INTERVAL 1 DAY AS started_at) FROM sweeps",
        "DELETE FROM trials WHERE condition = 'N_0_0' AND rep = 1",
    )
    told = {page: client.get(look).text for page, look in looks.items()}
    assert [to for to, _ in Page(told["/sweeps"]).to("/sweeps/")][:2] == ["/sweeps/newer", URL]
    assert "the database holds only" in told[URL]
    assert "A later run went on with it." in text_of(client)
    assert "The database has changed since" in told["/trials"]
    assert [client.get(news_of(client, text)).status_code for text in told.values()] == [204] * 4
    assert "seen=" not in re.search(r'<a href="([^"]*)">Show them', told["/trials"])[1]


def test_a_run_of_a_crossed_study_shows_each_driver_and_what_goes_on_with_it(golden_copy):
    db = golden_copy / "golden.duckdb"
    change(
        db, "UPDATE sweeps SET exit_code = 3", "DELETE FROM trials WHERE trial_id LIKE '%rep02%'"
    )
    client = client_of(db)
    ((sweep,),) = query(db, "SELECT sweep_id FROM sweeps WHERE name = 'mine'")[1]
    text = client.get(f"/sweeps/{sweep}").text
    said = Page(text).text
    for words in (
        "Run of mine: cheap, dear",
        "18 of 36 trials have an outcome",
        "merge-runner sweep mine.toml --yes --trust ",
        f" --db {db} ",
        "dear [temperature=0.2]",
    ):
        assert words in said
    arms = re.findall(r'id="arm-[0-9]+" href="([^"]+)">([0-9]+)<', text)
    assert len(arms) == 6
    for link, count in arms:
        assert f"<strong>{count}</strong> trials" in client.get(html.unescape(link)).text, link


def test_a_shown_command_names_the_database_and_the_study_whose_names_it_needs(study):
    site = Site(study, study="mine/study.toml")
    place = f"merge-runner view --db {study}"
    assert site.share("--export", "pages") == f"{place} --study mine/study.toml --export pages"
    assert site.share("FOLDER", of_study=False) == f"{place} FOLDER"
    assert Site(study).share("--export", "pages") == f"{place} --export pages"


def test_the_page_of_a_run_has_the_commands_that_repeat_it_and_what_it_was_played_with(study):
    config = {
        **CONFIG,
        "typed": ["sweep", "mine.toml", "--yes", "--in-flight", "4", "--reps", "3"],
        "endpoints": {"o3": "http://127.0.0.1:8123/v1"},
        "sample_set": 1,
        "models": {"o3": {**CONFIG["models"]["o3"], "parameters": {"temperature": 0.3}}},
    }
    change(
        study,
        f"UPDATE sweeps SET config = '{json.dumps(config)}', git_commit = 'abc123', "
        """git_dirty = true, versions = '{"duckdb":"9.8"}'""",
    )
    other = study.with_name("m-replayed.duckdb")
    text = text_of(client_of(study)).partition("Repeat it")[2]
    for said in (
        f"audit merge-runner audit --sweep sweep-1 --db {study} ",
        f"replay merge-runner replay mine.toml --reps 3 --db {other} ",
        f"merge-runner digest --db {study} ",
        f"merge-runner digest --db {other} ",
        f"merge-runner sweep mine.toml --in-flight 4 --reps 3 --sample-set 2 --db {study} ",
        "program commit abc123, with uncommitted changes",
        "packages duckdb 9.8",
        "o3 o3, local server, http://127.0.0.1:8123/v1, temperature = 0.3",
    ):
        assert said in text
    (run,) = list_runs(Site(study).trial_index)
    replayed = {**run, "config": {**config, "typed": ["replay", "r.parquet"]}}
    assert [name for name, *_ in repeats(replayed)] == ["audit", "replay", "digests", ""]
    assert [name for name, *_ in repeats({**run, "config": CONFIG})] == ["audit"]


def test_a_local_server_is_named_at_its_model_and_no_other_is(study):
    for url, told in (
        ("http://localhost:8123/v1", "local server, http://localhost:8123/v1"),
        ("https://127.0.0.1.example.org/v1", ""),
    ):
        endpoints = json.dumps({**CONFIG, "endpoints": {"o3": url}})
        change(study, f"UPDATE sweeps SET config = '{endpoints}'")
        client = client_of(study)
        head = re.search("<h1>.*?</h1>", client.get(URL).text, re.DOTALL)[0]
        for text in (Page(head).text, text_of(client, "/sweeps")):
            assert ("local server" in text, told in text) == (bool(told), True)


def test_warnings_stand_before_the_verdict_whose_box_has_the_class_of_its_state(study):
    states = {
        "finished": "UPDATE sweeps SET exit_code = 0, ended_at = started_at",
        "stopped": "UPDATE sweeps SET exit_code = 3",
    }
    change(
        study,
        "UPDATE calls SET model_served = 'o3', attempt = attempt + (decision = 0)::INTEGER",
        "UPDATE decisions SET valid = true, fallback = false, failure = NULL",
        f"UPDATE sweeps SET config = '{json.dumps({**CONFIG, 'arms': []})}'",
    )
    for state, change_it in states.items():
        change(study, change_it)
        text = client_of(study).get(URL).text
        assert re.search(r'class="note sweep-verdict (\w+)"', text)[1] == state
        assert 0 < text.index("The audit found") < text.index("sweep-verdict")


def test_a_run_with_a_name_is_called_by_it_in_the_list(study):
    named = """json_merge_patch(config, '{"run_name": "the second"}')"""
    change(study, f"UPDATE sweeps SET config = {named}")
    site = Site(study)
    (run,) = list_runs(site.trial_index)
    assert run["row"]["name"].startswith("the second (")
    assert "<h1>Run of the second (" in page_of(site)
    facets = site.trial_index.facets({})
    assert facets["run"] == [("the second", sum(n for _, n in facets["sweep"]))]
    assert site.trial_index.counts({"run": "the second"}) == site.trial_index.counts(
        {"who": "drivers"}
    )
    assert scope_of(site, {}).sweeps[0][1].startswith("the second (")
    whole, named = (StudyResults(study, Selection(sweep=name)) for name in ("", "the second"))
    assert [len(each.trials) for each in named.played] == [len(e.trials) for e in whole.played]
    with pytest.raises(UsageError, match=r"unknown run 'a third'; valid: the second, sweep-1"):
        StudyResults(study, Selection(sweep="a third"))


def test_a_refused_run_is_news_until_its_model_was_asked_in_a_later_run_of_the_study(study):
    def news():
        return [run["sweep_id"] for run in standing_of(Site(study).trial_index)]

    later = "started_at + INTERVAL 1 DAY AS started_at, ended_at + INTERVAL 1 DAY AS ended_at"
    other = """json_merge_patch(config, '{"model": "o4", "sample_set": 1}')"""
    change(
        study,
        "UPDATE sweeps SET exit_code = 2, ended_at = started_at",
        f"INSERT INTO sweeps SELECT * REPLACE ('sweep-2' AS sweep_id, 0 AS exit_code, {later}, "
        f"{other} AS config) FROM sweeps",
    )
    assert news() == ["sweep-1"]
    change(
        study,
        """UPDATE sweeps SET config = json_merge_patch(config, '{"model": "o4,o3"}')
        WHERE sweep_id = 'sweep-2'""",
    )
    assert news() == ["sweep-2"]
    change(study, "UPDATE sweeps SET exit_code = 3 WHERE sweep_id = 'sweep-1'")
    assert news() == ["sweep-1"]


@pytest.mark.parametrize(
    ("typed", "page"),
    [
        ("/runs", "/sweeps"),
        ("/runs/sweep-1?seen=x", "/sweeps/sweep-1?seen=x"),
        ("/trial/a+b/N_0_0%3F", "/trials/a%2Bb/N_0_0%3F"),
        ("/driver/o3?variant=A1", "/drivers/o3?variant=A1"),
        ("/conditions", "/"),
        ("/figures", "/tables"),
    ],
)
def test_a_page_is_found_by_the_name_that_a_reader_types(written, typed, page):
    reply = client_of(written).get(typed, follow_redirects=False)
    assert (reply.status_code, reply.headers["location"]) == (307, page)
