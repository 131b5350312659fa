"""What providers are known to send, by name: one reply each, word for word as far as documented.

A scenario has a scene for each format that it concerns. tests/llm/test_scenarios.py states for each
what the client does: the outcome, the number of attempts, the wait and the words that a user reads.
"""

from __future__ import annotations

from tests.emulator.scenarios.anthropic import ANTHROPIC
from tests.emulator.scenarios.base import Scenario
from tests.emulator.scenarios.compatible import COMPATIBLE
from tests.emulator.scenarios.gemini import GEMINI
from tests.emulator.scenarios.network import NETWORK
from tests.emulator.scenarios.openai import OPENAI

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
