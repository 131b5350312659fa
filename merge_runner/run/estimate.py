"""What a sweep will take, before anything is sent."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from merge_runner.config import ModelEntry, driver_name
from merge_runner.llm.batch.providers import batch_terms
from merge_runner.llm.cache import CachedCall
from merge_runner.llm.content_hashes import without_prompt
from merge_runner.llm.prices import cost_usd
from merge_runner.prompts.blocks import render_prompt
from merge_runner.records import Usage, is_scripted
from merge_runner.run.plan import Options, Plan, most_prompts, usual_prompts
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from merge_runner.study.crossing import Arm

# A reply's JSON around the prompt, and later prompts with longer histories and numbers.
PROMPT_MARGIN = 1.25
# Trials that turn out longer, and attempts that are charged but bring no answer.
TRIAL_MARGIN = 1.5


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
    def mean(self) -> Usage | None:
        """The tokens of an answer on average; None before any is measured."""
        sums = (self.input_tokens, self.output_tokens)
        read, written = (round(tokens / max(1, self.measured)) for tokens in sums)
        return Usage(input_tokens=read, output_tokens=written) if self.measured else None


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
    """The calls of a model that one arm lacks, each with its tokens and its latency in s."""

    model: str
    entry: ModelEntry
    number: int
    usage: Usage
    latency_s: float

    def limited_s(self, options: Options) -> float:
        """Return how long the limits stretch the calls, in s.

        Within a minute's window a call counts with its output cap until its reply is in, and with
        its actual tokens from then on.
        """
        rpm, tpm = options.rates(self.entry)
        waiting = min(self.latency_s / 60, 1.0)
        written = waiting * self.entry.max_output_tokens
        written += (1 - waiting) * (self.usage.output_tokens or 0)
        tokens = (self.usage.input_tokens or 0) + written
        return max(
            60 * self.number / (rpm or math.inf), 60 * self.number * tokens / (tpm or math.inf)
        )


def estimate(
    plan: Plan,
    options: Options,
    *,
    trials: int,
    calls: Mapping[str, Mapping[str, float]],
    facts: Mapping[str, CallTotals],
) -> Estimate:
    """Return the estimate for the ``trials`` that a live run of a plan has yet to play.

    ``calls`` is roughly how many each model has yet to answer, by arm. ``facts`` is what the cache
    knows about each model's earlier answers to similar requests at its endpoint.
    """
    todo = [
        _calls(plan, arm, name, round(calls[label][name]), facts)
        for label, arm in plan.by_label().items()
        for name in arm.entries
    ]
    batch = None
    if options.batch:
        batch = BatchEstimate(
            _cost_usd(todo, batch=True),
            rounds=max((math.ceil(usual_prompts(arm)) for arm in plan.arms), default=0),
            most_rounds=max(map(most_prompts, plan.arms), default=0),
        )
    at_once, minutes = min(options.connections, 2 * max(trials, 1)), 0.0
    for model in {each.model for each in todo}:
        own = [each for each in todo if each.model == model]
        in_turn_s = math.ceil(sum(each.number for each in own) / at_once) * own[0].latency_s
        limited_s = sum(each.limited_s(options) for each in own)
        minutes = max(minutes, round(max(in_turn_s, limited_s) / 60, 1))
    return Estimate(
        plan.driver,
        trials,
        calls=sum(each.number for each in todo),
        input_tokens=sum(each.number * (each.usage.input_tokens or 0) for each in todo),
        output_tokens=sum(each.number * (each.usage.output_tokens or 0) for each in todo),
        cost_usd=_cost_usd(todo),
        minutes=minutes,
        free=all(entry.price == "free" for entry in plan.entries.values()),
        measured=tuple(
            driver_name(name, plan.endpoints[name])
            for name in plan.entries
            if name in facts and facts[name].measured
        ),
        batch=batch,
    )


def _calls(plan: Plan, arm: Arm, name: str, number: int, facts: Mapping[str, CallTotals]) -> _Calls:
    """Return the calls of a model in an arm, as measured or as listed in the registry."""
    entry, known = arm.entries[name], facts.get(name, CallTotals())
    usage = known.mean or Usage(
        # English has about 4 bytes a token.
        input_tokens=len(typical_prompt(plan, arm).encode()) // 4,
        output_tokens=entry.typical_output_tokens,
    )
    latency_s = known.latency_s / known.timed if known.timed else entry.typical_latency_s
    return _Calls(plan.registered[name], entry, number, usage, latency_s)


def _cost_usd(calls: Iterable[_Calls], *, batch: bool = False) -> float | None:
    """Return what calls cost together, to a cent; None where a price is unknown."""
    sum_usd = 0.0
    for each in calls:
        usd = cost_usd(each.entry, each.usage)
        if usd is None:
            return None
        sum_usd += each.number * usd * _part(each.entry, batch=batch)
    return round(sum_usd, 2)


def _part(entry: ModelEntry, *, batch: bool) -> float:
    """Return the part of its price that a model costs, which is less than 1 in batches."""
    terms = batch_terms(entry) if batch else None
    return 1.0 if terms is None else terms.price_factor


def trial_costs(
    plan: Plan, facts: Mapping[str, CallTotals], *, batch: bool = False
) -> Callable[[int], float]:
    """Return what tells by a trial's order the USD that it is expected to cost, perhaps in batches.

    They are its usual calls, with a margin, and one worst case, which the last call must be able to
    reserve. ``facts`` is as for ``estimate``.
    """
    by_arm: defaultdict[str, float] = defaultdict(float)
    for arm in plan.arms:
        # No tokeniser makes more tokens than bytes.
        read = int(len(typical_prompt(plan, arm).encode()) * PROMPT_MARGIN)
        for name in filter(arm.entries.get, arm.asked.values()):
            entry, calls = arm.entries[name], _calls(plan, arm, name, 1, facts)
            worst = Usage(input_tokens=read, output_tokens=entry.max_output_tokens)
            usual_usd, worst_usd = (cost_usd(entry, each) or 0.0 for each in (calls.usage, worst))
            usd = TRIAL_MARGIN * usual_prompts(arm) * usual_usd + worst_usd
            by_arm[arm.label] += usd * _part(entry, batch=batch)
    return {spec.order: by_arm[spec.arm] for spec in plan.trial_specs()}.__getitem__


def typical_prompt(plan: Plan, arm: Arm) -> str:
    """Return an arm's prompt in the middle of an approach."""
    scenario = arm.scenario
    world = World(scenario, CONDITIONS[plan.conditions[0]], TRACK)
    rest = (0.25,) * (scenario.plan_actions - scenario.executed_actions)
    return render_prompt(world.observe("left"), rest, variant=arm.variant, scenario=scenario)
