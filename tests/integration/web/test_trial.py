"""The page of a trial: why it went so, what its scenario judges, and what its drivers thought."""

import json
import re

import duckdb
import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.results.store import Store, query
from merge_runner.scenarios.merge.collision import collided
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner_analysis.humans.archive import open_files
from merge_runner_analysis.humans.load import import_trials, sort_files
from merge_runner_analysis.web.reading import reading
from merge_runner_analysis.web.trial.reader import read_trials
from merge_runner_analysis.web.trial.replay import collision_bounds, plan_chart
from tests.support import recordings
from tests.support.cases import table
from tests.support.crashes import EXAMPLES, drive
from tests.support.serving import Page, client_of
from tests.support.studies import Drive, Said, damage, played, write_study

TRIAL = "o3/baseline/N_0_0/rep01"
# Both keep their speed and meet at the merge point; or one goes well before the other.
MEETING = Drive("o3", "baseline", "N_0_0", 1, (0.0,), (0.0,))
PASSING = Drive("o3", "baseline", "N_0_0", 2, (0.6,) * 3, (-0.6,) * 3)
THOUGHT = "It is <b>faster</b>."


@pytest.fixture(scope="module")
def accounts(tmp_path_factory):
    path = tmp_path_factory.mktemp("accounts") / "t.duckdb"
    return client_of(write_study(path, [drive(account) for account in EXAMPLES]))


@pytest.mark.parametrize(
    ("account", "heading", "too_late"),
    [
        ("nobody braked, both sped up", "Why it crashed", [(1.6, "left"), (2.0, "right")]),
        ("near miss", "Why it came close", []),
        ("long wait", "Why it took so long", []),
        (None, "", []),
    ],
)
def test_a_trial_says_why_it_went_so_and_its_replay_when_it_was_too_late(
    accounts, account, heading, too_late
):
    text = accounts.get(f"/trials/{played(drive(account)).spec.trial_id}").text
    assert re.findall(r"Why it [a-z ]*[a-z]", Page(text).text) == [heading][: len(heading)]
    marks = json.loads(re.search(r'id="replay-data">(.*?)</script>', text, re.DOTALL)[1])["marks"]
    told = {"kind": "last chance", "text": "last moment to brake"}
    chances = [mark for mark in marks if mark["kind"] == "last chance"]
    assert chances == [{"t": t, "side": side, **told} for t, side in too_late]
    assert account or {mark["kind"] for mark in marks} == {"merge"}


def test_reasoning_is_shown_as_text_whatever_format_it_came_in_and_no_answer_as_reasoning(tmp_path):
    long = {"choices": [{"message": {"content": f"<think>{'x' * 100_000}"}}]}
    replies = [*table("explorer", "reasoning").values(), long]
    db, missing = tmp_path / "t.duckdb", {1: Said(failure="no_decision")}
    write_study(db, [Drive("o3", "baseline", "L_4_0", 1, (0.1,) * 9, (-0.1,) * 9, missing)])
    with duckdb.connect(str(db)) as connection:
        connection.executemany(
            "UPDATE calls SET reply = ? WHERE side = 'left' AND decision = ?",
            [(json.dumps(reply), number) for number, reply in enumerate(replies)],
        )
        connection.execute("UPDATE decisions SET tactical = if(failure IS NULL, 'M', NULL)")
    text = client_of(db).get("/trials/o3/baseline/L_4_0/rep01").text
    panels = re.findall(r'<article class="decision-panel">(.*?)</article>', text, re.DOTALL)
    said = {}
    for panel in (Page(html).text for html in panels):
        if left := re.match(r"left decision (\d)", panel):
            said[int(left[1])] = panel
    assert len(said) == 9
    assert [n for n, panel in said.items() if f"Its reasoning {THOUGHT}" in panel] == [*range(5)]
    assert [n for n, panel in said.items() if "Its reasoning" in panel] == [*range(5), 7]
    assert re.search(r"Its reasoning x+ ([\d,]+) more characters: the whole reply", said[7])
    told = "no tactical decision, though one was asked for"
    assert [n for n, panel in said.items() if told in panel] == [1]


@pytest.mark.parametrize(
    ("rule", "words"),
    [
        ("euclid2d", "circles 6 m across"),
        ("rectangle", "outlines of 6 m by 2.4 m"),
        ("shared_lane", "bars of 6 m along the road"),
    ],
)
def test_the_band_of_the_chart_holds_the_headways_that_collide(tmp_path, rule, words):
    scenario = ScenarioConfig(vehicle_length_m=6, vehicle_width_m=2.4, collision_rule=rule)
    db = write_study(tmp_path / "t.duckdb", [MEETING, PASSING], scenario)
    assert words in Page(client_of(db).get(f"/trials/{TRIAL}").text).text
    with reading(db) as connection:
        (trial,) = read_trials(connection, [("o3/baseline/N_0_0/rep02", "o3-baseline")])
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


