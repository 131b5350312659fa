"""The page on imperfect perception: its study is played, and what it says of it holds."""

from __future__ import annotations

import re

from merge_runner.config import Perception
from merge_runner.records import FAR_BEHIND_M
from merge_runner.results.store import query
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from tests.support.harness import FAST, PROJECT

PAGE = (PROJECT / "docs/how-to/imperfect-perception.md").read_text()


async def test_the_study_of_the_page_is_played_and_compared(merge_runner, tmp_path):
    (study,) = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    (tmp_path / "foggy.toml").write_text(study)
    played = await merge_runner("sweep", "foggy.toml", *FAST)
    assert played.code == 0, played.err
    compared = await merge_runner("tables", "factors", "--study", "foggy.toml")
    assert compared.code == 0, compared.err
    assert "perception" in compared.out
    db = tmp_path / "results/merge.duckdb"
    levels = (
        "SELECT trial_factors.value, count(*), count(told_distance_m), count(DISTINCT model_left) "
        "FROM perceptions JOIN trials USING (trial_id, spec_hash) "
        "JOIN trial_factors USING (trial_id, spec_hash) GROUP BY ALL ORDER BY ALL"
    )
    (foggy, hedge) = query(db, levels)[1]
    assert (foggy[0], foggy[3], hedge[0], hedge[3]) == ("foggy", 2, "hedge", 2)
    assert foggy[1] == foggy[2]
    assert 0 < hedge[2] < hedge[1]


def test_every_key_is_explained():
    assert re.findall(r"^\| `(\w+)` \|", PAGE, re.MULTILINE) == [*Perception.model_fields]


def test_the_numbers_of_the_page_are_those_of_the_program():
    assert f"{FAR_BEHIND_M:g} m behind" in PAGE
    (told,) = re.findall(r"at most (\d+) m apart .*?, (\d+) to (\d+) m\s", PAGE, re.DOTALL)
    starts = [c.positions_m(max(c.exit_times_s(TRACK)), TRACK) for c in HUMAN_CONDITIONS.values()]
    to_merge_m = [TRACK.merge_point_m - position for pair in starts for position in pair]
    apart_m = max(abs(left - right) for left, right in starts)
    assert [round(apart_m), int(min(to_merge_m)), round(max(to_merge_m))] == [*map(int, told)]
