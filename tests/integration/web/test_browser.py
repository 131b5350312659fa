"""Journeys of a reader in a browser, each from an address to an answer; axe looks at its last page.

All are on a copy of the golden study, which one server shows.
"""

import json
import re
import shutil
import socket
import subprocess
import time

import duckdb
import pytest
from anyio.from_thread import start_blocking_portal
from playwright.sync_api import expect

from merge_runner_analysis.web import computing
from merge_runner_analysis.web.export import export_page
from tests.support.gate import HANGS_S, Gate
from tests.support.harness import PROGRAM, environment, watched
from tests.support.serving import export, in_a_thread, served
from tests.support.web_fixtures import serious

EMULATOR = "emulator/baseline/N_0_0/rep01"
TRIAL = f"/trials/{EMULATOR}"
NEXT = "emulator/baseline/N_0_0/rep02"
COLLIDED = "smollm2/baseline/N_0_0/rep01"
HUMAN = "/trials/human/experiment_1/N_0_0/iter010"
HOSTILE = "/trials/%3Cb%3Eo3%3C%2Fb%3E/baseline/L_4_0/rep01?side=left&decision=1"
OVER = "document.documentElement.scrollWidth - innerWidth"


@pytest.fixture(scope="module")
def db(golden, tmp_path_factory):
    """With two drivers and the odd trials: every other group would be computed as well."""
    path = tmp_path_factory.mktemp("browser") / "golden.duckdb"
    shutil.copy(golden / "golden.duckdb", path)
    with duckdb.connect(str(path)) as connection:
        connection.execute("DELETE FROM trials WHERE model_left IN ('cheap', 'dear')")
        connection.execute("DELETE FROM trials WHERE source = 'driver'")
    return path


@pytest.fixture(scope="module")
def site(db):
    with served(db) as address:
        yield address


def clock(page) -> float:
    return float(page.locator("#clock").inner_text().split()[0])


def place(page, side, whose="own"):
    return page.locator(f"#track .{whose}.{side}").get_attribute("transform")


def headings(page):
    return page.locator("#decision .decision-panel h2")


def judged_by(page, shape):
    """What is drawn is what the scenario of the trial judges, in m."""
    expect(page.locator("#track .judged")).to_have_count(2)
    width = "it => Number(it.getAttribute('width') ?? 2 * it.getAttribute('r'))"
    assert page.locator(f"#track .own.left {shape}.judged").evaluate(width) == 4.5


def test_from_the_study_to_a_verdict_and_to_why_the_worst_condition_collides_and_a_note(page, db):
    page.goto("/")
    words = "Too few finished trials for a verdict (at least 20, and half of all, are needed): "
    expect(page.locator(".answer")).to_contain_text(words, timeout=2000 * HANGS_S)
    page.locator("#answers").get_by_role("rowheader", name="smollm2").get_by_role(
        "link"
    ).first.click()
    behind = page.locator("#headway").get_by_role("link").last
    trials = behind.inner_text()
    behind.click()
    expect(page.locator(".totals")).to_contain_text(f"{trials} trials")
    page.go_back()
    page.get_by_label("Compare with").select_option("emulator")
    page.get_by_role("button", name="Show").click()
    compared = page.get_by_role("columnheader", name="emulator", exact=True)
    expect(compared.first).to_be_visible()
    # That is of one driver alone.
    expect(page.get_by_role("columnheader", name="Verdict")).to_have_count(0)
    page.goto("/")
    page.set_viewport_size({"width": 1024, "height": 800})
    assert page.evaluate(OVER) <= 0
    row = page.locator("#collisions").get_by_role("row", name="smollm2")
    row.get_by_role("link").nth(3).click()
    page.locator(".of-trials tbody a").first.click()
    account = page.locator("details", has_text="Why it crashed")
    expect(account).to_contain_text("could have avoided it")
    page.locator("#moments").get_by_role("button", name="last moment to").first.click()
    expect(page.locator("#panel blockquote, #panel pre").first).to_be_visible()
    page.get_by_role("button", name="nearest human").click()
    expect(page.locator("#ghost-key")).to_contain_text("human experiment_")
    abouts = []
    for key, text in (("Shift", "Whole #level"), ("[", "and this")):
        page.keyboard.press(key)
        page.keyboard.press("n")
        expect(page.locator("#note-text")).to_be_focused()
        abouts.append(page.locator("#note-about").inner_text())
        page.keyboard.type(text)
        page.keyboard.press("Enter")
        expect(page.locator("#noted")).to_contain_text(text)
    whole, part = map(json.loads, db.with_name("golden.notes.jsonl").read_text().splitlines())
    assert (whole["text"], whole["decision"]) == ("Whole #level", None)
    assert abouts == ["on the trial", f"on the {part['side']} decision {part['decision']}"]
    page.goto("/notes")
    page.locator(".all-notes tbody a").first.click()
    expect(page.locator("#noted")).to_contain_text("and this")


