"""A language model as a driver: observation, prompt, reply, validated plan, five actions."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.base import Seat, take_seat
from merge_runner.drivers.pace import model_pace
from merge_runner.prompts.parse import ParsedReply, parse_reply
from merge_runner.prompts.render import render_prompt
from merge_runner.records import ChatReply, Decision, Observation, Side, Slot, TrialSpec

Ask = Callable[[str, Slot, TrialSpec], Awaitable[ChatReply]]
"""Asks the model with a prompt, for a slot of a trial; raises CallFailed."""
Decided = Callable[[Decision], None]
"""Gets each decision before it is driven; raises SweepStopped."""


def _ignore(_: Decision) -> None:
    pass


@dataclass(frozen=True, slots=True)
class LanguageModel:
    """Makes drivers that ask one model."""

    ask: Ask
    decided: Decided = _ignore

    def make(self, scenario: ScenarioConfig, spec: TrialSpec, side: Side) -> LlmDriver:
        """See MakeDriver."""
        seat = take_seat(scenario, spec, side, model_pace(scenario))
        return LlmDriver(self.ask, spec, seat, self.decided)


@dataclass(slots=True)
class LlmDriver:
    """Keeps the plan between prompts; everything else is in the prompt."""

    ask: Ask
    spec: TrialSpec
    seat: Seat
    decided: Decided = _ignore
    _plan: tuple[float, ...] | None = None
    _executed: int = 0

    async def decide(self, observation: Observation, number: int) -> Decision:
        """Ask the model and drive its plan, or go on with the last valid one."""
        scenario, spec = self.seat.scenario, self.spec
        assert spec.variant is not None, "only human trials have no prompt variant"
        prompt = render_prompt(
            observation, self._remaining(), variant=spec.variant, scenario=scenario
        )
        slot = Slot(spec.condition, spec.repetition, self.seat.side, number, spec.sample_set)
        reply = await self.ask(prompt, slot, spec)
        # A refusal or a truncated answer is an outcome of its own; it is not searched for a plan.
        parsed = (
            parse_reply(reply.text, scenario.plan_actions)
            if reply.outcome == "ok"
            else ParsedReply(None, None, reply.text, reply.outcome)
        )
        fallback = parsed.plan is None
        if parsed.plan is not None:
            self._plan, self._executed = parsed.plan, 0
        elif scenario.fallback == "restart":
            self._executed = 0
        decision = Decision(
            plan=parsed.plan,
            applied=self._take(),
            tactical=parsed.tactical,
            rationale=parsed.rationale,
            failure=parsed.failure,
            fallback=fallback,
            prompt=prompt,
            reply=reply,
        )
        self.decided(decision)
        return decision

    def _remaining(self) -> tuple[float, ...] | None:
        return None if self._plan is None else self._plan[self._executed :]

    def _take(self) -> tuple[float, ...]:
        """The next actions of the plan, and 0 where it is exhausted or there is none."""
        wanted = self.seat.pace.executed_actions
        actions = (self._remaining() or ())[:wanted]
        self._executed += wanted
        return actions + (0.0,) * (wanted - len(actions))
