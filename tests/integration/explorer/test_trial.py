"""The page of a trial: why it went so, what its scenario judges, and what its drivers thought."""

from __future__ import annotations

import json
import re

import duckdb
import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.results.store import Store
from merge_runner.scenarios.merge.collision import collided
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner_analysis.explorer.reading import reading
from merge_runner_analysis.explorer.views import collision_bounds, plan_chart, read_trial
from merge_runner_analysis.human.archive import open_files
from merge_runner_analysis.human.load import import_trials, sort_files
from tests.support import recordings
from tests.support.crashes import EXAMPLES, drive
from tests.support.serving import Page, client_of
from tests.support.studies import Drive, Said, played, write_study

TRIAL = "o3/baseline/N_0_0/rep01"
# Both keep their speed and meet at the merge point; or one goes well before the other.
MEETING = Drive("o3", "baseline", "N_0_0", 1, (0.0,), (0.0,))
PASSING = Drive("o3", "baseline", "N_0_0", 2, (0.6,) * 3, (-0.6,) * 3)
THOUGHT = "It is <b>faster</b>."


def chat(content, **message):
    return {"choices": [{"message": {"content": content, **message}}]}


REPLIES = {
    0: chat(f"<think>{THOUGHT}</think>M"),
    1: chat("M", reasoning_content=THOUGHT),
    2: {"content": [{"type": "thinking", "thinking": THOUGHT}]},
    3: {"candidates": [{"content": {"parts": [{"text": THOUGHT, "thought": True}]}}]},
    4: {"output": [{"type": "reasoning", "summary": [{"text": THOUGHT}]}]},
    5: chat("M\nI never write `</think>`."),
    6: "no JSON object at all",
    7: chat(f"<think>{'x' * 100_000}"),
}


@pytest.fixture(scope="module")
def accounts(tmp_path_factory):
    path = tmp_path_factory.mktemp("accounts") / "t.duckdb"
    return client_of(write_study(path, [drive(account) for account in EXAMPLES]))


@pytest.fixture(scope="module")
def panels(tmp_path_factory):
    """What the panels of the left driver say, of whose replies some hold reasoning."""
    db = tmp_path_factory.mktemp("thoughts") / "t.duckdb"
    missing = {1: Said(failure="no_decision")}
    write_study(db, [Drive("o3", "baseline", "L_4_0", 1, (0.1,) * 9, (-0.1,) * 9, missing)])
    with duckdb.connect(str(db)) as connection:
        connection.executemany(
            "UPDATE calls SET reply = ? WHERE side = 'left' AND decision = ?",
            [(json.dumps(reply), number) for number, reply in REPLIES.items()],
        )
        connection.execute("UPDATE decisions SET tactical = if(failure IS NULL, 'M', NULL)")
    text = client_of(db).get("/trials/o3/baseline/L_4_0/rep01").text
    return re.findall(r'<article class="decision-panel">(.*?)</article>', text, re.DOTALL)


@pytest.fixture(scope="module")
def humans(tmp_path_factory):
    """Two recorded trials; the first brakes hard within the tunnel, the second collides."""
    folder = tmp_path_factory.mktemp("humans")
    recording = recordings.drive("N_0_0", yields="right")
    in_tunnel = recording.columns["velocities.left"]
    in_tunnel[5:] = [speed - 1 for speed in in_tunnel[5:]]
    files = {
        "experiment_4/experiment_4_iter_1.csv": recording.csv(),
        "experiment_4/experiment_4_iter_2.csv": recordings.drive("N_0_0", yields="nobody").csv(),
    }
    db = folder / "t.duckdb"
    with open_files(recordings.write_folder(folder / "recordings", files)) as found:
        import_trials(sort_files(found), Store(db))
    return db


def changed(golden_copy, sql):
    db = golden_copy / "golden.duckdb"
    with duckdb.connect(str(db)) as connection:
        connection.execute(sql)
    return client_of(db)


@pytest.mark.parametrize(
    ("account", "heading", "marks"),
    [
        (
            "both insisted",
            "Why it collided",
            [
                {"t": 1.6, "side": "left", "kind": "last chance", "text": "last moment to brake"},
                {"t": 2.0, "side": "right", "kind": "last chance", "text": "last moment to brake"},
            ],
        ),
        ("near miss", "Why it came close", []),
        ("long wait", "Why it took so long", []),
        (None, "", []),
    ],
)
def test_a_trial_says_why_it_went_so_and_its_replay_when_it_was_too_late(
    accounts, account, heading, marks
):
    text = accounts.get(f"/trials/{played(drive(account)).spec.trial_id}").text
    assert re.findall(r"Why it [a-z ]*[a-z]", Page(text).text) == [heading][: len(heading)]
    data = json.loads(re.search(r'id="replay-data">(.*?)</script>', text, re.DOTALL)[1])
    assert [mark for mark in data["marks"] if mark["kind"] == "last chance"] == marks
    if account is None:
        assert {mark["kind"] for mark in data["marks"]} == {"merge"}


@pytest.mark.parametrize("number", range(9))
def test_reasoning_is_shown_as_text_whatever_format_it_came_in_and_no_answer_as_reasoning(
    panels, number
):
    (said,) = (Page(html).text for html in panels if f"left decision {number} " in Page(html).text)
    assert ("Its reasoning" in said) == (number not in {5, 6, 8})
    assert (f"Its reasoning {THOUGHT}" in said) == (number < 5)
    more = re.search(r"Its reasoning x+ ([\d,]+) more characters: the whole reply", said)
    assert bool(more) == (number == 7)
    missing = "no tactical decision, though one was asked for" in said
    assert missing == (number == 1)


