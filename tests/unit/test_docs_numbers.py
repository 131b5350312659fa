"""Numbers of the docs that no command prints are those of the program."""

import re

import pytest

from merge_runner.audit.checks import MOST_INVALID_SHARE
from merge_runner.config import ScenarioConfig
from merge_runner.llm.batch import lifecycle, rounds
from merge_runner.llm.delays import FIRST_BACKOFF_S, LONGEST_BACKOFF_S
from merge_runner.llm.endpoint_state import NOBODY_S
from merge_runner.llm.models import SOON_DAYS
from merge_runner.providers import SHORTEST_SECRET, ModelEntry
from merge_runner.records import FAR_BEHIND_M, SIDES
from merge_runner.run import estimate, guard, players, writer
from merge_runner.run.plan import _PROMPTS_PER_DRIVER
from merge_runner.run.selection import USUAL_GRID
from merge_runner.scenarios.merge.conditions import CONDITIONS, HUMAN_CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from merge_runner_analysis import wording
from merge_runner_analysis.stats.regressions import GAP_MARGIN_M
from merge_runner_analysis.web import export, report, search
from merge_runner_analysis.web.pages import conditions
from merge_runner_analysis.web.trial import account
from tests.support.harness import PROJECT

ENTRY = ModelEntry(provider="local", format="openai-chat", max_output_tokens=1)
WORLDS = [World(ScenarioConfig(), CONDITIONS[name], TRACK) for name in HUMAN_CONDITIONS]
SEEN = [world.observe(side) for world in WORLDS for side in SIDES]
AWAY_M = [seen.distance_to_merge_m for seen in SEEN]
DEFAULTS = ScenarioConfig().model_dump()
CLAIMS = {
    "batches.md": (
        f"at most {rounds.MAX_CALLS:,} requests. At most {players.MOST_IN_ROUNDS:,} trials",
        f"no batch can be created for {lifecycle.OUTAGE_S / 60:g} minutes",
        f"by its name within {sum(lifecycle.ARRIVAL_S):g} s",
    ),
    "explorer.md": (
        f"pages of up to {export.MOST:,} trials",
        f"traces of up to {conditions.MOST} trials",
        f"beyond {search.HOLDS * 100:g} % of the maximum",
        f"initial speed by at least {account.ACTED_MPS:g} m/s",
        f"gap below {account.NEAR_GAP_M:g} m, or a time to collision below {account.NEAR_TTC_S:g}",
    ),
    "models.md": (
        f"waits {FIRST_BACKOFF_S:g} s, doubled each time up to {LONGEST_BACKOFF_S:g} s",
        f"default {ENTRY.timeout_s:g}), of a call with its retries and waits ({ENTRY.deadline_s:g}",
        f"longer replies are refused ({ENTRY.max_reply_mb:g})",
        f"connection is refused for {NOBODY_S:g} to {2 * NOBODY_S:g} s",
        f"warn from {SOON_DAYS} days before",
    ),
    "numbers.md": (
        f"more than {MOST_INVALID_SHARE:.0%} of a model's decisions".replace("%", " %"),
        f"more than {report.MANY_FALLBACKS:.0%} fallbacks".replace("%", " %"),
        f"margins of {GAP_MARGIN_M:g} m and 0.5 SD",
        "within {collisions:g} points (collisions) or {gap:g} m (gap)".format(**wording.MARGINS),
        f"With fewer than {wording.ENOUGH} trials",
    ),
    "perception.md": (
        f"a car {FAR_BEHIND_M:g} m behind",
        f"{min(AWAY_M):.0f} to {max(AWAY_M):.0f} m before the merge point, at most "
        f"{max(seen.relative_distance_m for seen in SEEN):.0f} m apart",
    ),
    "plan-a-study.md": (f"`--grid usual` is `{USUAL_GRID}`",),
    "recordings.md": (f"| {11 * 10 * 2 * _PROMPTS_PER_DRIVER:.0f} |",),
    "reliability.md": (
        f"Up to {writer.BATCH} trials wait in memory",
        f"After {guard.MOST_INVALID} invalid decisions",
        f"Keys of {SHORTEST_SECRET} characters or more",
        f"left: {estimate.TRIAL_MARGIN:g} × its usual number of calls",
    ),
    "run-a-study.md": tuple(
        f"`{name}` {DEFAULTS[name]:g}" for name in ("step_s", "horizon_s", "memory_s", "timeout_s")
    ),
}


@pytest.mark.parametrize("page", CLAIMS)
def test_the_numbers_of_a_page_are_those_of_the_program(page):
    text = re.sub(r"\s+", " ", (PROJECT / "docs" / page).read_text("utf-8"))
    assert [claim for claim in CLAIMS[page] if claim not in text] == []
