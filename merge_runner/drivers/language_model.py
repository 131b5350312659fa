"""Driver by a language model: observation, prompt, reply, validated plan, executed actions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.base import DriverContext, make_context
from merge_runner.drivers.pace import model_pace
from merge_runner.prompts.blocks import Prompt, render_prompt
from merge_runner.prompts.parse import ParsedReply, parse_reply
from merge_runner.records import NO_DECISION, ChatReply, Decision, Observation, Road, Side, Slot
from merge_runner.trial_records import TrialSpec


class Question(NamedTuple):
    """Prompt for the model of a driver; ``decision`` makes the decision of prompt and reply.

    ``older`` is the prompt as earlier versions worded it for a driver without a valid plan: "this
    is your first decision". A stored reply to it is replayed in place of a new call.
    """

    model: str
    slot: Slot
    prompt: str
    older: str | None
    decision: Callable[[str, ChatReply], Decision]


@dataclass(frozen=True, slots=True)
class LanguageModel:
    """Factory of the drivers of one model: its ``name`` in a plan, and its prompts by variant."""

    name: str
    prompts: Mapping[str, Prompt]

    def make(self, scenario: ScenarioConfig, spec: TrialSpec, side: Side) -> LlmDriver:
        """Return a new driver for one side of a trial."""
        context = make_context(scenario, spec, side, model_pace(scenario))
        assert spec.variant is not None, "only human trials have no prompt variant"
        prompt = self.prompts[spec.prompts.get(side, spec.variant)]
        return LlmDriver(self.name, spec, context, prompt)


@dataclass(slots=True)
class LlmDriver:
    """Driver whose only state between prompts is the last valid plan."""

    model: str
    spec: TrialSpec
    context: DriverContext
    prompt: Prompt
    _plan: tuple[float, ...] | None = None
    _executed: int = 0
    _is_first: bool = True

    def ask(self, observation: Observation, number: int) -> Question:
        """Return the question whose reply decides."""
        spec, is_first = self.spec, self._is_first
        render = partial(
            render_prompt,
            observation,
            None if self._plan is None else self._plan[self._executed :],
            prompt=self.prompt,
            scenario=self.context.scenario,
        )
        self._is_first = False
        return Question(
            self.model,
            Slot(spec.condition, spec.repetition, self.context.side, number, spec.sample_set),
            render(first=is_first),
            render(first=True) if self._plan is None and not is_first else None,
            partial(self._answered, observation.road),
        )

    def _answered(self, road: Road, prompt: str, reply: ChatReply) -> Decision:
        """Return the plan of the reply, or the rest of the last valid plan.

        Without one, or at its end, the speed is constant.
        """
        scenario = self.context.scenario
        # A refused or truncated reply is not searched for a plan.
        parsed = (
            parse_reply(reply.text, scenario.plan_actions)
            if reply.outcome == "ok"
            else ParsedReply(None, None, reply.text, reply.outcome)
        )
        if parsed.plan is not None:
            self._plan, self._executed = parsed.plan, 0
        elif scenario.fallback == "restart":
            self._executed = 0
        count = self.context.pace.executed_actions
        actions = (self._plan or ())[self._executed :][:count]
        self._executed += count
        failure = parsed.failure
        if failure is None and parsed.tactical is None:
            failure = NO_DECISION if self.prompt.asks_tactical(road) else None
        return Decision(
            plan=parsed.plan,
            applied=actions + (0.0,) * (count - len(actions)),
            tactical=parsed.tactical,
            rationale=parsed.rationale,
            failure=failure,
            fallback=parsed.plan is None,
            prompt=prompt,
            reply=reply,
        )
