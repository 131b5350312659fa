"""What readers note: who may, where it is kept and what is shown of it."""

import json
import re
import shutil
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest

from merge_runner.errors import UsageError
from merge_runner_analysis.web.app import MOST_NOTED
from merge_runner_analysis.web.note_file import LONGEST_NAME, LONGEST_TEXT, Notes, reader_of
from tests.support.hostile import HOSTILE
from tests.support.serving import HOST, Page, client_of
from tests.support.studies import write_study, yielding

TRIAL, OTHER = (f"o3/baseline/{name}/rep01" for name in ("N_0_0", "L_4_0"))
OURS = {"origin": f"http://{HOST}"}


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    return write_study(tmp_path_factory.mktemp("noted") / "study.duckdb", yielding("o3", reps=1))


@pytest.fixture
def db(study, tmp_path):
    """A copy of the study, with nothing noted."""
    return shutil.copy(study, tmp_path / "study.duckdb")


def asking(db, reader="anna"):
    client = client_of(db, reader=reader)
    client.headers.update(OURS)
    client.follow_redirects = False
    return client


def noted(client, **given):
    return client.post("/notes", data={"trial": TRIAL, **given})


def lines(db):
    path = Notes(db).path
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def test_a_note_is_a_line_beside_the_database_and_shown_on_its_trial_in_lists_and_on_a_page(db):
    before, client, text = db.read_bytes(), asking(db), "It hesitates. #Late"
    assert noted(client, text=text, side="left", decision="2").status_code == 303
    (line,) = lines(db)
    assert (line.pop("spec_hash"), line.pop("at")) > ("", "")
    told = {"reader": "anna", "trial_id": TRIAL, "side": "left", "decision": 2, "text": text}
    assert line.items() >= told.items()
    assert [tag for _, _, tag in Notes(db).read().tags] == ["late"]
    assert db.read_bytes() == before
    assert Notes(db).path == db.with_name("study.notes.jsonl")
    pages = [f"/trials/{TRIAL}", "/notes", f"/trials/{OTHER}"]
    assert ["It hesitates." in client.get(page).text for page in pages] == [True, True, False]
    listed = client.get("/trials?tag=late").text
    assert "<strong>1</strong> trials" in listed
    assert TRIAL in listed
    assert '<option value="late">late (1)</option>' in client.get("/trials").text


def test_only_a_page_of_ours_writes(db):
    client = asking(db)
    client.headers.pop("origin")
    for headers in (
        {},
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {**OURS, "sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"},
        {**OURS, "sec-fetch-site": "same-site"},
        {"origin": "http://evil.example:8700", "host": "evil.example:8700"},
        {"referer": f"http://{HOST}/"},
    ):
        reply = client.post("/notes", data={"trial": TRIAL, "text": "x"}, headers=headers)
        assert reply.status_code == (400 if "host" in headers else 403), headers
    assert lines(db) == []


def test_what_is_no_note_is_told_and_not_kept(db):
    client = asking(db)
    for given, code, told in (
        ({"text": "  "}, 400, "up to 4,000 characters"),
        ({"text": "x" * (LONGEST_TEXT + 1)}, 400, "up to 4,000 characters"),
        ({"text": "x", "side": "left"}, 400, "a decision"),
        ({"text": "x", "side": "up", "decision": "1"}, 400, "a decision"),
        ({f"field{number}": "x" for number in range(11)}, 400, "fields"),
        ({"text": "x" * MOST_NOTED}, 413, "too large"),
        ({"text": "x", "trial": "no/such"}, 404, "no/such"),
    ):
        reply = noted(client, **given)
        assert (reply.status_code, told in reply.text) == (code, True), told
    assert lines(db) == []
    Notes(db).path.mkdir()
    reply = noted(client, text="x")
    assert (reply.status_code, "nothing was noted" in reply.text) == (400, True)
    assert "study.notes.jsonl cannot be read" in client.get("/notes").text
    assert client.get(f"/trials/{TRIAL}").status_code == 200
    assert (reader_of(" Anna  B "), bool(reader_of(None))) == ("Anna B", True)
    for odd in ("", " ", "x" * (LONGEST_NAME + 1)):
        with pytest.raises(UsageError, match="--reader needs a name"):
            reader_of(odd)


def test_what_a_reader_wrote_is_text_everywhere(db):
    client = asking(db, HOSTILE[:LONGEST_NAME])
    noted(client, text=f"{HOSTILE} #<b>\u202e #b")
    for address in (f"/trials/{TRIAL}", "/notes", "/trials"):
        text = client.get(address).text
        assert "<script>document" not in text
        assert "\u202e" not in "".join(Page(text).said)


def test_a_damaged_line_is_told_and_skipped_and_kept(db):
    client = asking(db)
    damages = (b'{"at": "1', b"\xff\xfe", b'{"reader": 3}', b"null", b"")
    for number, damage in enumerate(damages):
        noted(client, text=f"before {number}")
        with Notes(db).path.open("ab") as file:
            file.write(damage)  # as by a process that died amid a line
    noted(client, text="after")
    text = client.get("/notes").text
    assert all(said in text for said in ("after", *(f"before {n}" for n in range(5))))
    told = re.findall(r"line (\d) of study.notes.jsonl is damaged", text)
    assert told == ["2", "4", "6", "8"]
    assert all(damage in Notes(db).path.read_bytes() for damage in damages)


def _write(db, reader):
    notes = Notes(db, reader)
    for number in range(30):
        notes.add(TRIAL, "spec", "", None, f"#t{number} {'x' * 3000}")


def test_two_explorers_that_write_at_once_lose_nothing(tmp_path):
    db = tmp_path / "t.duckdb"
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        list(pool.map(_write, [db, db], ["anna", "ben"]))
    kept = Notes(db).read()
    assert kept.damage == ()
    assert sorted((note.reader, note.text.split()[0]) for note in kept.notes) == sorted(
        (reader, f"#t{number}") for reader in ("anna", "ben") for number in range(30)
    )


def test_notes_fit_a_copy_of_the_study_and_tell_where_a_trial_is_not_in_it(db, tmp_path):
    noted(asking(db), text="It hesitates.")
    copy = tmp_path / "copy" / "other.duckdb"
    copy.parent.mkdir()
    shutil.copy(db, copy)
    line = Notes(db).path.read_text()
    Notes(copy).path.write_text(line + line.replace(TRIAL, "gone/rep01"))
    text = asking(copy, "ben").get("/notes").text
    assert f"{TRIAL}</a>" in text
    assert "gone/rep01 <small>not in this database" in text
