"""The page on perception: its study is played, and what it says of it holds."""

import re

from merge_runner.config import Perception
from merge_runner.records import FAR_BEHIND_M
from merge_runner.run.plan import make_plan
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from tests.support.harness import PROJECT

PAGE = (PROJECT / "docs/perception.md").read_text()


def test_every_key_is_explained_and_the_study_of_the_page_can_be_played(tmp_path):
    (study,) = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    (tmp_path / "foggy.toml").write_text(study)
    levels = {arm.factors["perception"] for arm in make_plan(str(tmp_path / "foggy.toml")).arms}
    assert levels == {"perfect", "foggy", "hedge"}
    assert re.findall(r"^\| `(\w+)` \|", PAGE, re.MULTILINE) == [*Perception.model_fields]


def test_the_numbers_of_the_page_are_those_of_the_program():
    assert f"{FAR_BEHIND_M:g} m behind" in PAGE
    (told,) = re.findall(r"at most (\d+) m apart .*?, (\d+) to (\d+) m\s", PAGE, re.DOTALL)
    starts = [c.positions_m(max(c.exit_times_s(TRACK)), TRACK) for c in HUMAN_CONDITIONS.values()]
    to_merge_m = [TRACK.merge_point_m - position for pair in starts for position in pair]
    apart_m = max(abs(left - right) for left, right in starts)
    assert [round(apart_m), int(min(to_merge_m)), round(max(to_merge_m))] == [*map(int, told)]
