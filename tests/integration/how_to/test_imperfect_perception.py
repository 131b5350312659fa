"""The page on perception: its study can be planned, and each key is explained."""

import re

from merge_runner.config import Perception
from merge_runner.run.plan import make_plan
from tests.support.harness import PROJECT

PAGE = (PROJECT / "docs/perception.md").read_text()


def test_every_key_is_explained_and_the_study_of_the_page_can_be_played(tmp_path):
    (study,) = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    (tmp_path / "foggy.toml").write_text(study)
    levels = {arm.factors["perception"] for arm in make_plan(str(tmp_path / "foggy.toml")).arms}
    assert levels == {"perfect", "foggy", "hedge"}
    assert re.findall(r"^\| `(\w+)` \|", PAGE, re.MULTILINE) == [*Perception.model_fields]