def test_beside_humans_who_say_nothing_stands_what_was_measured_from_control_on(tmp_path):
    """The first brakes hard within the tunnel, the second collides."""
    recording = recordings.drive("N_0_0", yields="right")
    in_tunnel = recording.columns["velocities.left"]
    in_tunnel[5:] = [speed - 1 for speed in in_tunnel[5:]]
    files = {
        "experiment_4/experiment_4_iter_1.csv": recording.csv(),
        "experiment_4/experiment_4_iter_2.csv": recordings.drive("N_0_0", yields="nobody").csv(),
    }
    humans = tmp_path / "t.duckdb"
    with open_files(recordings.write_folder(tmp_path / "recordings", files)) as found:
        import_trials(sort_files(found), Store(humans))
    ((name, spec, hardest), (crash, *_)) = query(
        humans,
        "SELECT trial_id, spec_hash, max_acceleration_mps2 FROM trials "
        "JOIN trial_metrics USING (trial_id, spec_hash) ORDER BY ALL",
    )[1]
    with reading(humans) as connection:
        samples = read_trials(connection, [(name, spec)])[0].states["left"]
    times, accelerations = samples["time_s"], samples["acceleration_mps2"]
    assert min(accelerations) == pytest.approx(-20, abs=0.1)
    own = [a for t, a in zip(times, accelerations, strict=True) if t > 0]
    client = client_of(humans)
    text = Page(client.get(f"/trials/{name}").text).text
    said = re.findall(r"or braking was ([+-][\d.]+) m/s²", text.replace("−", "-"))
    assert said[0] == f"{max(own, key=abs):+z.1f}"
    assert max(abs(float(value)) for value in said) == pytest.approx(hardest, abs=0.051)
    assert "A human pair" in text
    assert "net gap when the first vehicle reaches the merge point" in text
    text = Page(client.get(f"/trials/{crash}").text).text
    assert "The vehicles crashed" in text
    assert "outlines of 4.5 m by 1.8 m" in text


def test_odd_rows_cost_no_other_row_its_page_and_levels_of_a_study_filter_the_list(golden_copy):
    db = golden_copy / "golden.duckdb"
    client = client_of(db)
    state = client.site.trial_index.refresh() or client.site.trial_index.state
    damage(
        db,
        "UPDATE trials SET condition = 'X_1_1', error = 'left: another' WHERE trial_id LIKE 'o4/%'",
        "DELETE FROM states WHERE side = 'right' AND trial_id LIKE 'idm%/rep01'",
        "UPDATE decisions SET rationale = repeat('🚗', 20000) "
        "WHERE trial_id = 'emulator/baseline/N_0_0/rep01'",
    )
    text = client.get("/trials/o4/baseline/L_4_0/rep01").text
    for said in ("X_1_1", "the left vehicle would be 4 m ahead", "left: another"):
        assert said in text
    assert client.site.trial_index.state != state
    assert len(Page(client.get("/trials?model=idm").text).to("/trials/idm/")) == 22
    assert client.get("/trials/idm/baseline/N_0_0/rep01").status_code == 200
    text = client.get("/trials/emulator/baseline/N_0_0/rep01").text
    quote = text[text.index('<blockquote class="said"') :]
    beginning, rest = quote[: quote.index("</blockquote>")].split("<details>")
    assert 500 < beginning.count("🚗") < 1000
    assert beginning.count("🚗") + rest.count("🚗") == 20_000
    trial = client.get("/trials/cheap+sleepy/baseline/N_0_0/rep01/temperature=0.2").text
    assert "opponent=sleepy, temperature=0.2." in Page(trial).text
    listed = Page(client.get("/trials?factor.temperature=0.2&factor.opponent=sleepy").text).text
    assert "of drivers A+B, A is the ego, on the left or on the right" in listed
    assert "A+B" not in Page(client.get("/trials?model=idm").text).text
    assert ("6 trials" in listed, "1.0 (6)" in listed) == (True, True)
    assert "0 trials" in Page(client.get("/trials?factor.mood=good").text).text
    rows = client.get("/trials.csv?factor.temperature=0.2").text.splitlines()
    assert rows[0].endswith(",factor.opponent,factor.temperature")
    assert {row[-4:] for row in rows[1:]} == {",0.2"}
