"""The guard that stops a run whose model gives no valid decision."""

from __future__ import annotations

import asyncio
import math
from collections import Counter
from collections.abc import AsyncIterator, Collection
from contextlib import asynccontextmanager

from merge_runner.errors import NoValidDecision
from merge_runner.records import Decision
from merge_runner.text_safety import one_line

# So many invalid decisions before any valid one stop a live run, before they cost much.
MOST_INVALID = 20
SHOWN = 300
ADVICE = (
    "look at what the prompt asks for, and in which output format; some servers hold a small "
    "model to it by a grammar. Where replies are cut off or empty, set a higher "
    "`max_output_tokens` in the model's table of models.toml"
)


class FirstDecisions:
    """Count of each model's invalid decisions before its first valid one.

    A run stops at ``most_invalid`` of them. ``one_by_one``: before a valid decision only one trial
    at a time asks a model. ``valid`` are the models with a valid decision.
    """

    def __init__(self, most_invalid: float = math.inf, *, one_by_one: bool = False) -> None:
        self._most_invalid = most_invalid
        self._one_by_one = one_by_one
        self.valid: set[str] = set()
        self._invalid: Counter[str] = Counter()
        self._described: dict[str, str] = {}
        self._alone: set[str] = set()  # models that a trial asks alone
        self._changed = asyncio.Event()

    @asynccontextmanager
    async def turn(self, models: Collection[str]) -> AsyncIterator[None]:
        """With ``one_by_one``, wait until no other trial asks a model without a valid decision."""
        self._check()
        alone = {*models} if self._one_by_one else set()
        while alone & self._alone - self.valid:
            self._changed.clear()
            await self._changed.wait()
        alone -= self.valid
        self._alone |= alone
        try:
            yield
        finally:
            self._alone -= alone
            self._changed.set()

    def count_decision(self, model: str, decision: Decision) -> None:
        """Count a decision; raises NoValidDecision where too many are invalid."""
        text = decision.reply.text if decision.reply else ""
        self.add(model, decision.valid, not decision.valid, decision.failure, text)
        self._check()

    def add(
        self, model: str, valid: int, invalid: int, failure: str | None, text: str | None
    ) -> None:
        """Count numbers of decisions; an invalid one has a ``failure`` and a ``text``."""
        if valid:
            self.valid.add(model)
            self._changed.set()
        if invalid:
            self._invalid[model] += invalid
            shown = one_line(" ".join((text or "").split()))[:SHOWN]
            reply = f'"{shown}" ({(failure or "").replace("_", " ")})'
            self._described.setdefault(model, f"The first reply is {reply}. To mend that {ADVICE}")

    def without_a_valid_one(self, least: float = 1) -> list[str]:
        """Return a line for each model with ``least`` or more decisions, none of them valid."""
        return [
            f"none of the first {number} decisions of {model} is valid. {self._described[model]}"
            for model, number in sorted(self._invalid.items())
            if model not in self.valid and number >= least
        ]

    def _check(self) -> None:
        for line in self.without_a_valid_one(self._most_invalid):
            raise NoValidDecision(
                f"{line}. All replies are stored; --keep-going goes on with such a model"
            )
