"""The study on one screen and its drivers: the numbers of the table, and where they lead."""

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from html import unescape

import pytest

from merge_runner.errors import UsageError
from merge_runner.results.store import query
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.headlines import headline, sentence
from merge_runner_analysis.selection import Selection
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.table_format import TableFormat
from merge_runner_analysis.tables import formats, make_tables
from merge_runner_analysis.tables.model import from_text
from merge_runner_analysis.web.answers import answer
from merge_runner_analysis.wording import MEASURES, by_group, verdict_word
from tests.support import program
from tests.support.serving import Page, client_of, in_process, listed, never, words_of
from tests.support.studies import Said, changed, write_study, yielding

WORST = "L_0_-8"
COLUMNS = {
    "o3": ("estimate", "ci"),
    "people": ("human", "human_ci"),
    "difference from people": ("difference", "difference_ci"),
    "80 % power from": ("detectable", ""),
}
NUMBER = re.compile(r"[−-]?\d+(?:\.\d+)?(?:e-\d+)?")


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    """o3 and a variant of it, which collide in two conditions, and o4; one trial is lost.

    o3 drove one condition less often, so that the humans beside it weigh otherwise than by
    themselves.
    """
    drives = yielding("o4", reps=1)
    for drive in [*yielding("o3", reps=2), *yielding("o3", "A1", reps=1)]:
        crash = drive.condition == WORST or (drive.condition == "N_0_0" and drive.rep == 1)
        is_lost = drive.condition == "R_0_8" and drive.rep == 2
        said = {1: Said(("timeout",), lost=True)} if is_lost else {}
        straight = {"left": (0.0,), "right": (0.0,)} if crash else {}
        if drive.condition != "R_-2_8" or drive.rep == 1:
            drives.append(replace(drive, said=said, **straight))
    config = {"typed": ["sweep", "test"]}
    return write_study(tmp_path_factory.mktemp("home") / "study.duckdb", drives, config=config)


@pytest.fixture(scope="module")
def client(db):
    return client_of(db)


@pytest.fixture(scope="module")
def verdicts(db):
    return by_group(table_of(db, "verdicts").rows)


def table_of(db, *asked):
    """A table, which is made once for a page and what it is compared with."""
    return from_text(answer(db, ("table", *asked))["table"])


def agree(html: str, values: list[float]) -> bool:
    """Whether a piece of a page begins with these values, each rounded; an interval has a level."""
    texts = NUMBER.findall(re.sub(r"<[^>]*>|\[[\d.]+ %:", " ", html).replace("−", "-"))
    return len(texts) >= len(values) and all(
        abs(float(text) - value) <= 0.5000001 * 10.0 ** -len(text.partition(".")[2])
        for text, value in zip(texts, values, strict=False)
    )


def test_the_study_says_and_shows_what_the_table_of_verdicts_has(client, verdicts):
    own = verdicts["o3/baseline"]
    first = Page(unescape(client.get("/").text))
    assert " ".join(headline({"o3": own, "o4": verdicts["o4/baseline"]})) in first.text
    assert "With other prompts: A1 (-History)." in first.text
    text = unescape(client.get("/drivers").text)
    page = Page(text)
    assert sentence(own).removesuffix(".") in page.text
    cell = r'href="/drivers/o3\?variant=baseline#([\w-]+)"\s+title="([^"]+)">(.*?)</a>'
    told = {name: texts for name, *texts in re.findall(cell, text, re.DOTALL)}
    judged = {name: values for name, values in own.items() if values["estimate"] is not None}
    assert len(judged) >= 3
    for name, values in judged.items():
        title, shown = told[name]
        for printed in (title, shown):
            assert agree(printed, [values["estimate"], *values["ci"]]), (name, printed)
        assert f"n = {values['n']}" in title
        assert verdict_word(values) in title
    assert page.inline == []
    for address in ("/", "/drivers/o3?variant=baseline", "/tables/verdicts", "/tables/gap"):
        html = client.get(address).text
        shown = re.sub(r"<(script|svg).*?</\1>|<[^>]*>", " ", html, flags=re.DOTALL)
        assert not re.search(r"(?<![\w-])-\d+\.\d", shown)
        assert re.search(r"−\d", shown)