def test_from_a_filtered_list_to_a_collision_its_words_and_back(page):
    page.goto("/trials")
    page.keyboard.press("/")
    page.keyboard.type("jk?1")  # keys of the page are off meanwhile
    expect(page.locator("#search")).to_have_value("jk?1")
    expect(page.locator("#help")).to_be_hidden()
    page.locator("#search").fill("n_0_0")
    page.wait_for_url("**/trials?q=n_0_0")
    expect(page.locator("#search")).to_be_focused()
    page.get_by_label("outcome").focus()
    page.get_by_label("outcome").select_option("collided")
    expect(page.locator(".totals")).to_contain_text("smollm2: 2, 2 crashed")
    expect(page.get_by_label("outcome")).to_be_focused()
    expect(page).to_have_url(re.compile("q=n_0_0.*outcome=collided"))
    page.reload()
    expect(page.locator("tbody tr")).to_have_count(2)
    page.locator("tbody a").first.click()
    page.locator("#scrub").fill("2")
    page.locator("#decision article").last.get_by_role("link").click()
    told = ["What it said", "What it planned", "What it was told", "Attempts"]
    expect(page.locator(".decision-panel h3")).to_have_text(told)
    block = page.locator("details.block", has_text="as before")
    expect(block.locator("pre").first).to_be_hidden()
    page.keyboard.press("Escape")
    expect(page.locator("a.decision[aria-current]")).to_have_count(0)
    page.keyboard.press("Escape")
    page.wait_for_url("**/trials?q=n_0_0&outcome=collided")


def test_a_screen_holds_25_trials_between_which_keys_go(page):
    page.set_viewport_size({"width": 1440, "height": 900})
    page.goto("/trials")
    bottoms = (
        "rows => rows.filter((row) => row.getBoundingClientRect().bottom <= innerHeight).length"
    )
    assert page.locator(".of-trials tbody tr").evaluate_all(bottoms) >= 25
    links = page.locator(".of-trials tbody a")
    for key, at in (("j", 0), ("j", 1), ("k", 0)):
        page.keyboard.press(key)
        expect(links.nth(at)).to_be_focused()