@pytest.mark.parametrize(
    ("rule", "words"),
    [
        ("euclid2d", "circles of 6 m"),
        ("rectangle", "outlines of 6 m by 2.4 m"),
        ("shared_lane", "bars of 6 m along the road"),
    ],
)
def test_the_band_of_the_chart_holds_the_headways_that_collide(tmp_path, rule, words):
    scenario = ScenarioConfig(vehicle_length_m=6, vehicle_width_m=2.4, collision_rule=rule)
    db = write_study(tmp_path / "t.duckdb", [MEETING, PASSING], scenario)
    assert words in Page(client_of(db).get(f"/trials/{TRIAL}").text).text
    with reading(db) as connection:
        trial = read_trial(connection, "o3/baseline/N_0_0/rep02", "o3-baseline")
    bounds = collision_bounds(trial)
    places = zip(*(samples["position_m"] for samples in trial.states.values()), strict=True)
    for bound, (left, right) in zip(bounds, places, strict=True):
        mean = (left + right) / 2
        assert collided(trial.scenario, TRACK, left, right) == (abs(left - right) < (bound or 0))
        if rule != "shared_lane":
            assert bound is None or collided(
                trial.scenario, TRACK, mean + bound / 2 - 0.01, mean - bound / 2 + 0.01
            )
    assert max(filter(None, bounds)) == pytest.approx(6, abs=0.2)
    chart = plan_chart(trial.by_side["left"][0], trial)
    assert chart["plan"] == trial.by_side["left"][0]["plan"]


def test_beside_humans_who_say_nothing_stands_what_was_measured_from_control_on(humans):
    with duckdb.connect(str(humans), read_only=True) as connection:
        (name, spec), (crash, _) = connection.execute(
            "SELECT trial_id, spec_hash FROM trials ORDER BY ALL"
        ).fetchall()
        (metric, _) = connection.execute(
            "SELECT max_acceleration_mps2 FROM trial_metrics ORDER BY trial_id"
        ).fetchall()
    with reading(humans) as connection:
        samples = read_trial(connection, name, spec).states["left"]
    times, accelerations = samples["time_s"], samples["acceleration_mps2"]
    assert min(accelerations) == pytest.approx(-20, abs=0.1)
    own = [a for t, a in zip(times, accelerations, strict=True) if t > 0]
    client = client_of(humans)
    text = Page(client.get(f"/trials/{name}").text).text
    said = re.findall(r"hardest acceleration was ([+-][\d.]+) m/s²", text.replace("−", "-"))
    assert said[0] == f"{max(own, key=abs):+z.1f}"
    assert max(abs(float(value)) for value in said) == pytest.approx(metric[0], abs=0.051)
    assert "A human pair" in text
    assert "net gap when the first vehicle reaches the merge point" in text
    text = Page(client.get(f"/trials/{crash}").text).text
    assert "The vehicles collided" in text
    assert "outlines of 4.5 m by 1.8 m" in text


def test_a_trial_that_failed_again_shows_its_new_error(golden_copy):
    db = golden_copy / "golden.duckdb"
    client = client_of(db)
    catalogue = client.site.catalogue
    catalogue.refresh()
    state = catalogue.state()
    changed(golden_copy, "UPDATE trials SET error = 'left: another one' WHERE trial_id LIKE 'o4/%'")
    assert "another one" in client.get("/trials/o4/baseline/L_4_0/rep01").text
    assert catalogue.find("o4/baseline/L_4_0/rep01")["error"] == "left: another one"
    assert catalogue.state() != state


def test_odd_rows_cost_no_other_row_its_page_and_a_long_rationale_is_folded(golden_copy):
    client = changed(
        golden_copy,
        "UPDATE trials SET condition = 'X_1_1' WHERE trial_id LIKE 'o4/%';"
        "DELETE FROM states WHERE side = 'right' AND trial_id LIKE 'idm%/rep01';"
        "UPDATE decisions SET rationale = repeat('🚗', 20000) "
        "WHERE trial_id = 'emulator/baseline/N_0_0/rep01'",
    )
    text = client.get("/trials/o4/baseline/L_4_0/rep01").text
    assert "X_1_1" in text
    assert "the left vehicle would be 4 m ahead" in text
    assert len(Page(client.get("/trials?model=idm").text).to("/trials/idm/")) == 22
    assert client.get("/trials/idm/baseline/N_0_0/rep01").status_code == 200
    text = client.get("/trials/emulator/baseline/N_0_0/rep01").text
    quote = text[text.index('<blockquote class="said"') :]
    beginning, rest = quote[: quote.index("</blockquote>")].split("<details>")
    assert 500 < beginning.count("🚗") < 1000
    assert beginning.count("🚗") + rest.count("🚗") == 20_000


def test_a_trial_of_a_crossed_study_names_its_levels_by_which_the_list_is_filtered(golden_copy):
    client = client_of(golden_copy / "golden.duckdb")
    trial = client.get("/trials/cheap+sleepy/baseline/N_0_0/rep01/temperature=0.2").text
    assert "opponent=sleepy, temperature=0.2." in Page(trial).text
    page = Page(client.get("/trials?factor.temperature=0.2&factor.opponent=sleepy").text)
    assert "6 trials" in page.text
    assert "1.0 (6)" in page.text
    assert "0 trials" in Page(client.get("/trials?factor.mood=good").text).text
    rows = client.get("/trials.csv?factor.temperature=0.2").text.splitlines()
    assert rows[0].endswith(",factor.opponent,factor.temperature")
    assert {row[-4:] for row in rows[1:]} == {",0.2"}
