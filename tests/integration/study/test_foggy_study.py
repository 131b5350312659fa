"""A study of imperfect perception and of state lines, from its file to what is read of it."""

import html
import re
from statistics import median

import duckdb
import pytest

from merge_runner.results.store import query, results_digest
from tests.support.harness import FAST
from tests.support.serving import client_of

STUDY = """
models = ["emulator", "emulator+projected-order"]
repetitions = 1
conditions = ["L_4_0", "N_0_0"]

[factors]
prompt = ["told_more"]
perception = ["perfect", "foggy", "short"]

[prompts.told_more]
remove = ["C0"]
add = [{ block = "state.table" }, { block = "state.time_to_merge" }, { block = "state.time_gap" }]

[perception.foggy]
position_sd_m = 0.5
speed_sd_mps = 0.3
autocorrelation_s = 1.0
delay_s = 0.4
dropout = 0.3

[perception.short]
range_m = 3.0
"""
BESIDE = """
SELECT trial_id, side, perceived_distance_m - distance_m AS error_m,
    perceived_other_speed_mps - other_speed_mps AS error_mps, other_seen
FROM perceptions ORDER BY ALL
"""


@pytest.fixture(scope="module")
def db(prepare, tmp_path_factory):
    folder = tmp_path_factory.mktemp("foggy")
    (folder / "foggy.toml").write_text(STUDY)
    prepare(folder, "sweep", "foggy.toml", *FAST, code=0)
    return folder / "results/merge.duckdb"


async def test_a_foggy_study_replays_sealed_to_the_same_digest_and_is_audited(
    merge_runner, db, tmp_path
):
    (tmp_path / "foggy.toml").write_text(STUDY)
    cache = db.parents[1] / "cache/responses"
    replay = ("replay", "foggy.toml", "--cache", cache, "--db", "r", *FAST)
    await merge_runner(*replay, code=0)
    assert results_digest(tmp_path / "r") == results_digest(db)
    assert query(tmp_path / "r", BESIDE) == query(db, BESIDE)
    audit = await merge_runner("audit", "--db", "r")
    assert (audit.code, "12 replayed" in audit.out) == (0, True), audit.out
    with duckdb.connect(str(tmp_path / "r")) as connection:
        connection.execute(
            "UPDATE decisions SET perceived_distance_m = perceived_distance_m + 0.01"
        )
    audit = await merge_runner("audit", "--db", "r")
    assert (audit.code, "decisions.perceived_distance_m" in audit.out) == (1, True)


def test_what_was_so_stands_beside_what_was_told(db):
    _, rows = query(db, BESIDE)
    errors = {
        level: [row for row in rows if f"perception={level}" in row[0]]
        for level in ("perfect", "foggy", "short")
    }
    assert errors["perfect"] == []
    assert len({row[2] for row in errors["foggy"]}) > 60
    assert all(row[4] for row in errors["foggy"])
    assert 0.3 < median(abs(row[2]) for row in errors["foggy"]) < 3
    unseen = [row for row in errors["short"] if not row[4]]
    assert unseen
    assert {row[2:4] for row in unseen} == {(None, None)}
    assert {row[2:4] for row in errors["short"] if row[4]} == {(0.0, 0.0)}


def test_the_prompt_says_what_was_told_and_not_what_was_so(db):
    _, rows = query(
        db,
        "SELECT prompt, other_seen, perceived_distance_m, perceived_other_speed_mps FROM decisions "
        "WHERE prompt IS NOT NULL AND other_seen IS NOT NULL",
    )
    assert {seen for _, seen, *_ in rows} == {True, False}
    for prompt, seen, distance_m, speed_mps in rows:
        told = (f"{distance_m:.2f}".replace("-0.00", "0.00"), f"{speed_mps:.2f}") if seen else None
        distance, speed = told or ("not seen", "not seen")
        assert f"| Speed of the other car | {speed} | m/s |" in prompt
        assert f"behind) | {distance} | m |" in prompt


def test_the_panel_of_a_decision_shows_both_beside_each_other(db):
    client = client_of(db)

    def panel(level):
        trial = f"emulator/told_more/L_4_0/rep01/perception={level}"
        text = client.get(f"/trials/{trial}").text
        text = text.partition('">right</span> decision 0 at')[2].partition("</article>")[0]
        return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", text)).replace("−", "-").split())

    with duckdb.connect(str(db), read_only=True) as connection:
        so, told = connection.execute(
            "SELECT distance_m, perceived_distance_m FROM perceptions WHERE side = 'right' "
            "AND decision = 0 AND trial_id = 'emulator/told_more/L_4_0/rep01/perception=foggy'"
        ).fetchone()
    said = f"how far ahead the other is (m) {so:.2f} {told:.2f} {told - so:+.2f}"
    assert said in panel("foggy")
    assert " not seen " in panel("short")
    assert "what it perceived" not in panel("perfect")
    assert "state.table" in panel("foggy")
    assert "situation as a table" in panel("foggy")
