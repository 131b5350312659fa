"""What a sweep will take, before anything is sent."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from merge_runner.config import ModelEntry, driver_name
from merge_runner.drivers.pace import model_pace
from merge_runner.llm.cache import CallTotals
from merge_runner.llm.prices import cost_usd
from merge_runner.llm.trial_costs import Answers, TrialCalls, TrialCosts
from merge_runner.prompts.render import render_prompt
from merge_runner.records import Usage
from merge_runner.run.plan import PROMPTS_PER_DRIVER, Options, Plan
from merge_runner.scenarios.registry import new_world

# A reply's JSON around the prompt, and later prompts with longer histories and numbers.
PROMPT_MARGIN = 1.25


@dataclass(frozen=True, slots=True)
class Estimate:
    """A live run's drivers, trials, calls, tokens, USD (None: a price is unknown) and minutes.

    ``measured`` lists the drivers whose tokens and latency are taken from their earlier answers.
    """

    driver: str
    trials: int
    calls: int
    input_tokens: int
    output_tokens: int
    cost_usd: float | None
    minutes: float
    free: bool
    measured: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _PerCall:
    """What one call of a model takes, as measured or as listed in the registry."""

    usage: Usage
    latency_s: float
    measured: bool


def estimate(
    plan: Plan,
    options: Options,
    *,
    trials: int,
    calls: Mapping[str, float],
    facts: Mapping[str, CallTotals],
) -> Estimate:
    """The estimate for what a live run of a plan has yet to do.

    ``trials`` counts those neither stored nor recorded; ``calls`` is roughly how many each model
    has yet to answer; ``facts`` is what the cache knows about each model's earlier answers to
    similar requests at its endpoint.
    """
    all_calls = input_tokens = output_tokens = 0
    cost: float | None = 0.0
    slowest_s = 0.0
    measured = []
    for name, entry in plan.entries.items():
        made = round(calls[name])
        each = _per_call(plan, entry, facts[name])
        price = cost_usd(entry, each.usage)
        tokens_in, tokens_out = each.usage.input_tokens or 0, each.usage.output_tokens or 0
        all_calls += made
        input_tokens += made * tokens_in
        output_tokens += made * tokens_out
        cost = None if cost is None or price is None else cost + made * price
        measured += [driver_name(name, plan.endpoints[name])] if each.measured else []
        at_once = min(options.connections, 2 * max(trials, 1))
        slowest_s = max(
            slowest_s,
            math.ceil(made / at_once) * each.latency_s,
            _limited_s(options, entry, made, each),
        )
    return Estimate(
        driver=plan.driver,
        trials=trials,
        calls=all_calls,
        input_tokens=input_tokens,
        output_tokens=output_tokens,
        cost_usd=None if cost is None else round(cost, 2),
        minutes=round(slowest_s / 60, 1),
        free=all(entry.price == "free" for entry in plan.entries.values()),
        measured=tuple(measured),
    )


def trial_costs(plan: Plan, facts: Mapping[str, CallTotals]) -> TrialCosts:
    """What the trials of a plan are expected to cost; a cell is a prompt variant.

    ``facts`` is as for ``estimate``.
    """
    variants = {spec.order: spec.variant or "" for spec in plan.trial_specs()}
    calls = {variant: _trial_calls(plan, variant) for variant in plan.repetitions}
    earlier = {
        name: Answers(totals.measured, totals.measured * _measured_usd(plan.entries[name], totals))
        for name, totals in facts.items()
        if totals.measured
    }
    return TrialCosts(variants.__getitem__, calls, earlier)


def _trial_calls(plan: Plan, variant: str) -> dict[str, TrialCalls]:
    """The calls of each model in a trial: at most up to the timeout, every answer at its cap."""
    sides = Counter(name for name in plan.sides.values() if name in plan.entries)
    most = math.ceil(plan.scenario.timeout_steps / model_pace(plan.scenario).interval_steps)
    # No tokeniser makes more tokens than bytes.
    read = int(len(_typical_prompt(plan, variant).encode()) * PROMPT_MARGIN)
    calls = {}
    for name, number in sides.items():
        entry = plan.entries[name]
        worst = Usage(input_tokens=read, output_tokens=entry.max_output_tokens)
        calls[name] = TrialCalls(
            number * PROMPTS_PER_DRIVER, number * most, cost_usd(entry, worst) or 0.0
        )
    return calls


def _measured_usd(entry: ModelEntry, totals: CallTotals) -> float:
    """What an answer has cost on average, at today's price."""
    usage = Usage(
        input_tokens=round(totals.input_tokens / totals.measured),
        output_tokens=round(totals.output_tokens / totals.measured),
    )
    return cost_usd(entry, usage) or 0.0


def _per_call(plan: Plan, entry: ModelEntry, facts: CallTotals) -> _PerCall:
    if facts.measured:
        usage = Usage(
            input_tokens=round(facts.input_tokens / facts.measured),
            output_tokens=round(facts.output_tokens / facts.measured),
        )
        return _PerCall(usage, facts.latency_s / facts.measured, True)
    longest = max((_typical_prompt(plan, variant) for variant in plan.repetitions), key=len)
    prompt_tokens = len(longest.encode()) // 4  # English has about 4 bytes a token
    usage = Usage(input_tokens=prompt_tokens, output_tokens=entry.typical_output_tokens)
    return _PerCall(usage, entry.typical_latency_s, False)


def _limited_s(options: Options, entry: ModelEntry, calls: int, each: _PerCall) -> float:
    """How long the limits stretch the calls, in s.

    Within a minute's window a call counts with its output cap until its reply is in, and with
    its actual tokens from then on.
    """
    rpm, tpm = options.rates(entry)
    waiting = min(each.latency_s / 60, 1.0)
    tokens = (each.usage.input_tokens or 0) + (
        waiting * entry.max_output_tokens + (1 - waiting) * (each.usage.output_tokens or 0)
    )
    return max(60 * calls / rpm if rpm else 0.0, 60 * calls * tokens / tpm if tpm else 0.0)


def _typical_prompt(plan: Plan, variant: str) -> str:
    """A variant's prompt in the middle of an approach."""
    world = new_world(plan.scenario, plan.conditions[0])
    rest = (0.25,) * (plan.scenario.plan_actions - plan.scenario.executed_actions)
    return render_prompt(world.observe("left"), rest, variant=variant, scenario=plan.scenario)
