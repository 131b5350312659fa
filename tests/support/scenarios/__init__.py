"""What providers are known to send, by name: one reply each, word for word as far as documented.

A scenario has a scene for each format that it concerns; test_scenarios.py states for each what the
client does: the outcome, the number of attempts, the wait and the words that a user reads.
"""

from __future__ import annotations

from tests.support.scenarios.anthropic import ANTHROPIC
from tests.support.scenarios.base import Scenario
from tests.support.scenarios.compatible import COMPATIBLE
from tests.support.scenarios.gemini import GEMINI
from tests.support.scenarios.network import NETWORK
from tests.support.scenarios.openai import OPENAI

SCENARIOS: dict[str, Scenario] = {
    f"{provider}/{name}": scenario
    for provider, scenarios in {
        "openai": OPENAI,
        "gemini": GEMINI,
        "anthropic": ANTHROPIC,
        **COMPATIBLE,
        "network": NETWORK,
    }.items()
    for name, scenario in scenarios.items()
}