def test_a_drivers_page_has_the_numbers_of_the_table_with_the_trials_behind_them(client, verdicts):
    text, own = unescape(client.get("/drivers/o3?variant=baseline").text), verdicts["o3/baseline"]
    assert sentence(own).removesuffix(".") in text
    table = text.split('class="verdicts')[1].split("</table>")[0]
    heads = [re.sub("<[^>]*>", "", head) for head in re.findall("<th [^>]*col.*?</th>", table)]
    for name, values in own.items():
        row = table.split(f'id="{name}"')[1].split("</tr>")[0]
        assert MEASURES[name].trait in row
        cells = dict(zip(heads[1:], re.findall("<td.*?</td>", row, re.DOTALL), strict=True))
        for label, column in COLUMNS.items():
            estimate, ci = (values.get(part) for part in column)
            assert estimate is None or agree(cells[label], [estimate, *(ci or ())]), (name, label)
    page = Page(text)
    ((link, n), *_) = [link for link in page.to("/trials?") if "cell=verdicts" in link[0]]
    assert listed(client.get(link).text) == int(n) == own["headway"]["n"]
    for link, count in page.to("/trials?"):
        assert not count.isdigit() or listed(client.get(link).text) == int(count), link
    peoples = client.get("/drivers/human").text
    assert "990 trials" in peoples
    # Their published numbers are of all situations, whichever is chosen.
    assert words_of(client.get("/drivers/human?condition=L_4_8").text) == words_of(peoples)
    assert client.get("/drivers/nobody").status_code == 404
    for wrong in ("variant=A9", "condition=nowhere", "sweep=none", "model=nobody"):
        assert client.get(f"/?{wrong}").status_code == 404


def test_a_table_comes_as_a_file_and_the_page_of_prompts_leads_to_discordant_trials(client, db):
    page, tables = (
        Page(client.get("/tables/attempts").text),
        make_tables(StudyResults(db), ["attempts"]),
    )
    for form, suffix in ((TableFormat.CSV, "csv"), (TableFormat.LATEX, "tex")):
        reply = client.get(f"/tables/attempts.{suffix}")
        assert reply.text == formats.render(tables, form) + "\n"
        assert f'filename="attempts.{suffix}"' in reply.headers["content-disposition"]
        assert page.to(f"/tables/attempts.{suffix}")
        assert client.get(f"/tables/nothing.{suffix}").status_code == 404
    assert client.get("/tables/attempts.exe").status_code == 404
    assert Page(client.get("/prompts").text).to("/discordant?model=o3&variant=A1")


def test_the_scope_is_in_the_address_and_every_number_obeys_it(client, db):
    variant = Page(client.get("/?variant=A1").text)
    assert variant.to("/drivers/o3?variant=A1")
    assert variant.to("/drivers/o3?variant=baseline") == []
    one = Page(client.get(f"/?condition={WORST}").text)
    whole = {to for to, n in one.to("/trials?") if n == "2" and "outcome" not in to}
    assert {listed(client.get(link).text) for link in whole} == {2}
    rows = by_group(table_of(db, "verdicts", "", WORST).rows)
    collisions = rows["o3/baseline"]["collisions"]
    assert collisions["n"] + (collisions["undecided"] or 0) == 2
    assert rows["human"]["collisions"]["n"] == 90
    played = StudyResults(db, Selection(sweep="sweep-1")).played
    assert [len(group.trials) for group in played] == [21, 11, 11]
    with pytest.raises(UsageError, match="unknown run 'no'; valid: sweep-1"):
        StudyResults(db, Selection(sweep="no"))


