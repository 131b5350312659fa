"""What a sweep will take, before anything is sent."""

from __future__ import annotations

from dataclasses import dataclass

from merge_runner.config import ModelEntry
from merge_runner.llm.prices import pricing
from merge_runner.plan import PROMPTS_PER_DRIVER, Limits, Plan
from merge_runner.prompts.render import render_prompt
from merge_runner.records import Usage
from merge_runner.simulator.conditions import CONDITIONS
from merge_runner.simulator.world import World


@dataclass(frozen=True, slots=True)
class Estimate:
    """Trials, calls, tokens, USD (None: a price is unknown) and minutes of a live run."""

    trials: int
    calls: int
    input_tokens: int
    output_tokens: int
    cost_usd: float | None
    minutes: float
    free: bool


def estimate(plan: Plan, trials: int, limits: Limits) -> Estimate:
    """The estimate for this many trials of a plan, as if nothing were recorded yet."""
    calls = input_tokens = output_tokens = 0
    cost: float | None = 0.0
    slowest_s = 0.0
    prompt_tokens = len(_typical_prompt(plan).encode()) // 4
    for name, entry in plan.entries.items():
        share = sum(side == name for side in plan.sides.values())
        made = round(trials * share * PROMPTS_PER_DRIVER)
        each = Usage(input_tokens=prompt_tokens, output_tokens=entry.typical_output_tokens)
        price = pricing(entry).cost_usd(each)
        calls += made
        input_tokens += made * prompt_tokens
        output_tokens += made * entry.typical_output_tokens
        cost = None if cost is None or price is None else cost + made * price
        rounds = -(-2 * trials // limits.connections)
        slowest_s = max(
            slowest_s,
            rounds * PROMPTS_PER_DRIVER * entry.typical_latency_s,
            _limited_s(entry, limits, made, prompt_tokens),
        )
    return Estimate(
        trials=trials,
        calls=calls,
        input_tokens=input_tokens,
        output_tokens=output_tokens,
        cost_usd=None if cost is None else round(cost, 2),
        minutes=round(slowest_s / 60, 1),
        free=all(entry.price == "free" for entry in plan.entries.values()),
    )


def _limited_s(entry: ModelEntry, limits: Limits, calls: int, prompt_tokens: int) -> float:
    """How long the limits stretch the calls, in s.

    Within a minute's window a call counts with its output cap until its reply is in, and with
    its actual tokens from then on.
    """
    rpm, tpm = limits.rpm or entry.rpm, limits.tpm or entry.tpm
    waiting = min(entry.typical_latency_s / 60, 1.0)
    tokens = prompt_tokens + (
        waiting * entry.max_output_tokens + (1 - waiting) * entry.typical_output_tokens
    )
    return max(60 * calls / rpm if rpm else 0.0, 60 * calls * tokens / tpm if tpm else 0.0)


def _typical_prompt(plan: Plan) -> str:
    """The longest variant's prompt in the midst of an approach."""
    world = World(plan.scenario, CONDITIONS[plan.conditions[0]])
    rest = (0.25,) * (plan.scenario.plan_actions - plan.scenario.executed_actions)
    prompts = (
        render_prompt(world.observe("left"), rest, variant=variant, scenario=plan.scenario)
        for variant in plan.repetitions
    )
    return max(prompts, key=len)
