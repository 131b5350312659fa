"""Prompts of a study whose words are given to one driver, side by side and pair by pair."""

import re
import shutil

import pytest

from merge_runner.results.store import query
from merge_runner_analysis.web.pages import home
from merge_runner_analysis.web.site import Site
from tests.support.harness import FAST
from tests.support.serving import Page, client_of
from tests.support.studies import damage

STUDY = """
models = ["emulator"]
repetitions = 5
conditions = ["N_0_0"]
[factors]
persona = ["none", "taxi"]
hurry = ["no", "yes"]
[texts.persona.taxi]
add = [{ after = "C3.human", text = "You are a taxi driver." }]
given_to = "ego"
[texts.hurry.yes]
add = [{ after = "C3.human", text = "You are late." }]
given_to = "other"
emulator = { own_first = 3.0 }
"""
DIFFERING = """
SELECT count(*) FILTER (one.merged_first <> base.merged_first), count(*)
FROM trials AS one JOIN trials AS base USING (rep)
WHERE one.variant = 'hurry=yes' AND base.variant = 'baseline'
"""


@pytest.fixture(scope="module")
def db(prepare, tmp_path_factory):
    folder = tmp_path_factory.mktemp("prompts")
    (folder / "study.toml").write_text(STUDY)
    done = prepare(folder, "sweep", "study.toml", "--db", "t.duckdb", *FAST)
    assert done.code == 0, done.err
    return folder / "t.duckdb"


def test_an_answer_that_comes_while_its_page_is_made_is_awaited_and_not_left_out(db, monkeypatch):
    """Else the page would say what is said of a study without a question, and stay so."""

    made = Site.table

    def computed_meanwhile(site, name, *part):
        job, table = made(site, name, *part)
        assert job.content
        return job, None if name in home.FACTOR_TABLES else table

    with client_of(db) as client:
        assert 'id="by-level"' in client.get("/").text
        monkeypatch.setattr(Site, "table", computed_meanwhile)
        assert 'data-parts="#home"' in client.get("/").text


def test_what_each_driver_is_told_is_shown_where_the_two_differ(db):
    with client_of(db) as client:
        cards = client.get("/prompts").text.split('<section class="card"')[1:]
    said = {card.partition('"')[2].partition('"')[0]: Page(card).text for card in cards}
    assert "driver is told" not in said["baseline"]
    told, words = "The other driver is told: hurry=yes", "You are late."
    one = said["hurry=yes"]
    assert "The ego is told what the baseline says." in one
    assert f"{told} {words}" in one
    both = said["persona=taxi hurry=yes"]
    assert "The ego is told: persona=taxi You are a taxi driver." in both
    assert f"{told} {words}" in both


def test_a_drivers_page_names_the_mock_model_and_how_people_are_weighted(db):
    with client_of(db) as client:
        client.site.awaited(("table", "verdicts", "", ""))
        page = Page(client.get("/drivers/emulator?variant=baseline").text).text
    assert re.search(r"Requests answered \d+ by the mock model \(", page)
    assert "weighted as the trials of emulator" in page
    assert "are not mirrored here" not in page  # no ego drove on the right


def test_each_trial_says_which_driver_was_told_which_words(db):
    named = "SELECT trial_id, spec_hash FROM trials WHERE variant = 'persona=taxi hurry=yes'"
    columns, rows = query(db, named)
    with client_of(db) as client:
        listing = client.get("/trials").text
        trial = client.site.at.trial(dict(zip(columns, rows[0], strict=True)))
        page = Page(client.get(trial).text).text
    assert re.search(r'<th scope="col"[^>]*>ego</th>', listing)
    assert listing.count("<td>left</td>") == 15  # the baseline tells both the same
    assert "The left driver, the ego, read persona=taxi: You are a taxi driver." in page
    assert "The right driver read hurry=yes: You are late." in page


def test_pairs_are_found_although_an_effect_is_planted_with_the_prompt(db):
    _, [(differing, pairs)] = query(db, DIFFERING)
    assert pairs == 5
    assert differing > 0
    with client_of(db) as client:
        page = Page(client.get("/prompts").text)
        links = page.to("/discordant")
        (to,) = [to for to, name in links if "variant=hurry%3Dyes" in to]
        text = Page(client.get(to).text).text
    assert f"emulator: hurry=yes, {differing} of {pairs} trials" in page.text
    assert "emulator: persona=taxi, " not in page.text  # these ended as with the baseline
    assert "No driver was run with another prompt" not in page.text
    assert f"{differing} of {pairs} ended differently" in text


def test_every_text_that_was_sent_is_shown_with_its_share_of_the_decisions(db):
    sql = (
        "SELECT variant, count(*) FILTER (prompt LIKE '%Road type: straight%'), count(*) "
        "FROM decisions JOIN trials USING (trial_id, spec_hash) GROUP BY ALL"
    )
    with client_of(db) as client:
        cards = client.get("/prompts").text.split('<section class="card"')[1:]
    said = {card.partition('"')[2].partition('"')[0]: Page(card).text for card in cards}
    share = re.compile(r"(Before|After) the merge point (\d+) of (\d+) decisions \(([\d.]+) %")
    for variant, after, sent in query(db, sql)[1]:
        texts = share.findall(said[variant])
        assert sum(int(k) for _, k, *_ in texts) == sent
        assert sum(int(k) for road, k, *_ in texts if road == "After") == after > 0
        assert all((int(n), f"{100 * int(k) / sent:.2f}") == (sent, of) for _, k, n, of in texts)
    before, _, later = said["baseline"].partition("After the merge point")
    assert ("Road type: straight" in before, "Road type: straight" in later) == (False, True)
    assert "%), without C4: tactical decision" in later


def test_a_letter_that_no_prompt_asked_for_is_no_decision_and_silence_is_no_words(db, tmp_path):
    copy = shutil.copy(db, tmp_path / "t.duckdb")
    after = "prompt LIKE '%Road type: straight%'"
    damage(copy, f"UPDATE decisions SET tactical = 'Y', rationale = ' ' WHERE {after}")
    _, [(yielding, silent, every)] = query(
        copy,
        f"SELECT count(*) FILTER (tactical = 'Y' AND NOT {after}), count(*) FILTER ({after}), "
        "count(*) FROM decisions",
    )
    assert yielding > 0
    with client_of(copy) as client:
        page = Page(client.get("/words").text)
        for word, number in (("Y", yielding), ("not asked", silent)):
            text = client.get("/words", params={"tactical": word}).text
            assert f"<strong>{number:,}</strong> decisions" in text
    words = f"{every - silent:,} with words, {silent:,} without"
    assert f"{every:,} decisions in 20 trials: {words}" in page.text
    assert f"Left out: {silent:,} whose prompt did not ask who goes first." in page.text


def test_the_share_of_a_text_is_of_the_chosen_trials(db, tmp_path):
    copy = shutil.copy(db, tmp_path / "t.duckdb")
    damage(copy, "UPDATE trials SET condition = 'L_4_0' WHERE rep = 1")
    sql = "SELECT count(*) FROM decisions JOIN trials USING (trial_id, spec_hash) WHERE "
    with client_of(copy) as client:
        for rule, of in (("rep > 0", {}), ("rep = 1", {"condition": "L_4_0"})):
            _, [(sent,)] = query(copy, f"{sql}{rule} AND variant = 'baseline'")
            assert f" of {sent} decisions" in Page(client.get("/prompts", params=of).text).text