def test_links_take_the_scope_to_every_page(client):
    part = f"variant=baseline&condition={WORST}"
    pages = ("drivers", "trials", "words", "prompts", "sweeps", "sql")
    for page in ("", *pages):
        text = unescape(client.get(f"/{page}?{part}").text)
        assert re.search(f'<option value="{WORST}"[^>]* selected', text)
        assert {f"/{other}?{part}" for other in pages} <= {to for to, _ in Page(text).links}
    assert f"condition in ('{WORST}')" in text


def test_a_driver_stands_beside_another(client, db):
    text = client.get("/drivers/o3?variant=baseline&with=o4").text
    verdicts, _, by_condition = text.partition("Situation by situation")
    drawn = re.findall(r'class="o" href="#(\w+)" x="([\d.]+)%"', verdicts)
    assert {shape for shape, _ in drawn} == {"other", "beyond"}
    # Outside its axis it has an arrow, and its own mark stands beside that.
    arrow = r'<use class="(.)" href="#beyond" x="100.0%" y="\d+%"/>\s*'
    mark = r'<use class="\1" href="#(\w+)" x="100.0%" y="\d+%" transform="translate\(-15 0\)"/>'
    beyond = re.findall(arrow + mark, verdicts)
    assert {("d", "open"), ("o", "other")} <= {*beyond}
    assert len(beyond) == verdicts.count('href="#beyond" x="100.0%"')
    left_first = re.search(r"Left goes first <small>.*?</tr>", by_condition, re.DOTALL)[0]
    sql = (
        "SELECT round(100 * avg((merged_first = 'left')::INT), 2) FROM trials "
        "WHERE spec_hash = 'o3-baseline' AND merged_first IS NOT NULL GROUP BY condition"
    )
    shares = sorted(share for (share,) in query(db, sql)[1])
    marks = re.findall(r'class="d" href="#plain" x="([\d.]+)%"', left_first)
    assert (sorted(map(float, marks)), len(marks)) == (shares, 10)  # in one it collides
    assert left_first.count('class="band"') == left_first.count('href="#other"') == 11
    numbers = [words for _, words in Page(client.get("/drivers").text).to("/trials?")]
    assert sum(words.isdigit() for words in numbers) == 3


def test_a_note_is_at_its_mark_and_below_and_a_page_without_notes_explains_none(client, db):
    notes = {
        row.note
        for row in table_of(db, "verdicts").rows
        if row.groups[0] == "o3/baseline" and row.note and "I5" not in row.note
    }
    assert notes
    for address in ("/drivers?variant=baseline", "/drivers/o3?variant=baseline&with=o4"):
        page = client.get(address).text
        assert "† has a note: point at it, or see below" in page
        at_mark = {unescape(note) for note in re.findall(r'<abbr title="([^"]*)">†</abbr>', page)}
        assert notes <= at_mark
        below = words_of(page.partition('<ul class="notes">')[2])
        assert all(note[1:].replace("-", "−") in below.replace("-", "−") for note in notes)
    assert "†" not in client.get("/drivers/human").text


def test_situations_come_in_their_usual_order_or_by_the_difference_from_people(client):
    page = client.get("/?variant=baseline").text
    (link,) = [to for to, text in Page(page).to("/?") if text == "by difference from people"]
    for address in (link, "/drivers/o3?variant=baseline&order=difference"):
        by_difference = client.get(address.partition("#")[0]).text
        heads = by_difference.partition("Situation by situation")[2]
        order = re.findall(r'href="/conditions/([^"?]*)', heads)[:11]
        # It crashed there in each of 2 trials, and in one of 2 side by side.
        assert order[:2] == [WORST, "N_0_0"]
        assert sorted(order) == sorted(HUMAN_CONDITIONS)
        path = address.partition("?")[0]
        assert Page(by_difference).to(f"{path}?variant=baseline#by-condition")
    usual = re.findall(r'href="/conditions/([^"?]*)', page.partition("by situation")[2])[:11]
    assert usual == list(HUMAN_CONDITIONS)