def test_through_a_list_by_keys_and_links_and_from_its_words(page):
    name = page.locator("h1")
    page.goto("/trials?q=emulator&sort=-end")
    names = page.locator("tbody th a").evaluate_all("all => all.map(({ title }) => title)")
    page.locator("tbody th a").nth(1).click()
    for move, there in (
        (lambda: None, names[1]),
        (lambda: page.keyboard.press("j"), names[2]),
        (page.locator("#previous-trial").click, names[1]),
        (lambda: page.keyboard.press("k"), names[0]),
    ):
        move()
        expect(name).to_have_text(there)
        expect(page.locator("#next-trial")).to_be_visible()  # keys are heard from here on
    expect(page.locator("#previous-trial")).to_be_hidden()
    page.keyboard.press("Escape")
    page.wait_for_url("**/trials?q=emulator&sort=-end")
    page.goto("/sql?q=select+count(*)+from+trials")
    expect(page.locator("#result tbody")).to_contain_text("79")
    page.goto("/words")
    page.keyboard.press("/")
    page.keyboard.type("MERGE")
    expect(page.locator("mark").first).to_have_text(re.compile("merge", re.IGNORECASE))
    expect(page).to_have_url(re.compile("q=MERGE"))
    every = [row.split()[0] for row in page.locator(".hits tbody th").all_inner_texts()]
    first, second, *_ = dict.fromkeys(every)
    page.locator(".hits tbody th a").first.click()
    expect(name).to_have_text(first)
    expect(page.locator(".decision-panel h2")).to_have_count(1)
    page.keyboard.press("j")
    expect(name).to_have_text(second)


def test_time_moves_by_play_scrub_keys_and_charts_and_ends_at_a_collision(page):
    page.goto(TRIAL)
    judged_by(page, "circle")
    start = place(page, "left")
    for key, speed in zip("12345", ("0.25", "0.5", "1", "2", "4"), strict=True):
        page.keyboard.press(key)
        expect(page.locator("#speed")).to_have_value(speed)
    page.keyboard.press(" ")
    expect(page.locator("#clock")).to_have_text(re.compile(r"^[1-9]"))
    page.keyboard.press(" ")
    assert place(page, "left") != start
    page.locator("#scrub").fill("2.5")
    head = page.locator("#playhead").bounding_box()["x"]
    for key, time_s in (("ArrowLeft", 2.4), ("ArrowRight", 2.5), ("Shift+ArrowRight", 3.5)):
        page.keyboard.press(key)
        assert clock(page) == time_s
    assert page.locator("#playhead").bounding_box()["x"] > head
    expect(page).to_have_url(re.compile(r"t=3\.5"))
    chart = page.locator("#chart-h")
    chart.click(position={"x": chart.bounding_box()["width"] / 2, "y": 20})
    assert clock(page) == pytest.approx(4.5, abs=0.2)
    page.get_by_role("button", name="left merges").click()
    told = page.locator("#now").inner_text()
    shown = r"left \S+ m/s, (\S+) m (?:to|past) the merge point; right .*; left \S+ m ahead"
    assert float(re.search(shown, told)[1]) == pytest.approx(0, abs=0.1)
    expect(page.locator("#next-trial")).to_be_hidden()  # no list led here
    page.goto(f"/trials/{COLLIDED}?t=2")
    expect(page.locator("#lines .collision")).to_have_count(1)
    expect(page.locator("#track .crash")).to_be_hidden()
    page.locator("#play").click()
    expect(page.locator("#track .crash")).to_be_visible()
    expect(page.locator("#play")).to_have_text("Play")
    page.goto(f"{HUMAN}?t=3")
    judged_by(page, "rect")


def test_the_panel_follows_the_replay_until_a_decision_is_chosen_or_somebody_reads(page):
    page.set_viewport_size({"width": 1500, "height": 420})
    page.goto(TRIAL)

    def shown(n):
        return [f"{side} decision {n} at {n}.0 s" for side in ("left", "right")]

    expect(headings(page)).to_have_text(shown(0))

    page.locator("#scrub").fill("1.5")
    expect(headings(page)).to_have_text(shown(1))
    page.keyboard.press("Shift+ArrowRight")
    expect(headings(page)).to_have_text(shown(2))
    assert "decision=" not in page.url
    page.keyboard.press("[")
    current = page.locator("a.decision[aria-current]")
    expect(current).to_have_attribute("aria-label", re.compile("right, decision 2"))
    page.keyboard.press("]")
    page.locator("#previous-decision").click()
    page.keyboard.press("[")
    expect(headings(page)).to_have_text(shown(2)[:1])
    page.locator("#scrub").fill("3.5")
    expect(page.locator("a.decision.now").first).to_have_attribute("data-n", "3")
    expect(headings(page)).to_have_text(shown(2)[:1])
    page.keyboard.press("Escape")
    expect(headings(page)).to_have_text(shown(3))
    page.evaluate("scrollTo(0, document.body.scrollHeight)")
    expect(page.locator("#follow")).to_be_visible()
    page.locator("#scrub").fill("1.5")
    expect(headings(page)).to_have_text(shown(3))
    page.locator("#follow").click()
    expect(headings(page)).to_have_text(shown(1))


