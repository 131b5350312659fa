"""The list of trials: what each is, what is found, summed up and offered beside another."""

import csv
import io
import re
import shutil
from urllib.parse import parse_qs, urlsplit

import duckdb
import pytest

from merge_runner.results.store import Store
from merge_runner_analysis.web import trial_index as trial_index_module
from merge_runner_analysis.web.pictures import sparkline, speed_range
from merge_runner_analysis.web.runs import list_runs
from merge_runner_analysis.web.scope import filter_of
from merge_runner_analysis.web.trial_index import TrialIndex
from tests.support.cases import cases
from tests.support.crashes import CLOSING_IN, EXAMPLES, drive
from tests.support.harness import FAST
from tests.support.serving import Page, client_of
from tests.support.studies import Drive, as_humans, damage, played, write_study, yielding

HIDDEN = "o3\u202egpj\u200b"
# It brakes until it stands, between samples of a sparkline too.
STANDING = Drive(HIDDEN, "baseline", "N_0_0", 1, (-1.0,) * 5, (0.9,) * 2)
# Humans of whom the second keeps its distance as the model does; the last ends too early.
COMPARED = (
    Drive("o3", "baseline", "N_0_0", 1, (0.5, 0.5), (-0.5, -0.5)),
    Drive("o3", "baseline", "N_0_0", 2, (0.0,), (-0.8,) * 3),
    Drive("o3", "A1", "N_0_0", 1, (0.4,), (-0.8,) * 3),
    Drive("o4", "A1", "N_0_0", 1, (0.5, 0.5), (-0.5, -0.5)),
    Drive("o4", "baseline", "N_0_0", 2, (0.5, 0.5), (-0.5, -0.5)),
    Drive("human", "far", "N_0_0", 1, (-0.5, -0.5), (0.5, 0.5)),
    Drive("human", "near", "N_0_0", 1, (0.5, 0.4), (-0.5, -0.5)),
    Drive("human", "short", "N_0_0", 1, (0.5, 0.5), (-0.5, -0.5)),
)
FIRST, SECOND = "o3/baseline/N_0_0/rep01", "o3/baseline/N_0_0/rep02"


@pytest.fixture(scope="module")
def accounts(tmp_path_factory):
    """A trial of each account by o3, and one each of two other drivers and a human pair."""
    path = tmp_path_factory.mktemp("accounts") / "t.duckdb"
    write_study(path, [*(drive(account) for account in EXAMPLES), CLOSING_IN])
    others = [
        played(drive("nobody braked, both sped up", "o4")),
        played(drive("nobody braked or sped up", "human")),
    ]
    Store(path).write("sweep-1", others, patience_s=5)
    as_humans(path)
    return path


@pytest.fixture(scope="module")
def listing(tmp_path_factory):
    """Two drivers, one of whom has an odd name, and humans with another mean gap."""
    path = tmp_path_factory.mktemp("listing") / "t.duckdb"
    others = [*yielding("human", reps=1)[:5], *yielding("o3", "A1", reps=1)[:3]]
    write_study(path, [STANDING, *yielding("o3", reps=1), *others])
    as_humans(path)
    return client_of(path)


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    path = write_study(tmp_path_factory.mktemp("comparing") / "t.duckdb", COMPARED)
    as_humans(path)
    damage(path, "DELETE FROM states WHERE trial_id LIKE 'human/short/%' AND time_s > 2")
    return client_of(path)


def read(db):
    trial_index = TrialIndex(db)
    trial_index.refresh()
    return trial_index


def others(client, trial, **asked):
    return client.get(f"/others/{trial}", params=asked).json()


def test_each_trial_has_its_account_by_which_it_is_counted_filtered_and_downloaded(accounts):
    trial_index = read(accounts)
    found = {row["rep"]: row["account"] for row in trial_index.every({"model": "o3"})}
    assert found == {drive(account).rep: account for account in EXAMPLES}
    (near,) = trial_index.every({"model": "o5"})  # its follower closes in, whatever the gap
    measured = pytest.approx((1.99, 0.95), abs=0.01)
    assert ((near["gap_m"], near["min_ttc_s"]), near["account"]) == (measured, "near miss")
    counts = {
        (row["model"], row["variant"], row["account"]): row["trials"]
        for row in trial_index.counts({}, "model", "variant", "account")
        if row["account"]
    }
    assert counts == {
        **{("o3", "baseline", account): 1 for account in EXAMPLES if account},
        ("o5", "baseline", "near miss"): 1,
        ("o4", "baseline", "nobody braked, both sped up"): 1,
        ("human", None, "nobody braked or sped up"): 1,
    }
    assert ("nobody braked, both sped up", 2) in trial_index.facets({})["account"]
    client = client_of(accounts)
    page = Page(client.get("/trials?account=near+miss&model=o3").text)
    assert ("near miss (1)" in page.text, len(page.to("/trials/o3/"))) == (True, 1)
    rows = csv.DictReader(
        io.StringIO(client.get("/trials.csv?account=nobody+braked,+both+sped+up").text)
    )
    assert [row["account"] for row in rows] == ["nobody braked, both sped up"] * 2


