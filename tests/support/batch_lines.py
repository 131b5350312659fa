"""Lines for batches: real prompts in every format."""

from __future__ import annotations

from functools import cache

from merge_runner.config import ScenarioConfig
from merge_runner.llm.formats import FORMATS
from merge_runner.prompts.blocks import prompt_of, render_prompt
from merge_runner.records import Slot, make_request
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from tests.support.batch_fixtures import entry_of


@cache
def prompt(condition):
    scenario = ScenarioConfig()
    seen = World(scenario, CONDITIONS[condition], TRACK).observe("left")
    return render_prompt(seen, None, prompt=prompt_of("baseline"), scenario=scenario)


def lines(form, count=11, *, provider=None, first=0):
    """So many different requests, each of another slot."""
    conditions = list(CONDITIONS)
    entry = entry_of(form, provider)
    made = []
    for number in range(first, first + count):
        condition = conditions[number % len(conditions)]
        repetition = 1 + number // len(conditions)
        wire = FORMATS[form].request(entry, f"{prompt(condition)}\n{repetition}")
        request = make_request(
            provider=entry.provider,
            endpoint=entry.provider,
            model=entry.id,
            path=wire.path,
            headers=wire.headers,
            body=wire.body,
            slot=Slot(condition, repetition, "left", 0, 0),
        )
        made.append(request)
    return made


def keys(batch):
    return [line.key for line in batch]