def test_an_address_brings_back_the_moment_the_decision_and_the_other_trial(page):
    page.goto(f"{TRIAL}?t=4.2&side=right&decision=3&compare={NEXT}")
    expect(headings(page)).to_have_text("right decision 3 at 3.0 s")
    expect(page.locator("#clock")).to_have_text(re.compile(r"^4\.2 s"))
    expect(page.locator("#ghost-key")).to_contain_text("rep 2")
    expect(page.locator("#track .ghost.left")).to_be_visible()
    page.locator("a.decision").first.click()
    expect(headings(page)).to_have_text("left decision 0 at 0.0 s")
    page.go_back()
    expect(headings(page)).to_have_text("right decision 3 at 3.0 s")
    expect(page.locator("#clock")).to_have_text(re.compile(r"^4\.2 s"))
    page.keyboard.press("Escape")
    expect(page.locator("#decision .decision-panel")).to_have_count(4)
    page.locator("#other-ribbons a.now").first.click()
    expect(page).to_have_url(re.compile("of=other"))
    page.reload()
    expect(page.locator("#other-ribbons a[aria-current]")).to_have_count(1)
    page.locator("#ghost-key a").click()
    expect(page.locator("h1")).to_have_text(NEXT)
    page.goto(f"{TRIAL}?compare=emulator/baseline/L_4_0/rep99")
    expect(page.locator("#ghost-key")).to_contain_text("is not there to compare with")


def test_another_trial_is_found_by_the_keyboard_and_goes_on_where_this_one_ended(page):
    late = []

    def hold(route):
        if "q=l_4_8" in route.request.url and not late:
            late.append(route)
        else:
            route.continue_()

    page.goto(f"/trials/{COLLIDED}")
    page.route("**/others/**", hold)
    page.keyboard.press("c")
    expect(page.locator("#compare")).to_be_focused()
    with page.expect_request(lambda asked: "q=l_4_8" in asked.url):
        page.keyboard.insert_text("l_4_8")
    page.keyboard.insert_text(" emulator rep02")
    expect(page.locator("#others option")).to_have_count(1)
    with page.expect_response("**/others/**"):
        late[0].continue_()  # the answer to the first words does not replace that to all of them
    page.wait_for_function("() => new Promise((done) => setTimeout(() => done(true)))")
    expect(page.locator("#others option")).to_have_count(1)
    page.keyboard.press("Enter")
    key = page.locator("#ghost-key")
    expect(key).to_contain_text("L_4_8, rep 2")
    page.locator("#scrub").fill("3.8")
    before = place(page, "left", "ghost")
    page.keyboard.press("Shift+ArrowRight")
    assert place(page, "left", "ghost") != before
    page.keyboard.press(" ")
    expect(page.locator("#play")).to_have_text("Pause")
    page.get_by_role("button", name="next repetition").click()
    expect(key).to_contain_text("rep 2. The vehicles crashed")
    page.go_back()
    expect(key).to_contain_text("L_4_8, rep 2")
    page.locator("#alone").click()
    expect(page.locator("#clock")).to_have_text("2.8 s of 2.8 s")