def test_the_list_follows_the_database_beside_which_it_leaves_nothing_and_a_long_one_stands(
    accounts, tmp_path, monkeypatch
):
    path = shutil.copy(accounts, tmp_path / "t.duckdb")
    stored, trial_index = path.read_bytes(), read(path)
    assert (trial_index.refresh(), path.read_bytes(), [*tmp_path.iterdir()]) == (
        False,
        stored,
        [path],
    )
    before = trial_index.state
    monkeypatch.setattr(trial_index_module, "MANY", 0)
    damage(path, "UPDATE decisions SET fallback = true WHERE trial_id LIKE 'o4/%'")
    assert (trial_index.refresh(), trial_index.state) == (False, before)
    assert (trial_index.refresh(at_once=True), trial_index.state == before) == (True, False)
    assert {row["validity"] for row in trial_index.every({"model": "o4"})} == {"fallbacks"}


@pytest.mark.parametrize(
    "lacking",
    [
        "DELETE FROM states WHERE side = 'left'",
        "DELETE FROM states WHERE side = 'right' AND step = 3",
        'UPDATE specs SET spec = \'{"scenario": {"step_s": -1}}\'',
    ],
)
def test_a_collision_that_cannot_be_judged_is_listed_without_an_account_until_another_is_stored(
    tmp_path, lacking
):
    path = write_study(tmp_path / "t.duckdb", [drive("nobody braked or sped up")])
    damage(path, lacking)
    trial_index = read(path)
    (row,) = trial_index.every({})
    assert (row["outcome"], row["account"]) == ("collided", None)
    Store(path).write("sweep-1", [played(drive("no valid plan", "o4"))], patience_s=5)
    trial_index.refresh()
    assert {row["account"] for row in trial_index.counts({}, "account")} == {"no valid plan", None}


def test_people_and_each_driver_are_summed_up_apart(listing):
    with duckdb.connect(str(listing.site.db), read_only=True) as connection:
        sums = connection.execute(
            "SELECT driver, count(*)::VARCHAR, format('{:.2f}', avg(gap_m)) FROM (SELECT *, "
            "if(source = 'human', 'people', model_left) AS driver FROM trials) "
            "JOIN trial_metrics USING (trial_id, spec_hash) WHERE driver IN ('people', 'o3') "
            "GROUP BY driver ORDER BY driver <> 'people'"
        ).fetchall()
    assert len(sums) == 2
    for address, expected in (("/trials", sums), ("/trials?model=human", sums[:1])):
        text = Page(listing.get(address).text).text
        found = re.findall(r"(o3|people): (\d+), \d+ crashed, mean gap (\S+) m", text)
        assert found == expected


def test_a_sparkline_cuts_nothing_and_the_page_says_its_scale(listing):
    rows = read(listing.site.db).page({}, "trial", 1)
    with duckdb.connect(str(listing.site.db), read_only=True) as connection:
        ((slowest, fastest),) = connection.execute(
            "SELECT min(velocity_mps), max(velocity_mps) FROM states"
        ).fetchall()
    low, high = speed_range(rows)
    assert low <= slowest == 0 < fastest <= high
    lines = {row["model"]: sparkline(row, (low, high)) for row in rows}
    points = " ".join(line[side] for line in lines.values() for side in ("left", "right")).split()
    heights = [float(point.partition(",")[2]) for point in points]
    assert 0 <= min(heights) <= max(heights) <= 22
    assert lines[HIDDEN]["left"].endswith(",22.0")
    text = Page(listing.get("/trials").text).text
    assert f"{low} to {high} m/s" in text
    assert "speed of the left vehicle 0.0 to 10.0 m/s" in text


def test_a_name_that_hides_something_is_neutral(listing):
    for address in (
        "/trials",
        "/trials?model=none%E2%80%AE",
        f"/trials/{HIDDEN}/baseline/N_0_0/rep01",
        f"/trials/{HIDDEN}",
        f"/discordant?model={HIDDEN}&variant=A1",
    ):
        said = "".join(Page(listing.get(address).text).said)
        assert "[U+202E]" in said
        assert not {"\u202e", "\u200b"} & set(said)