def test_a_driver_that_is_not_judged_has_no_verdict_and_missing_decisions_are_counted(tmp_path):
    prose = dict.fromkeys(range(99), Said(failure="no_array"))
    missing = dict.fromkeys(range(2), Said(failure="no_decision"))
    bad = [replace(drive, said=prose, left=(), right=()) for drive in yielding("bad", reps=1)]
    good = [replace(drive, said=missing) for drive in yielding("o3", reps=1)[:3]]
    client = client_of(write_study(tmp_path / "t.duckdb", [*bad, *good]))
    page = Page(client.get("/").text)
    why = "Not judged: 46 of the 92 decisions of bad are invalid (50.0 %, more than 20 %)."
    assert why in page.text
    assert "Not judged" in client.get("/drivers/bad").text
    drivers = Page(client.get("/drivers").text).to("/drivers/")
    judged = {to.partition("?")[0] for to, _ in drivers if "#" in to}
    assert judged == {"/drivers/o3"}
    ((link, count),) = [one for one in page.to("/trials?") if "missing" in one[0]]
    assert (count, listed(client.get(link).text)) == ("6", 3)
    driver = Page(client.get("/drivers/o3?variant=baseline").text).text
    assert "Without the decision asked for 6" in driver
    assert "missing decisions" in client.get("/sweeps/sweep-1").text


def test_every_page_with_a_drivers_verdicts_says_which_of_its_trials_are_not_counted(tmp_path):
    good = [*yielding("o3"), *yielding("o3", "A1", reps=1)]
    failed = replace(good[0], rep=4, said={0: Said(lost=True)})
    client = client_of(write_study(tmp_path / "t.duckdb", [*good, failed]))
    for address in ("/", "/drivers", "/drivers/o3?variant=baseline"):
        text = Page(client.get(address).text).text
        assert text.count("33 counted; not counted: 1 did not end") == 1, address


def test_counts_by_situation_say_whether_they_include_trials_that_repeat_another_one(tmp_path):
    pages = []
    for reps in "12":
        words = ("sweep", "baseline", "--model", "constant", "--conditions", "N_0_0")
        done = program.invoke((*words, "--reps", reps, "--db", reps), cwd=tmp_path, env={})
        assert done.code == 0, done.err
        pages.append(Page(client_of(tmp_path / reps).get("/").text).text)
    assert ["also of trials that repeat another one" in text for text in pages] == [False, True]


def test_the_study_begins_with_its_description_and_says_what_to_type_and_counts_at_once(
    db, tmp_path
):
    copy = shutil.copy(db, tmp_path / "study.duckdb")
    config = json.dumps({"description": "Who is <first>?", "typed": ["sweep", "test"]})
    changed(copy, f"UPDATE sweeps SET config = '{config}', ended_at = started_at, exit_code = 3")
    client = client_of(copy, in_process(copy, never), program="/opt/bin/merge-runner")
    text = client.get("/").text
    page = Page(text)
    assert '<h1 class="question">Who is &lt;first&gt;?</h1>' in text
    for said in (
        "This could not be computed",
        "Stopped: the account",
        "/opt/bin/merge-runner sweep test",
    ):
        assert said in page.text
    links = [(to, words) for to, words in page.to("/trials?") if words.isdigit()]
    assert len(links) >= 3
    assert [(to, str(listed(client.get(to).text))) for to, _ in links] == links
    (again,) = re.findall(r'data-from="(/\?seen=[^"]+)"', text)
    assert client.get(again).status_code == 204
    changed(copy, "UPDATE sweeps SET exit_code = 0")
    assert "Stopped: the account" not in client.get(again).text
    # They would hold up the first page by a second; the worker imports them beside it.
    code = "import sys, merge_runner_analysis.web.app; sys.exit('scipy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_emulators_lot_is_said_where_it_meets_itself(tmp_path):
    db = tmp_path / "t.duckdb"
    write_study(db, [*yielding("emulator", reps=1), *yielding("dear", reps=1)])
    changed(db, "UPDATE trials SET model_left = 'emulator' WHERE model_left = 'dear'")
    rows = words_of(client_of(db).get("/").text).split("who goes first is drawn by lot")
    assert len(rows) == 2
    assert rows[0].rstrip().endswith(" emulator 11 trials")