def test_what_a_model_wrote_is_text_and_its_failures_are_named(page):
    page.goto(HOSTILE)
    panel = page.locator(".decision-panel")
    for said in (
        "<script>document.title='owned'</script>",
        "{{ 7*7 }}",
        "[U+202E]",
        "no valid plan: no plan in the reply. The car kept to its plan of",
    ):
        expect(panel).to_contain_text(said)
    assert ("owned" in page.title(), panel.locator("script, img").count()) == (False, 0)
    expect(panel.locator("details", has_text="The whole reply")).to_have_attribute("open", "")
    whole = panel.get_by_role("link", name="the whole reply").last
    raw = page.request.get(whole.get_attribute("href"))
    assert raw.headers["content-type"].startswith("text/csv")
    assert "attachment" in raw.headers["content-disposition"]
    assert len(raw.text()) > 1_000_000 > 20 * len(panel.inner_text())
    page.goto("/trials/o4/baseline/L_4_0/rep01")
    lost = re.compile("left, decision 2 at .* no answer, never driven")
    page.get_by_role("link", name=lost).click()
    expect(panel).to_contain_text("The call got no answer")
    expect(panel.locator("tbody")).to_contain_text("timeout")


def test_a_phone_shows_a_decision_that_is_tapped_and_leads_back_by_day_and_by_night(page):
    page.emulate_media(color_scheme="dark")
    page.set_viewport_size({"width": 420, "height": 800})
    page.goto("/trials")
    page.get_by_role("button", name="More", exact=True).click()
    page.get_by_role("button", name="Keys").click()
    expect(page.locator("#help")).to_contain_text("play and pause")
    assert serious(page) == []
    page.get_by_role("button", name="Close").click()
    page.get_by_role("link", name="Glossary").click()
    expect(page.locator("#main dt", has_text="gap")).to_be_visible()
    paper = "getComputedStyle(document.body).backgroundColor"
    night = page.evaluate(paper)
    page.get_by_role("button", name="More", exact=True).click()
    page.locator("#theme").select_option("light")
    day = page.evaluate(paper)
    page.goto(TRIAL)
    assert page.evaluate(paper) == day != night
    page.locator("a.decision").nth(2).click()
    expect(page.locator(".decision-panel h2")).to_be_in_viewport()
    page.locator("#to-replay").click()
    expect(page.locator("#track")).to_be_in_viewport(ratio=0.9)
    expect(page.locator("a.decision[aria-current]")).to_have_count(1)
    assert page.evaluate(OVER) <= 0


@pytest.fixture
def port():
    """A port that no other program gets, where a server may listen again and again."""
    with socket.socket() as reserved:
        reserved.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        reserved.bind(("127.0.0.1", 0))
        yield reserved.getsockname()[1]


def test_a_page_says_that_nobody_answers_it_until_somebody_does(browser, db, port):
    page = browser.new_page()  # whose console says what failed
    with served(db, port) as site:
        page.goto(f"{site}/trials")
        expect(page.locator("footer")).to_contain_text(f"view --db {db} --export")
        expect(page.locator("#lost")).to_be_hidden()
    page.get_by_label("outcome").select_option("collided")
    expect(page.locator("#lost")).to_contain_text("merge-runner view has ended")
    with served(db, port):
        page.get_by_label("outcome").select_option("left first")
        expect(page.locator("#lost")).to_be_hidden()
        page.goto(f"{site}{TRIAL}")
        page.route("**/others/**", lambda route: route.abort())
        page.get_by_role("button", name="next repetition").click()
        expect(page.locator("#lost")).to_be_visible()
        expect(page.locator("#ghost-key")).to_be_hidden()
        page.close()


@pytest.fixture
def held_server(tmp_path):
    """The address of an emulator that holds all but a few answers, and what lets them go."""
    gate = Gate(10, tmp_path)
    with (
        start_blocking_portal() as elsewhere,
        elsewhere.wrap_async_context_manager(watched(gate.middle)) as server,
    ):
        yield f"{server.url}/v1", lambda: elsewhere.call(gate.open)


