"""What a network does, whatever the format."""

from __future__ import annotations

from typing import get_args

from merge_runner.llm.formats import FORMATS
from tests.support.scenarios.base import Break, Scenario, Scene

BREAKS: tuple[Break, ...] = get_args(Break)

NETWORK: dict[str, Scenario] = {
    "slow": dict.fromkeys(FORMATS, Scene(after_s=35.0)),
    **{name: dict.fromkeys(FORMATS, Scene(breaks=name)) for name in BREAKS},
}
