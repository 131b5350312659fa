"""A language model as a driver: observation, prompt, reply, validated plan, five actions."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from functools import partial

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.base import Seat, take_seat
from merge_runner.drivers.pace import model_pace
from merge_runner.prompts.blocks import Prompt, render_prompt
from merge_runner.prompts.parse import ParsedReply, parse_reply
from merge_runner.records import (
    NO_DECISION,
    ChatReply,
    Decision,
    Observation,
    Side,
    Slot,
    TrialSpec,
)

Ask = Callable[[str, Slot, TrialSpec], Awaitable[ChatReply]]
"""Asks the model with a prompt, for a slot of a trial; raises CallFailed."""
Known = Callable[[str, Slot], bool]
"""Whether the model has been asked with a prompt for a slot already."""
Decided = Callable[[Decision], None]
"""Gets each decision before it is driven; raises SweepStopped."""


@dataclass(frozen=True, slots=True)
class LanguageModel:
    """Makes drivers that ask one model, with the prompts of the variants."""

    ask: Ask
    prompts: Mapping[str, Prompt]
    decided: Decided | None = None
    known: Known | None = None

    def make(self, scenario: ScenarioConfig, spec: TrialSpec, side: Side) -> LlmDriver:
        """See MakeDriver."""
        seat = take_seat(scenario, spec, side, model_pace(scenario))
        assert spec.variant is not None, "only human trials have no prompt variant"
        prompt = self.prompts[spec.prompts.get(side, spec.variant)]
        return LlmDriver(self.ask, spec, seat, prompt, self.decided, self.known)


@dataclass(slots=True)
class LlmDriver:
    """Keeps the plan between prompts; everything else is in the prompt."""

    ask: Ask
    spec: TrialSpec
    seat: Seat
    prompt: Prompt
    decided: Decided | None = None
    known: Known | None = None
    _plan: tuple[float, ...] | None = None
    _executed: int = 0
    _is_first: bool = True

    async def decide(self, observation: Observation, number: int) -> Decision:
        """Ask the model and drive its plan, or go on with the last valid one.

        Where the plan is exhausted, or there is none, the vehicle cruises.
        """
        scenario, spec = self.seat.scenario, self.spec
        slot = Slot(spec.condition, spec.repetition, self.seat.side, number, spec.sample_set)
        prompt = self._prompt(observation, slot)
        self._is_first = False
        reply = await self.ask(prompt, slot, spec)
        # A refusal or a truncated answer is an outcome of its own; it is not searched for a plan.
        parsed = (
            parse_reply(reply.text, scenario.plan_actions)
            if reply.outcome == "ok"
            else ParsedReply(None, None, reply.text, reply.outcome)
        )
        if parsed.plan is not None:
            self._plan, self._executed = parsed.plan, 0
        elif scenario.fallback == "restart":
            self._executed = 0
        wanted = self.seat.pace.executed_actions
        actions = (self._plan or ())[self._executed :][:wanted]
        self._executed += wanted
        failure = parsed.failure
        if failure is None and parsed.tactical is None:
            asked = self.prompt.asks_tactical(observation.road)
            failure = NO_DECISION if asked else None
        decision = Decision(
            plan=parsed.plan,
            applied=actions + (0.0,) * (wanted - len(actions)),
            tactical=parsed.tactical,
            rationale=parsed.rationale,
            failure=failure,
            fallback=parsed.plan is None,
            prompt=prompt,
            reply=reply,
        )
        if self.decided is not None:
            self.decided(decision)
        return decision

    def _prompt(self, observation: Observation, slot: Slot) -> str:
        """The prompt for a slot.

        Earlier versions told a driver without a valid plan at each decision that it was its first
        one. Where such a prompt has been asked it stays, so that recordings replay.
        """
        render = partial(
            render_prompt,
            observation,
            None if self._plan is None else self._plan[self._executed :],
            prompt=self.prompt,
            scenario=self.seat.scenario,
        )
        prompt = render(first=self._is_first)
        if self._plan is not None or self._is_first or self.known is None:
            return prompt
        older = render(first=True)
        is_older = self.known(older, slot) and not self.known(prompt, slot)
        return older if is_older else prompt
