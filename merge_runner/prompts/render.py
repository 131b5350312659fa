"""An observation as the text of a prompt."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache

from merge_runner.config import ScenarioConfig
from merge_runner.prompts.blocks import blocks_of, named
from merge_runner.prompts.fields import FIELDS, Situation
from merge_runner.prompts.state_lines import NOT_SEEN
from merge_runner.records import Observation, Road
from merge_runner.registry import Catalogue, in_use

_UNIT_OF_NOTHING = re.compile(rf"({NOT_SEEN}) (?:m/s\^2|m/s|km/h|mph|m|s)(?![\w/^])")


def render_prompt(
    observation: Observation,
    remaining_plan: Sequence[float] | None,
    *,
    variant: str,
    scenario: ScenarioConfig,
) -> str:
    """The prompt of a variant.

    ``remaining_plan`` is the unexecuted rest of the last valid plan (normalised accelerations),
    None before the first.
    """
    template, names = _template(variant, observation.road, in_use())
    now = Situation(observation, scenario, remaining_plan)
    prompt = template.format_map({name: FIELDS[name](now) for name in names})
    return prompt if observation.other_seen else _UNIT_OF_NOTHING.sub(r"\1", prompt)


@lru_cache
def _template(variant: str, road: Road, _: Catalogue) -> tuple[str, frozenset[str]]:
    """The blocks of a variant that a road has, one below the other; and the fields they name."""
    blocks = blocks_of(variant).values()
    templates = (block.merge if road == "merge" else block.straight for block in blocks)
    whole = "\n\n".join(template for template in templates if template is not None) + "\n"
    return whole, frozenset(named(whole))