def test_a_sweep_is_followed_to_its_end_without_a_reload(page, tmp_path, held_server, monkeypatch):
    monkeypatch.setattr(computing, "STANDS_S", 0.0)
    url, let_go = held_server
    db, ended = tmp_path / "merge.duckdb", "Complete: all 2 trials ended"
    sweep = subprocess.Popen(
        [PROGRAM, "sweep", "baseline", "--reps", "1", "--conditions", "L_4_0,N_0_0", "--db", db],
        cwd=tmp_path, env=environment(EMULATOR_BASE_URL=url),
        stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    while not (tmp_path / "merge.duckdb.progress").is_dir():
        assert sweep.poll() is None
        time.sleep(0.05)
    with served(db) as address:
        listing, trials, study = (page.context.new_page() for _ in range(3))
        listing.goto(f"{address}/sweeps")
        expect(listing.locator(".state")).to_have_text("running")
        trials.goto(f"{address}/trials?condition=N_0_0")
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
        expect(verdict).to_contain_text(ended)
        assert page.evaluate("window.stayed")
        expect(page.locator(".heard")).to_have_text(verdict.locator("strong").inner_text())
        expect(listing.locator(".state")).to_have_text("finished")
        expect(listing.locator("tbody tr")).to_contain_text("2 of 2")
        expect(study.locator("#strip")).to_contain_text(ended)
        expect(study.locator("#answers .facts a").first).to_have_text("2")
        trials.get_by_role("link", name="Show them").click()
        expect(trials.locator("tbody tr")).to_have_count(1)
        assert "condition=N_0_0" in trials.url
        for other in (listing, trials, study):
            other.close()
        page.goto("about:blank")  # it asks for nothing more before the server ends
    page.goto("/glossary")
    assert sweep.wait() == 0


def test_an_exported_folder_and_a_page_of_few_trials_open_from_the_disk(page, db, tmp_path):
    export(db, tmp_path / "made", [EMULATOR, "smollm2/baseline/N_0_0/*"])
    page.context.set_offline(True)
    page.goto((tmp_path / "made").rename(tmp_path / "moved").joinpath("index.html").as_uri())
    expect(page.locator("footer")).to_contain_text("Search, filters, SQL and new notes need")
    page.locator(f'a[title="{COLLIDED}"]').click()
    expect(page.get_by_text("The vehicles crashed")).to_be_visible()
    start = place(page, "left")
    for _ in range(3):
        page.keyboard.press("]")
    for again in (lambda: None, page.reload):
        again()
        expect(headings(page)).to_have_text(re.compile("decision 1 at "))
        expect(page).to_have_url(re.compile("decision=1"))
    assert place(page, "left") != start
    expect(page.locator("#charts .chart")).to_have_count(3)
    expect(page.locator(".plan-values dd").first).to_be_visible()
    expect(page.locator("#note")).to_have_count(0)
    page.keyboard.press("Escape")
    page.keyboard.press("Escape")
    page.wait_for_url("**/index.html")
    page.locator("tbody a").first.click()
    expect(page.locator("h1")).to_have_text(EMULATOR)
    expect(page.locator("#next-trial")).to_be_visible()
    page.keyboard.press("j")
    expect(page.locator("h1")).to_contain_text("smollm2/")
    file = in_a_thread(export_page, db, tmp_path / "one two.html", ["emulator/baseline/N_0_0/*"])
    page.goto(file.as_uri())
    listed = page.get_by_label("Trials of this page").get_by_role("link")
    expect(listed).to_have_count(2)
    expect(page.locator("h1")).to_have_text(EMULATOR)
    listed.last.click()
    expect(page.locator("h1")).to_have_text(NEXT)
    page.locator("a.decision").nth(1).click()
    expect(page.locator(".decision-panel .block").first).to_contain_text("You drive a car")
    expect(page.locator("header nav a")).to_have_count(0)
