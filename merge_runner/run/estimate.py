"""What a sweep will take, before anything is sent."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from merge_runner.config import ModelEntry, driver_name
from merge_runner.llm.batch.providers import batch_terms
from merge_runner.llm.call_totals import CallTotals
from merge_runner.llm.ledger import Spending
from merge_runner.llm.prices import cost_usd
from merge_runner.llm.trial_costs import Answers, TrialCalls, TrialCosts
from merge_runner.prompts.render import render_prompt
from merge_runner.records import Usage
from merge_runner.run.plan import Options, Plan, most_prompts, usual_prompts
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from merge_runner.study.crossing import Arm

# A reply's JSON around the prompt, and later prompts with longer histories and numbers.
PROMPT_MARGIN = 1.25


@dataclass(frozen=True, slots=True)
class BatchEstimate:
    """What a run costs in batches in USD (None: unknown), in how many rounds, usually and at most.

    A round takes as long as its slowest batch.
    """

    cost_usd: float | None
    rounds: int
    most_rounds: int


@dataclass(frozen=True, slots=True)
class Estimate:
    """A live run's drivers, trials, calls, tokens, USD (None: a price is unknown) and minutes.

    ``measured`` lists the drivers whose tokens and latency are taken from their earlier answers.
    ``trials_within_cap`` is None without a cap, or where a price is unknown. ``batch`` is what the
    same takes in batches, where the run is to use them.
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
    trials_within_cap: int | None
    batch: BatchEstimate | None = None


@dataclass(frozen=True, slots=True)
class _Calls:
    """How many calls a model of the registry has yet to answer in one arm, and what one takes.

    A run pays a ``part`` of their price: less than all of it in batches.
    """

    arm: str
    model: str
    entry: ModelEntry
    number: int
    usage: Usage
    latency_s: float
    part: float

    @property
    def cost_usd(self) -> float | None:
        """What they cost together, asked singly."""
        price = cost_usd(self.entry, self.usage)
        return None if price is None else self.number * price

    @property
    def paid_usd(self) -> float | None:
        """What the run pays for them."""
        return None if self.cost_usd is None else self.cost_usd * self.part


def estimate(
    plan: Plan,
    options: Options,
    *,
    trials: Mapping[str, int],
    calls: Mapping[str, Mapping[str, float]],
    facts: Mapping[str, CallTotals],
    spending: Spending,
) -> Estimate:
    """The estimate for the ``trials`` that a live run of a plan has yet to play, by arm.

    ``calls`` is roughly how many each model has yet to answer in an arm. ``facts`` is what the
    cache knows about each model's earlier answers to similar requests at its endpoint,
    ``spending`` what counts against the caps already.
    """
    todo = [
        _Calls(
            label,
            plan.registered[name],
            entry,
            round(calls[label][name]),
            *_per_call(plan, arm, entry, facts[name]),
            price_factor(entry) if options.batch else 1.0,
        )
        for label, arm in plan.by_label().items()
        for name, entry in arm.entries.items()
    ]
    batch = None
    if options.batch:
        batch = BatchEstimate(
            cost_usd=_rounded_sum(each.paid_usd for each in todo),
            rounds=max((math.ceil(usual_prompts(arm)) for arm in plan.arms), default=0),
            most_rounds=max(map(most_prompts, plan.arms), default=0),
        )
    return Estimate(
        plan.driver,
        sum(trials.values()),
        calls=sum(each.number for each in todo),
        input_tokens=sum(each.number * (each.usage.input_tokens or 0) for each in todo),
        output_tokens=sum(each.number * (each.usage.output_tokens or 0) for each in todo),
        cost_usd=_rounded_sum(each.cost_usd for each in todo),
        minutes=_minutes(options, sum(trials.values()), todo),
        free=all(entry.price == "free" for entry in plan.entries.values()),
        measured=tuple(
            driver_name(name, plan.endpoints[name]) for name in plan.entries if facts[name].measured
        ),
        trials_within_cap=_within(options.max_cost_usd, spending, trials, todo),
        batch=batch,
    )


def price_factor(entry: ModelEntry) -> float:
    """What part of its price a model costs in batches."""
    terms = batch_terms(entry)
    return 1.0 if terms is None else terms.price_factor


def _rounded_sum(costs: Iterable[float | None]) -> float | None:
    """The sum to a cent; None where a price is unknown."""
    known = list(costs)
    return None if None in known else round(sum(cost or 0.0 for cost in known), 2)


def _within(
    cap_usd: float | None, spending: Spending, trials: Mapping[str, int], calls: Sequence[_Calls]
) -> int | None:
    """How many trials the money left buys, spread evenly; None without a cap or a price."""
    if cap_usd is None or any(each.cost_usd is None for each in calls):
        return None
    usd = sum(each.paid_usd or 0.0 for each in calls)
    paid = {each.arm for each in calls if each.paid_usd}
    share = max(0.0, min(1.0, (cap_usd - spending.committed_usd) / usd)) if usd else 1.0
    return int(sum(n * (share if label in paid else 1.0) for label, n in trials.items()))


