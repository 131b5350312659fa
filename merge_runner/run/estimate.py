"""What a sweep will take, before anything is sent."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from merge_runner.config import ModelEntry, driver_name
from merge_runner.llm.batch.terms import batch_terms
from merge_runner.llm.budget import Answers, TrialCalls, TrialCosts
from merge_runner.llm.cache import CachedCall
from merge_runner.llm.content_hashes import without_prompt
from merge_runner.llm.prices import cost_usd
from merge_runner.prompts.render import render_prompt
from merge_runner.records import Usage, is_scripted
from merge_runner.run.plan import Options, Plan, most_prompts, usual_prompts
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from merge_runner.study.crossing import Arm

# A reply's JSON around the prompt, and later prompts with longer histories and numbers.
PROMPT_MARGIN = 1.25


@dataclass(slots=True)
class CallTotals:
    """Sums over the answers that state their tokens and are the model's own, no mock model's.

    ``measured`` is their number; ``timed`` of them have a latency: a batch tells none.
    """

    measured: int = 0
    input_tokens: int = 0
    output_tokens: int = 0
    timed: int = 0
    latency_s: float = 0.0

    @property
    def mean(self) -> Usage:
        """The tokens of an answer on average."""
        return Usage(
            input_tokens=round(self.input_tokens / self.measured),
            output_tokens=round(self.output_tokens / self.measured),
        )


def call_totals(entries: Iterable[CachedCall]) -> dict[tuple[str, str, str, str], CallTotals]:
    """Return the totals by model, endpoint, path and the body without its prompt."""
    totals: defaultdict[tuple[str, str, str, str], CallTotals] = defaultdict(CallTotals)
    for entry in entries:
        sent, last = entry.request, entry.attempts[-1]
        each = totals[sent.model, sent.endpoint, sent.path, without_prompt(sent.body)]
        read, written = last.usage.input_tokens, last.usage.output_tokens
        own = sent.provider == "emulator" or not is_scripted(sent, last)
        if own and read is not None and written is not None:
            each.measured += 1
            each.input_tokens += read
            each.output_tokens += written
            each.timed += last.latency_s is not None
            each.latency_s += last.latency_s or 0.0
    return totals


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
    ``batch`` is what the same takes in batches, where the run is to use them.
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
    batch: BatchEstimate | None = None


@dataclass(frozen=True, slots=True)
class _Calls:
    """How many calls a model of the registry has yet to answer in one arm, and what one takes."""

    model: str
    entry: ModelEntry
    number: int
    usage: Usage
    latency_s: float

    @property
    def tokens(self) -> tuple[int, int]:
        """Those that one reads and writes."""
        return self.usage.input_tokens or 0, self.usage.output_tokens or 0


def estimate(
    plan: Plan,
    options: Options,
    *,
    trials: int,
    calls: Mapping[str, Mapping[str, float]],
    facts: Mapping[str, CallTotals],
) -> Estimate:
    """The estimate for the ``trials`` that a live run of a plan has yet to play.

    ``calls`` is roughly how many each model has yet to answer, by arm. ``facts`` is what the cache
    knows about each model's earlier answers to similar requests at its endpoint.
    """
    todo = [
        _calls(plan, arm, name, round(calls[label][name]), facts[name])
        for label, arm in plan.by_label().items()
        for name in arm.entries
    ]
    batch = None
    if options.batch:
        batch = BatchEstimate(
            cost_usd=_cost_usd(todo, batch=True),
            rounds=max((math.ceil(usual_prompts(arm)) for arm in plan.arms), default=0),
            most_rounds=max(map(most_prompts, plan.arms), default=0),
        )
    return Estimate(
        plan.driver,
        trials,
        calls=sum(each.number for each in todo),
        input_tokens=sum(each.number * each.tokens[0] for each in todo),
        output_tokens=sum(each.number * each.tokens[1] for each in todo),
        cost_usd=_cost_usd(todo),
        minutes=_minutes(options, trials, todo),
        free=all(entry.price == "free" for entry in plan.entries.values()),
        measured=tuple(
            driver_name(name, plan.endpoints[name]) for name in plan.entries if facts[name].measured
        ),
        batch=batch,
    )


def _calls(plan: Plan, arm: Arm, name: str, number: int, facts: CallTotals) -> _Calls:
    """Return the calls of a model in an arm, as measured or as listed in the registry."""
    entry = arm.entries[name]
    if facts.measured:
        usage = facts.mean
    else:
        # English has about 4 bytes a token.
        prompt_tokens = len(typical_prompt(plan, arm).encode()) // 4
        usage = Usage(input_tokens=prompt_tokens, output_tokens=entry.typical_output_tokens)
    latency_s = facts.latency_s / facts.timed if facts.timed else entry.typical_latency_s
    return _Calls(plan.registered[name], entry, number, usage, latency_s)


def _cost_usd(calls: Iterable[_Calls], *, batch: bool = False) -> float | None:
    """Return what calls cost together, to a cent; None where a price is unknown."""
    sum_usd = 0.0
    for each in calls:
        usd = cost_usd(each.entry, each.usage)
        if usd is None:
            return None
        sum_usd += each.number * usd * (_price_factor(each.entry) if batch else 1.0)
    return round(sum_usd, 2)


def _price_factor(entry: ModelEntry) -> float:
    """Return the part of its price that a model costs in batches."""
    terms = batch_terms(entry)
    return 1.0 if terms is None else terms.price_factor


def _minutes(options: Options, trials: int, calls: Sequence[_Calls]) -> float:
    """Return how long the slowest model takes, by its latency or by its limits."""
    at_once = min(options.connections, 2 * max(trials, 1))
    slowest_s = 0.0
    for model in {each.model for each in calls}:
        own = [each for each in calls if each.model == model]
        in_turn_s = math.ceil(sum(each.number for each in own) / at_once) * own[0].latency_s
        slowest_s = max(slowest_s, in_turn_s, sum(_limited_s(options, each) for each in own))
    return round(slowest_s / 60, 1)


def _limited_s(options: Options, calls: _Calls) -> float:
    """Return how long the limits stretch calls, in s.

    Within a minute's window a call counts with its output cap until its reply is in, and with
    its actual tokens from then on.
    """
    rpm, tpm = options.rates(calls.entry)
    waiting, (read, written) = min(calls.latency_s / 60, 1.0), calls.tokens
    tokens = read + waiting * calls.entry.max_output_tokens + (1 - waiting) * written
    number = calls.number
    return max(60 * number / rpm if rpm else 0.0, 60 * number * tokens / tpm if tpm else 0.0)


def trial_costs(plan: Plan, facts: Mapping[str, CallTotals], *, batch: bool = False) -> TrialCosts:
    """Return what the trials of a plan are expected to cost, in a ``batch`` run or not.

    ``facts`` is as for ``estimate``.
    """
    labels = {spec.order: spec.arm for spec in plan.trial_specs()}
    parts = {name: _price_factor(e) if batch else 1.0 for name, e in plan.entries.items()}
    calls = {arm.label: _trial_calls(plan, arm, parts) for arm in plan.arms}
    earlier: defaultdict[str, Answers] = defaultdict(Answers)
    for name, totals in facts.items():
        if totals.measured:
            answers, one_usd = (
                earlier[plan.registered[name]],
                cost_usd(plan.entries[name], totals.mean),
            )
            answers.number += totals.measured
            answers.usd += totals.measured * (one_usd or 0.0) * parts[name]
    return TrialCosts(lambda order: calls[labels[order]], earlier)


def _trial_calls(plan: Plan, arm: Arm, parts: Mapping[str, float]) -> dict[str, TrialCalls]:
    """Return the calls of each model in a trial: at most up to the timeout, all at their caps.

    A model that drives on both sides with different parameters counts with the dearer ones. Each
    costs so many ``parts`` of its price.
    """
    # No tokeniser makes more tokens than bytes.
    read = int(len(typical_prompt(plan, arm).encode()) * PROMPT_MARGIN)
    calls: defaultdict[str, TrialCalls] = defaultdict(lambda: TrialCalls(0, 0, 0.0))
    for name in arm.asked.values():
        if (entry := arm.entries.get(name)) is not None:
            worst = Usage(input_tokens=read, output_tokens=entry.max_output_tokens)
            worst_usd = (cost_usd(entry, worst) or 0.0) * parts[name]
            other = calls[plan.registered[name]]
            calls[plan.registered[name]] = TrialCalls(
                other.usual + usual_prompts(arm),
                other.most + most_prompts(arm),
                max(other.worst_usd, worst_usd),
            )
    return dict(calls)


def typical_prompt(plan: Plan, arm: Arm) -> str:
    """Return an arm's prompt in the middle of an approach."""
    scenario = arm.scenario
    world = World(scenario, CONDITIONS[plan.conditions[0]], TRACK)
    rest = (0.25,) * (scenario.plan_actions - scenario.executed_actions)
    return render_prompt(world.observe("left"), rest, variant=arm.variant, scenario=scenario)
