"""A language model as a driver: observation, prompt, reply, validated plan, five actions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
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
    Road,
    Side,
    Slot,
    TrialSpec,
)


@dataclass(frozen=True, slots=True)
class Question:
    """A prompt for the model of a driver, and what the driver decides by a reply to it.

    Earlier versions told a driver without a valid plan at each decision that it was its first one:
    where a prompt has been asked in such ``older`` words, these stay, so that recordings replay.
    ``decide`` gets the prompt that was asked, and the reply.
    """

    model: str
    slot: Slot
    prompt: str
    older: str | None
    decide: Callable[[str, ChatReply], Decision]


@dataclass(frozen=True, slots=True)
class LanguageModel:
    """Makes the drivers of one model, called ``name`` in a plan, with the prompts of variants."""

    name: str
    prompts: Mapping[str, Prompt]

    def make(self, scenario: ScenarioConfig, spec: TrialSpec, side: Side) -> LlmDriver:
        """See MakeDriver."""
        seat = take_seat(scenario, spec, side, model_pace(scenario))
        assert spec.variant is not None, "only human trials have no prompt variant"
        prompt = self.prompts[spec.prompts.get(side, spec.variant)]
        return LlmDriver(self.name, spec, seat, prompt)


@dataclass(slots=True)
class LlmDriver:
    """Keeps the plan between prompts; everything else is in the prompt."""

    model: str
    spec: TrialSpec
    seat: Seat
    prompt: Prompt
    _plan: tuple[float, ...] | None = None
    _executed: int = 0
    _is_first: bool = True

    def decide(self, observation: Observation, number: int) -> Question:
        """Return the question by whose answer it decides."""
        spec, is_first = self.spec, self._is_first
        render = partial(
            render_prompt,
            observation,
            None if self._plan is None else self._plan[self._executed :],
            prompt=self.prompt,
            scenario=self.seat.scenario,
        )
        self._is_first = False
        return Question(
            self.model,
            Slot(spec.condition, spec.repetition, self.seat.side, number, spec.sample_set),
            render(first=is_first),
            render(first=True) if self._plan is None and not is_first else None,
            partial(self._answered, observation.road),
        )

    def _answered(self, road: Road, prompt: str, reply: ChatReply) -> Decision:
        """Drive the plan of a reply, or go on with the last valid one.

        Where the plan is exhausted, or there is none, the vehicle cruises.
        """
        scenario = self.seat.scenario
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
            asked = self.prompt.asks_tactical(road)
            failure = NO_DECISION if asked else None
        return Decision(
            plan=parsed.plan,
            applied=actions + (0.0,) * (wanted - len(actions)),
            tactical=parsed.tactical,
            rationale=parsed.rationale,
            failure=failure,
            fallback=parsed.plan is None,
            prompt=prompt,
            reply=reply,
        )
