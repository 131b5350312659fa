"""Numbers of the docs that no command prints are those of the program."""

import pytest

from merge_runner.audit.checks import MOST_INVALID_SHARE
from merge_runner.config import ScenarioConfig
from merge_runner.llm import delays, endpoint_state, models
from merge_runner.llm.batch import lifecycle, rounds
from merge_runner.providers import SHORTEST_SECRET, ModelEntry
from merge_runner.records import FAR_BEHIND_M, SIDES
from merge_runner.run import estimate, guard, players, selection, writer
from merge_runner.scenarios.merge.conditions import CONDITIONS, HUMAN_CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from merge_runner_analysis import wording
from merge_runner_analysis.published import published
from merge_runner_analysis.stats.regressions import GAP_MARGIN_M
from merge_runner_analysis.web import alarms, export
from merge_runner_analysis.web.pages import conditions
from merge_runner_analysis.web.trial import account
from tests.support.harness import PROJECT

UNSET = ScenarioConfig()
ENTRY = ModelEntry(provider="local", format="openai-chat", max_output_tokens=1)
SEEN = [World(UNSET, CONDITIONS[n], TRACK).observe(s) for n in HUMAN_CONDITIONS for s in SIDES]
AWAY_M = [seen.distance_to_merge_m for seen in SEEN]
PASSES = 100 * published("human_ceiling").set_index(["n", "indicator", "rule"])["share"]
ACTS_MPS2 = account.HOLDS * UNSET.max_acceleration_mps2
CLAIMS = f"""
batches: at most {rounds.MAX_CALLS:,} requests. At most {players.MOST_IN_ROUNDS:,} trials
batches: no batch can be created for {lifecycle.OUTAGE_S / 60:g} minutes
batches: by its name for {sum(lifecycle.ARRIVAL_S):g} s
explorer: pages of up to {export.MOST:,} trials
explorer: traces of up to {conditions.MOST} trials
explorer: beyond {account.HOLDS * 100:g} % of the maximum
glossary: beyond {account.HOLDS * 100:g} % of the greatest acceleration (usually {ACTS_MPS2:g} m/s²)
glossary: gap below {account.NEAR_GAP_M:g} m, or a time to collision below {account.NEAR_TTC_S:g} s
models: waits {delays.FIRST_BACKOFF_S:g} s, doubled each time up to {delays.LONGEST_BACKOFF_S:g} s
models: (default {ENTRY.timeout_s:g}), of a call with its retries and waits ({ENTRY.deadline_s:g})
models: longer replies are refused ({ENTRY.max_reply_mb:g})
models: is refused for {endpoint_state.NOBODY_S:g} to {2 * endpoint_state.NOBODY_S:g} s
models: warn from {models.SOON_DAYS} days before
numbers: more than {MOST_INVALID_SHARE * 100:g} % of a model's decisions
numbers: more than {alarms.MANY_FALLBACKS * 100:g} % fallbacks
numbers: together in {PASSES[10, "I1-I4", "paper"]:.0f} % of studies by the paper's rules
numbers: By the robust rules it is {PASSES[10, "I1-I4", "robust"]:g} %
numbers: I4 in {PASSES[10, "I4", "robust"]:.0f} % of data sets with 110 trials
numbers: and in {PASSES[50, "I4", "robust"]:.0f} % with 550
numbers: margins of {GAP_MARGIN_M:g} m and 0.5 SD
numbers: {wording.MARGINS["collisions"]:g} points or {wording.MARGINS["gap"]:g} m
numbers: With fewer than {wording.ENOUGH} trials
perception: a car {FAR_BEHIND_M:g} m behind
perception: begin {min(AWAY_M):.0f} to {max(AWAY_M):.0f} m before the merge point
perception: at most {max(seen.relative_distance_m for seen in SEEN):.0f} m apart
plan-a-study: `--grid usual` is `{selection.USUAL_GRID}`
reliability: Up to {writer.BATCH} trials wait in memory
reliability: After {guard.MOST_INVALID} invalid decisions
reliability: Keys of {SHORTEST_SECRET} characters or more
reliability: left: {estimate.TRIAL_MARGIN:g} × its usual number of calls
run-a-study: `step_s` {UNSET.step_s:g}, `horizon_s` {UNSET.horizon_s:g}
run-a-study: `memory_s` {UNSET.memory_s:g}, `timeout_s` {UNSET.timeout_s:g}
"""


@pytest.mark.parametrize("claim", CLAIMS.strip().splitlines())
def test_a_number_of_the_docs_is_that_of_the_program(claim):
    page, _, text = claim.partition(": ")
    assert text in " ".join((PROJECT / f"docs/{page}.md").read_text("utf-8").split())
