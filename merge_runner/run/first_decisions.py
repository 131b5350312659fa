"""Stops a run where a model gives no valid decision, before much is paid for what is no result."""

from __future__ import annotations

import asyncio
import math
from collections import Counter, defaultdict
from collections.abc import AsyncIterator, Iterable
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial

from merge_runner.errors import NoValidDecision
from merge_runner.llm.http_outcome import REGISTRY
from merge_runner.records import Decision
from merge_runner.text_safety import one_line

MOST_INVALID = 20
"""After so many a live run stops."""
SHOWN = 300
WHY = {
    "no_array": "it has no list of numbers",
    "several_arrays": "it has several different lists that could be the plan",
    "out_of_range": "its list has a number that is not between -1 and 1",
    "wrong_length": "its list has another length than the prompt asks for",
    "not_finite": "its list has a number that is not finite",
    "not_a_number": "its list has an entry that is no number",
    "refusal": "the model refuses to answer",
    "truncated": "it is cut off at the most tokens that the model may write",
    "empty": "it is empty",
}
TOO_SHORT = f"set a higher `max_output_tokens` in {REGISTRY}"
ADVICE = {
    "refusal": "look at what the prompt asks for",
    "truncated": TOO_SHORT,
    "empty": TOO_SHORT,
}
OF_THE_FORM = (
    "look at the output format that the prompt asks for; some servers hold a small model to it by "
    "a grammar"
)


class FirstDecisions:
    """The decisions of each model until one is valid, of which so many may be invalid.

    They are ``one_by_one`` where trials can wait for each other.
    """

    def __init__(self, most_invalid: float = math.inf, *, one_by_one: bool = False) -> None:
        self._most_invalid = most_invalid
        self._one_by_one = one_by_one
        self._valid: set[str] = set()
        self._invalid: Counter[str] = Counter()
        self._first: dict[str, str] = {}
        self._turns: defaultdict[str, asyncio.Semaphore] = defaultdict(
            partial(asyncio.Semaphore, 1)
        )

    @asynccontextmanager
    async def turn(self, models: Iterable[str]) -> AsyncIterator[None]:
        """Play a trial when its models have decided validly, or no other trial asks them."""
        for model in models:
            self._check(model)
        waiting = {*models} - self._valid if self._one_by_one else ()
        async with AsyncExitStack() as stack:
            for model in sorted(waiting):  # in one order, so that no two wait for each other
                turn = self._turns[model]
                await turn.acquire()
                if model in self._valid:
                    turn.release()  # to the next one
                else:
                    stack.callback(turn.release)
            yield

    def count(self, model: str, decision: Decision) -> None:
        """Count a decision; raises NoValidDecision where too many are invalid."""
        if model in self._valid:
            return
        if decision.valid:
            self._valid.add(model)
            self._turns[model].release()
            return
        text = decision.reply.text if decision.reply else ""
        self._add_invalid(model, 1, decision.failure, text)
        self._check(model)

    def for_a_task(self) -> FirstDecisions:
        """Those of another process, which knows which models have decided validly."""
        first = FirstDecisions(self._most_invalid, one_by_one=self._one_by_one)
        first._valid |= self._valid  # of this class
        return first

    def add_stored(
        self, model: str, valid: int, invalid: int, failure: str | None, text: str | None
    ) -> None:
        """Count the decisions of earlier runs; ``failure`` and ``text`` are of an invalid one."""
        if valid:
            self._valid.add(model)
        elif invalid:
            self._add_invalid(model, invalid, failure, text)

    def without_a_valid_one(self) -> list[str]:
        """A line for each model none of whose decisions is valid."""
        return [
            f"none of the {number} decisions of {model} is valid. {self._first[model]}"
            for model, number in sorted(self._invalid.items())
            if model not in self._valid
        ]

    def _add_invalid(self, model: str, number: int, failure: str | None, text: str | None) -> None:
        self._invalid[model] += number
        self._first.setdefault(model, _described(failure or "", text or ""))

    def _check(self, model: str) -> None:
        if model not in self._valid and self._invalid[model] >= self._most_invalid:
            raise NoValidDecision(
                f"none of the first {self._invalid[model]} decisions of {model} is valid, and "
                f"nothing else is asked. {self._first[model]}. What was answered is kept; "
                "--keep-going goes on with such a model"
            )


def _described(failure: str, text: str) -> str:
    """The reply, why it is invalid, and what to look at."""
    text = one_line(" ".join(text.split()))
    cut = f"{text[:SHOWN]}..." if len(text) > SHOWN else text
    shown = f'The first reply is "{cut}"' if text else "The first reply has no text"
    why = WHY.get(failure, failure)
    return f"{shown}: {failure}, {why}. To mend that {ADVICE.get(failure, OF_THE_FORM)}"
