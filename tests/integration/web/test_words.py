"""Search in what drivers said: what is found, what is shown of it, and what else chooses."""

import re
import shutil
from html import unescape

import duckdb
import pytest

from merge_runner_analysis.web.search import PAGE
from tests.support.cases import cases
from tests.support.serving import Page, client_of, held
from tests.support.studies import Drive, Said, damage, write_study

TALKING = Drive(
    "o3", "baseline", "L_4_0", 1, (0.1,) * 9, (-0.1,) * 9, {3: Said(failure="no_array")}
)
OTHER = [Drive("o4", "A1", "N_0_0", rep, (0.1,) * 9, (-0.1,) * 9, {}) for rep in (1, 2, 3)]
SILENT = Drive("idm", "baseline", "N_0_0", 1, (0.1,) * 9, (-0.1,) * 9)
# What the left driver of the first trial says, by decision: an answer and a rationale.
SAID = {
    0: ("M", "I am AHEAD, so I merge first."),
    1: (None, "No brake. The gap\nis small."),
    2: ("Y", "We are on a collision course & I <b>brake</b> hard; Straße İz \u202e."),
    3: ("Y", "Braking on."),
}


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    path = tmp_path_factory.mktemp("words") / "t.duckdb"
    write_study(path, [TALKING, *OTHER, SILENT])
    with duckdb.connect(str(path)) as connection:
        connection.execute("UPDATE decisions SET rationale = 'The road is clear.', tactical = 'M'")
        connection.executemany(
            "UPDATE decisions SET tactical = ?, rationale = ? "
            "WHERE trial_id LIKE 'o3/%' AND side = 'left' AND decision = ?",
            [(tactical, text, number) for number, (tactical, text) in SAID.items()],
        )
    return path


@pytest.fixture(scope="module")
def client(db):
    return client_of(db)


def found(client, **asked):
    """The decisions on a page of results, as trial, side and number."""
    text = unescape(client.get("/words", params=asked).text)
    link = r'<th scope="row"><a href="/trials/([^/"]+)/[^"?]+\?[^"]*side=(\w+)&decision=(\d+)'
    return [(trial, side, int(number)) for trial, side, number in re.findall(link, text)]


@pytest.mark.parametrize("case", cases("explorer", "words"))
def test_a_decision_is_found_by_all_words_of_a_query_and_no_others(client, case):
    expected = [("o3", "left", number) for number in case["decisions"]]
    assert found(client, q=case["query"]) == expected


def test_matches_are_marked_and_what_a_model_wrote_stays_text(client):
    text = client.get("/words", params={"q": "brake"}).text
    assert "<mark>brake</mark>" in text
    assert "&amp; I &lt;b&gt;<mark>brake</mark>&lt;/b&gt; hard" in text
    assert ("[U+202E]" in Page(text).text, "\u202e" in text) == (True, False)


@pytest.fixture
def copy(db, tmp_path):
    return shutil.copy(db, tmp_path / "t.duckdb")


def test_what_is_said_is_chosen_beside_what_is_planned_and_driven_and_facets_count_it(copy):
    damage(
        copy,
        "UPDATE decisions SET plan = [0.5, 0.1], applied = [-0.2] WHERE trial_id LIKE 'o3/%' "
        "AND side = 'left' AND decision = 2",
        "UPDATE decisions SET plan = [0.0], applied = [0.0] WHERE trial_id NOT LIKE 'o3/%'",
    )
    client = client_of(copy)
    for asked, number in (
        ({"tactical": "none", "model": "o3"}, 1),
        ({"failure": "no_array"}, 3),
        # Between them nothing was said about who goes first: it is a change of mind all the same.
        ({"switch": "M to Y"}, 2),
        ({"switch": "Y to M"}, 4),
        ({"tactical": "Y", "planned": "go"}, 2),
        ({"driven": "brake", "planned": "go"}, 2),
        ({"planned_from": "0.25", "planned_to": "0.35"}, 2),
    ):
        assert found(client, **asked) == [("o3", "left", number)], asked
    assert found(client, tactical="Y", planned="hold") == []
    assert found(client, planned_from="0.35", model="o3", tactical="Y") == []
    for asked in ({"planned": "hold", "model": "o4"}, {"condition": "N_0_0"}):
        assert {trial for trial, *_ in found(client, **asked)} == {"o4"}, "a program says nothing"
    page = Page(client.get("/words", params={"model": "o3", "tactical": "Y"}).text)
    shares = [(to, n) for to, n in page.to("/words?") if "planned=" in to and n.isdigit()]
    assert shares
    for link, count in shares:
        assert f"<strong>{count}</strong> decisions" in client.get(link).text
    facets = re.findall(r'value="(?:M|Y|none)"[^>]*>([^<]+)<', client.get("/words?q=brak").text)
    assert facets == ["yield (2)", "none (1)"]


def test_what_is_found_comes_in_pages(client, db):
    with duckdb.connect(str(db), read_only=True) as connection:
        every = connection.execute(
            "SELECT split_part(trial_id, '/', 1), side, decision FROM decisions "
            "WHERE trial_id NOT LIKE 'idm/%' ORDER BY trial_id, spec_hash, decision, side"
        ).fetchall()
    assert len(every) > PAGE
    assert found(client) == every[:PAGE]
    assert found(client, page=2) == every[PAGE:]
    assert found(client, page=99) == every[PAGE:]


def test_what_stand_ins_say_comes_last(copy):
    damage(copy, "UPDATE trials SET scripted = true WHERE trial_id LIKE 'o3/%'")
    assert [found(client_of(copy), page=page)[-1][0] for page in (1, 2)] == ["o4", "o3"]


def test_words_of_new_trials_are_found_and_those_of_removed_ones_are_not(copy):
    client = client_of(copy)
    assert len(found(client, q="brake")) == 2
    with held(copy):  # what was read is searched meanwhile
        assert len(found(client, q="brake")) == 2
    with duckdb.connect(str(copy)) as connection:
        connection.execute("DELETE FROM trials WHERE trial_id LIKE 'o3/%'")
    assert found(client, q="brake") == []
    write_study(copy, [Drive("o5", "baseline", "N_0_0", 1, (0.1,), (-0.1,), {})])
    with duckdb.connect(str(copy)) as connection:
        connection.execute("UPDATE decisions SET rationale = 'I brake.'")
    assert {trial for trial, *_ in found(client, q="brake")} == {"o5"}