def _minutes(options: Options, trials: int, calls: Sequence[_Calls]) -> float:
    """How long the slowest model takes, by its latency or by its limits."""
    at_once = min(options.connections, 2 * max(trials, 1))
    slowest_s = 0.0
    for model in {each.model for each in calls}:
        own = [each for each in calls if each.model == model]
        in_turn_s = math.ceil(sum(each.number for each in own) / at_once) * own[0].latency_s
        slowest_s = max(slowest_s, in_turn_s, sum(_limited_s(options, each) for each in own))
    return round(slowest_s / 60, 1)


def trial_costs(plan: Plan, facts: Mapping[str, CallTotals], *, batch: bool = False) -> TrialCosts:
    """What the trials of a plan are expected to cost, in a ``batch`` run or not; a cell is an arm.

    ``facts`` is as for ``estimate``.
    """
    labels = {spec.order: spec.arm for spec in plan.trial_specs()}
    parts = {name: price_factor(e) if batch else 1.0 for name, e in plan.entries.items()}
    calls = {arm.label: _trial_calls(plan, arm, parts) for arm in plan.arms}
    earlier: defaultdict[str, Answers] = defaultdict(Answers)
    for name, totals in facts.items():
        if totals.measured:
            one_usd = cost_usd(plan.entries[name], _measured_usage(totals)) or 0.0
            usd = totals.measured * one_usd * parts[name]
            earlier[plan.registered[name]].add(usd, totals.measured)
    return TrialCosts(lambda order: calls[labels[order]], earlier)


def _trial_calls(plan: Plan, arm: Arm, parts: Mapping[str, float]) -> dict[str, TrialCalls]:
    """The calls of each model in a trial: at most up to the timeout, every answer at its cap.

    A model that drives on both sides with different parameters counts with the dearer ones. Each
    costs so many ``parts`` of its price.
    """
    sides = Counter(name for name in arm.asked.values() if name in arm.entries)
    usual, most = usual_prompts(arm), most_prompts(arm)
    # No tokeniser makes more tokens than bytes.
    read = int(len(typical_prompt(plan, arm).encode()) * PROMPT_MARGIN)
    calls: dict[str, TrialCalls] = {}
    for name, number in sides.items():
        entry = arm.entries[name]
        worst = Usage(input_tokens=read, output_tokens=entry.max_output_tokens)
        worst_usd = (cost_usd(entry, worst) or 0.0) * parts[name]
        made = TrialCalls(number * usual, number * most, worst_usd)
        other = calls.get(model := plan.registered[name])
        if other is not None:
            worst_usd = max(worst_usd, other.worst_usd)
            made = TrialCalls(made.usual + other.usual, made.most + other.most, worst_usd)
        calls[model] = made
    return calls


def _measured_usage(totals: CallTotals) -> Usage:
    """The tokens of an answer on average."""
    return Usage(
        input_tokens=round(totals.input_tokens / totals.measured),
        output_tokens=round(totals.output_tokens / totals.measured),
    )


def _per_call(plan: Plan, arm: Arm, entry: ModelEntry, facts: CallTotals) -> tuple[Usage, float]:
    """The tokens of a call and its latency in s, as measured or as listed in the registry."""
    if facts.measured:
        return _measured_usage(facts), facts.mean_latency_s or entry.typical_latency_s
    # English has about 4 bytes a token.
    prompt_tokens = len(typical_prompt(plan, arm).encode()) // 4
    usage = Usage(input_tokens=prompt_tokens, output_tokens=entry.typical_output_tokens)
    return usage, entry.typical_latency_s


def _limited_s(options: Options, calls: _Calls) -> float:
    """How long the limits stretch the calls, in s.

    Within a minute's window a call counts with its output cap until its reply is in, and with
    its actual tokens from then on.
    """
    rpm, tpm = options.rates(calls.entry)
    waiting = min(calls.latency_s / 60, 1.0)
    tokens = (calls.usage.input_tokens or 0) + (
        waiting * calls.entry.max_output_tokens + (1 - waiting) * (calls.usage.output_tokens or 0)
    )
    number = calls.number
    return max(60 * number / rpm if rpm else 0.0, 60 * number * tokens / tpm if tpm else 0.0)


def typical_prompt(plan: Plan, arm: Arm) -> str:
    """An arm's prompt in the middle of an approach."""
    scenario = arm.scenario
    world = World(scenario, CONDITIONS[plan.conditions[0]], TRACK)
    rest = (0.25,) * (scenario.plan_actions - scenario.executed_actions)
    return render_prompt(world.observe("left"), rest, variant=arm.variant, scenario=scenario)
