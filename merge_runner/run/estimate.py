"""What a sweep will take, before anything is sent."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from statistics import fmean

from merge_runner.config import ModelEntry, driver_name
from merge_runner.llm.batch.providers import batch_terms
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.ledger import cost_usd
from merge_runner.prompts.blocks import render_prompt
from merge_runner.records import Usage, canonical_json, is_scripted, without_prompt
from merge_runner.run.plan import Options, Plan, most_prompts, usual_prompts
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from merge_runner.study.crossing import Arm

# A reply's JSON around the prompt, and later prompts with longer histories and numbers.
PROMPT_MARGIN = 1.25
# Trials that turn out longer, and attempts that are charged but bring no answer.
TRIAL_MARGIN = 1.5


def earlier_answers(plan: Plan, cache: ResponseCache) -> dict[str, Usage | None]:
    """Return the mean tokens of the models' own answers to requests like those of a plan.

    None: the endpoint has answered, but no such request; a model whose endpoint has never answered
    is missing. No mock model's answers count, and none that leaves its tokens out.
    """
    like = {}
    for name, entry in plan.entries.items():
        sent = FORMATS[entry.format].request(entry, "")
        like[name] = entry.id, plan.endpoints[name], sent.path, canonical_json(sent.body)
    answers: defaultdict[str, list[tuple[int, int]]] = defaultdict(list)
    for each in cache.entries():
        request, last = each.request, each.attempts[-1]
        asked = request.model, request.endpoint, request.path, without_prompt(request.body)
        own = request.provider == "emulator" or not is_scripted(request, last)
        read, written = last.usage.input_tokens, last.usage.output_tokens
        for name in (name for name, wanted in like.items() if wanted[:2] == asked[:2]):
            tokens = answers[name]
            if like[name] == asked and own and read is not None and written is not None:
                tokens.append((read, written))
    return {name: _mean(tokens) for name, tokens in answers.items()}


def _mean(tokens: Collection[tuple[int, int]]) -> Usage | None:
    if not tokens:
        return None
    read, written = (round(fmean(column)) for column in zip(*tokens, strict=True))
    return Usage(input_tokens=read, output_tokens=written)


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

    ``measured`` lists the drivers whose tokens are those of their earlier answers. ``batch`` is
    what the same takes in batches, where the run is to use them.
    """

    driver: str
    trials: int
    calls: int
    input_tokens: int
    output_tokens: int
    cost_usd: float | None
    minutes: float
    free: bool
    measured: list[str]
    batch: BatchEstimate | None = None


@dataclass(frozen=True, slots=True)
class _Calls:
    """The calls of a model in an arm: what each takes, as measured or as listed in the registry.

    In batches a model costs ``price_factor`` of its price.
    """

    model: str
    entry: ModelEntry
    number: int
    usage: Usage
    price_factor: float

    @classmethod
    def of(
        cls, plan: Plan, arm: Arm, name: str, number: int, facts: Mapping[str, Usage | None]
    ) -> _Calls:
        """Return so many calls of a model."""
        entry = arm.entries[name]
        usage = facts.get(name) or Usage(
            # English has about 4 bytes a token.
            input_tokens=len(typical_prompt(plan, arm).encode()) // 4,
            output_tokens=entry.typical_output_tokens,
        )
        terms = batch_terms(entry)
        factor = terms.price_factor if terms else 1.0
        return cls(plan.registered[name], entry, number, usage, factor)

    def cost_usd(self, *, batch: bool = False) -> float | None:
        """Return what they cost together; None where the price is unknown."""
        usd = cost_usd(self.entry, self.usage)
        return usd and usd * self.number * (self.price_factor if batch else 1.0)

    def limited_s(self, options: Options) -> float:
        """Return how long the limits stretch the calls, in s.

        Within a minute's window a call counts with its output cap until its reply is in, and with
        its actual tokens from then on.
        """
        rpm, tpm = options.rates(self.entry)
        waiting = min(self.entry.typical_latency_s / 60, 1.0)
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
    facts: Mapping[str, Usage | None],
) -> Estimate:
    """Return the estimate for the ``trials`` that a live run of a plan has yet to play.

    ``calls`` is roughly how many each model has yet to answer, by arm. ``facts`` is what the cache
    knows about each model's earlier answers to similar requests at its endpoint.
    """
    todo = [
        _Calls.of(plan, arm, name, round(calls[label][name]), facts)
        for label, arm in plan.by_label().items()
        for name in arm.entries
    ]

    def together_usd(*, batch: bool = False) -> float | None:
        costs = [each.cost_usd(batch=batch) for each in todo]
        return None if None in costs else round(sum(filter(None, costs)), 2)

    batch = None
    if options.batch:
        batch = BatchEstimate(
            together_usd(batch=True),
            rounds=max((math.ceil(usual_prompts(arm)) for arm in plan.arms), default=0),
            most_rounds=max(map(most_prompts, plan.arms), default=0),
        )
    at_once, minutes = min(options.connections, 2 * max(trials, 1)), 0.0
    for model in {each.model for each in todo}:
        own = [each for each in todo if each.model == model]
        in_turn_s = (
            math.ceil(sum(each.number for each in own) / at_once) * own[0].entry.typical_latency_s
        )
        limited_s = sum(each.limited_s(options) for each in own)
        minutes = max(minutes, round(max(in_turn_s, limited_s) / 60, 1))
    return Estimate(
        plan.driver,
        trials,
        calls=sum(each.number for each in todo),
        input_tokens=sum(each.number * (each.usage.input_tokens or 0) for each in todo),
        output_tokens=sum(each.number * (each.usage.output_tokens or 0) for each in todo),
        cost_usd=together_usd(),
        minutes=minutes,
        free=all(entry.price == "free" for entry in plan.entries.values()),
        measured=[driver_name(n, plan.endpoints[n]) for n in plan.entries if facts.get(n)],
        batch=batch,
    )


def trial_costs(
    plan: Plan, facts: Mapping[str, Usage | None], *, batch: bool = False
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
            usual = _Calls.of(plan, arm, name, 1, facts)
            most = Usage(input_tokens=read, output_tokens=usual.entry.max_output_tokens)
            usual_usd, worst_usd = (
                each.cost_usd(batch=batch) or 0.0 for each in (usual, replace(usual, usage=most))
            )
            by_arm[arm.label] += TRIAL_MARGIN * usual_prompts(arm) * usual_usd + worst_usd
    return {spec.order: by_arm[spec.arm] for spec in plan.trial_specs()}.__getitem__


def typical_prompt(plan: Plan, arm: Arm) -> str:
    """Return an arm's prompt in the middle of an approach."""
    scenario = arm.scenario
    world = World(scenario, CONDITIONS[plan.conditions[0]], TRACK)
    rest = (0.25,) * (scenario.plan_actions - scenario.executed_actions)
    return render_prompt(world.observe("left"), rest, variant=arm.variant, scenario=scenario)