@pytest.mark.parametrize("case", cases("explorer", "empty-lists"))
def test_an_empty_list_names_the_values_that_no_trial_has(listing, case):
    page = Page(listing.get(f"/trials?{case['asked']}").text)
    assert (case["told"] in page.text, page.to("/trials.csv")) == (True, [])


def test_the_nearest_human_has_the_closest_headway_at_the_same_speeds_and_lasts_as_long(
    compared, tmp_path
):
    near, far = (f"human/{name}/N_0_0/rep01" for name in ("near", "far"))
    assert others(compared, FIRST, offer="nearest human") == near
    assert others(compared, near, offer="nearest human") == far
    path = shutil.copy(compared.site.db, tmp_path / "t.duckdb")
    for which, nearest in (("NOT IN", None), ("IN", near)):
        damage(
            path,
            "UPDATE specs SET spec = json_merge_patch(spec, '{\"mean_speed_mps\": 15}') WHERE "
            f"spec_hash {which} (SELECT spec_hash FROM trials WHERE source = 'human')",
        )
        assert others(client_of(path), FIRST, offer="nearest human") == nearest


def test_another_trial_is_offered_or_found_by_all_words_and_told_with_one_of_several_specs(
    compared, tmp_path
):
    for name, following in ((FIRST, SECOND), (SECOND, FIRST), ("o3/A1/N_0_0/rep01", None)):
        assert others(compared, name, offer="next repetition") == following
    (found,) = others(compared, FIRST, q="O3 rep01")["found"]
    assert found["key"] == "o3/A1/N_0_0/rep01"
    assert others(compared, FIRST, q="nobody has this") == {"found": []}
    reply = compared.get(f"/others/{FIRST}", params={"offer": "best"})
    assert (reply.status_code, "nearest human, next repetition" in reply.text) == (404, True)
    twice = shutil.copy(compared.site.db, tmp_path / "t.duckdb")
    for table in ("trials", "states"):
        damage(
            twice,
            f"INSERT INTO {table} BY NAME SELECT * REPLACE ('abc' AS spec_hash) FROM {table} "
            "WHERE trial_id = 'o4/A1/N_0_0/rep01'",
        )
    client = client_of(twice)
    keys = [one["key"] for one in others(client, FIRST, q="o4 a1")["found"]]
    assert sorted(keys) == ["o4/A1/N_0_0/rep01@abc", "o4/A1/N_0_0/rep01@o4-A1"]
    assert others(client, FIRST, compare="o4/A1/N_0_0/rep01@abc")["spec"] == "abc"


def test_trials_of_two_endpoints_are_listed_named_and_linked_apart_with_who_answered(
    prepare, emulator_url, tmp_path
):
    host = emulator_url.removeprefix("http://").removesuffix("/v1")
    other = host.replace("127.0.0.1", "localhost")
    part = ("--reps", 1, "--yes", *FAST, "--conditions", "L_4_0,N_0_0", "--db", "t.duckdb")
    for place, *options in ((host, "o3"), (other, "o3+constant", "--sample-set", 1)):
        at = {"OPENAI_API_KEY": "x", "OPENAI_BASE_URL": f"http://{place}/v1"}
        run = prepare(tmp_path, "sweep", "baseline", *part, "--model", *options, **at)
        assert run.code == 0, run.err
    client, words = client_of(tmp_path / "t.duckdb"), "mock model, not o3"
    trial_index = read(client.site.db)
    drivers = [f"o3 at {host}", f"o3 at {other}+constant/set1"]
    assert sorted(trial_index.facets({})["model"]) == [(name, 2) for name in sorted(drivers)]
    for driver in drivers:
        row = trial_index.every({"model": driver})[0]
        assert row["stand_in"] == words
        trial = Page(client.get(f"/trials/{row['trial_id']}?spec={row['spec_hash']}").text)
        (link,) = (to for to, text in trial.links if text.startswith("Trials like"))
        asked = {name: value for name, [value] in parse_qs(urlsplit(link).query).items()}
        assert [one["model"] for one in trial_index.every(filter_of(asked))] == [driver]
        listed = Page(client.get(link).text).text
        assert (driver in listed, words in trial.text) == (True, True)
    sweeps, runs = Page(client.get("/sweeps").text).text, list_runs(trial_index)
    for entry, driver in zip(runs, reversed(drivers), strict=True):
        name = driver.removesuffix("/set1")
        assert (entry["driver"], f"{name} mock model" in sweeps) == (name, True)
        page = Page(client.get(f"/sweeps/{entry['sweep_id']}").text).text
        assert (f"baseline: {name}" in page, words in page) == (True, True)
    assert all(words in client.get(page).text for page in ("/", "/trials.csv"))
    assert len(re.findall(r">baseline, [-:\d ]* UTC \(2\)<", client.get("/trials").text)) == 2
