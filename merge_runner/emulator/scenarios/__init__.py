"""What providers are known to send, by name; see docs/reference/emulator.md."""

from __future__ import annotations

from merge_runner.emulator.scenarios.anthropic import ANTHROPIC
from merge_runner.emulator.scenarios.base import Scenario
from merge_runner.emulator.scenarios.compatible import COMPATIBLE
from merge_runner.emulator.scenarios.gemini import GEMINI
from merge_runner.emulator.scenarios.network import NETWORK
from merge_runner.emulator.scenarios.openai import OPENAI

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
