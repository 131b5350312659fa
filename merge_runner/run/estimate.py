"""The estimate of a sweep: calls, tokens, cost and time, before anything is sent."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import chain
from statistics import median

from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.prices import BYTES_A_TOKEN, cost_usd
from merge_runner.llm.templates import AnswerCounts, answer_counts, count_by_template
from merge_runner.prompts.blocks import render_prompt
from merge_runner.providers import ModelEntry
from merge_runner.records import Usage, canonical_json
from merge_runner.run.options import Options
from merge_runner.run.plan import Plan, usual_prompts
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from merge_runner.study.arms import Arm

# A request's JSON around the prompt (1.10 of the baseline's), and prompts with longer numbers.
PROMPT_MARGIN = 1.25
# Trials that turn out longer, and attempts that are charged but bring no answer.
TRIAL_MARGIN = 1.5
# Latencies come from each model's last ENOUGH calls among the MOST_READ newest of all.
ENOUGH, MOST_READ = 200, 10_000
NONE_KNOWN: Mapping[str, float] = {}


def earlier_answers(plan: Plan, cache: ResponseCache) -> dict[str, Usage | None]:
    """Return the mean tokens of each model's answers to requests of the plan's templates.

    None: its endpoint has answered other requests only. A model whose endpoint has never answered
    is left out. Answers of mock models, and those that report no tokens, do not count.
    """
    requests = _request_templates(plan)
    sums: dict[str, AnswerCounts] = {}
    for template, answers in chain.from_iterable(c.items() for c in answer_counts(cache)):
        request = template.model, template.endpoint, template.path, template.body
        for name in (name for name, known in requests.items() if known[:2] == request[:2]):
            counts = template.genuine and requests[name] == request
            sums[name] = sums.get(name, AnswerCounts()).plus(answers if counts else AnswerCounts())
    usages: dict[str, Usage | None] = dict.fromkeys(sums)
    for name, (_, measured, input_tokens, output_tokens) in sums.items():
        if measured:
            read, written = round(input_tokens / measured), round(output_tokens / measured)
            usages[name] = Usage(input_tokens=read, output_tokens=written)
    return usages


def usual_latencies_s(
    plan: Plan, cache: ResponseCache, facts: Mapping[str, Usage | None]
) -> dict[str, float]:
    """Return, by model, the median latency of its newest answers, if ``facts`` has its tokens."""
    requests = _request_templates(plan)
    latencies: dict[str, list[float]] = {name: [] for name, usage in facts.items() if usage}
    for call in cache.newest(MOST_READ) if latencies else ():
        last = call.attempts[-1]
        (template,) = count_by_template([(call.request, last)])
        request = template.model, template.endpoint, template.path, template.body
        if template.genuine and last.latency_s is not None:
            for name in (name for name in latencies if requests[name] == request):
                latencies[name].append(last.latency_s)
        if all(len(latencies_s) >= ENOUGH for latencies_s in latencies.values()):
            break
    return {name: median(latencies_s) for name, latencies_s in latencies.items() if latencies_s}


def _request_templates(plan: Plan) -> dict[str, tuple[str, str, str, str]]:
    """Return by model the id, endpoint, path and body of its requests, all but the prompt."""
    requests = {}
    for name, entry in plan.entries.items():
        sent = plan.parts.formats[entry.format].request(entry, "")
        requests[name] = entry.id, plan.endpoints[name], sent.path, canonical_json(sent.body)
    return requests


@dataclass(frozen=True, slots=True)
class Estimate:
    """Estimate of a live run: drivers, trials, calls, tokens, USD (None: unknown price), minutes.

    It is ``measured`` if the tokens per call come from earlier replies. ``singly_usd`` is the
    cost of normal requests; batches cost less, and take ``rounds`` in place of minutes.
    ``usd_by_model`` has the models of the registry. ``planned`` counts all trials, also the
    ``stored`` ones. ``left_usd`` is left under the cap that ``cap_source`` sets; None: there is no
    cap. ``output_caps`` has the maximum tokens of a reply by model.
    """

    driver: str
    trials: int
    calls: int
    input_tokens: int
    output_tokens: int
    cost_usd: float | None
    singly_usd: float | None
    minutes: float
    rounds: int
    free: bool
    measured: bool
    planned: int = 0
    stored: int = 0
    usd_by_model: dict[str, float | None] = field(default_factory=dict)
    left_usd: float | None = None
    cap_source: str | None = None
    output_caps: dict[str, int] = field(default_factory=dict)


def estimate(
    plan: Plan,
    options: Options,
    *,
    trials: int,
    calls: Mapping[str, Mapping[str, float]],
    facts: Mapping[str, Usage | None],
    latencies_s: Mapping[str, float] = NONE_KNOWN,
    stored: int = 0,
) -> Estimate:
    """Return the estimate for the ``trials`` that a live run of a plan has yet to ask for.

    ``calls`` has by arm the approximate number of calls that each model has yet to answer.
    ``facts`` are the mean tokens of each model's earlier answers to similar requests at its
    endpoint, and ``latencies_s`` their median latencies, in place of the registry's.
    """
    all_calls = read = written = 0
    singly_usd = 0.0
    by_model, busy_s = defaultdict[str, float](float), defaultdict[str, float](float)
    caps = defaultdict[str, int](int)
    at_once = min(options.connections, 2 * max(trials, 1))
    for label, arm in plan.by_label().items():
        for name, entry in arm.entries.items():
            number, usage = round(calls[label][name]), _usage(plan, arm, name, facts)
            price = cost_usd(entry, usage)
            call_usd = math.nan if price is None else price
            all_calls += number
            model = plan.registered[name]
            caps[model] = max(caps[model], entry.max_output_tokens)
            read += number * (usage.input_tokens or 0)
            written += number * (usage.output_tokens or 0)
            singly_usd += number * call_usd
            by_model[model] += number * call_usd * _price_factor(entry, options.batch)
            # An account's limits hold for a model, with whatever parameters it is asked.
            latency_s = latencies_s.get(name, entry.typical_latency_s)
            call_s = max(latency_s / at_once, _limited_s(options, entry, usage, latency_s))
            busy_s[model] += number * call_s
    rounds = max((math.ceil(usual_prompts(arm)) for arm in plan.arms), default=0)
    return Estimate(
        plan.driver,
        trials,
        calls=all_calls,
        input_tokens=read,
        output_tokens=written,
        cost_usd=_cents(sum(by_model.values(), 0.0)),
        singly_usd=_cents(singly_usd),
        minutes=round(max(busy_s.values(), default=0.0) / 60, 1),
        rounds=rounds if options.batch else 0,
        free=plan.is_free,
        measured=any(map(facts.get, plan.entries)),
        planned=plan.trials,
        stored=stored,
        usd_by_model={model: _cents(model_usd) for model, model_usd in by_model.items()},
        output_caps=dict(caps),
    )


def _cents(usd: float) -> float | None:
    """Round an amount in USD to the cent; None where it is NaN, as of an unknown price."""
    return None if math.isnan(usd) else round(usd, 2)


def trial_costs(
    plan: Plan, facts: Mapping[str, Usage | None], *, batch: bool
) -> Callable[[int], float]:
    """Return a function from a trial's order to its expected cost in USD, perhaps in batches.

    It is the cost of the usual calls, with a margin, and one worst case, which the last call must
    be able to reserve. ``facts`` is as for ``estimate``.
    """
    by_arm: defaultdict[str, float] = defaultdict(float)
    for arm in plan.arms:
        read = _request_bytes(plan, arm)  # no tokeniser makes more tokens than bytes
        for name in filter(arm.entries.get, arm.full_names.values()):
            entry = arm.entries[name]
            usual_usd = cost_usd(entry, _usage(plan, arm, name, facts)) or 0.0
            worst = Usage(input_tokens=read, output_tokens=entry.max_output_tokens)
            usd = TRIAL_MARGIN * usual_prompts(arm) * usual_usd + (cost_usd(entry, worst) or 0.0)
            by_arm[arm.label] += usd * _price_factor(entry, batch)
    return {spec.order: by_arm[spec.arm] for spec in plan.trial_specs()}.__getitem__


def _request_bytes(plan: Plan, arm: Arm) -> int:
    return int(len(typical_prompt(plan, arm).encode()) * PROMPT_MARGIN)


def most_shares(plan: Plan, options: Options) -> int:
    """Return the number of shares of the rate limits that hold a request of any model each."""
    shares = [math.inf]
    for arm in plan.arms:
        read = _request_bytes(plan, arm) // BYTES_A_TOKEN
        for entry in arm.entries.values():
            rpm, tpm = options.rates(entry)
            shares += [rpm or math.inf, (tpm or math.inf) // (read + entry.max_output_tokens)]
    return int(max(1, min(*shares, options.in_flight)))


def _usage(plan: Plan, arm: Arm, name: str, facts: Mapping[str, Usage | None]) -> Usage:
    """Return the tokens of a call, as measured or as listed in the registry."""
    read = len(typical_prompt(plan, arm).encode()) // BYTES_A_TOKEN
    entry = arm.entries[name]
    written = min(entry.typical_output_tokens, entry.max_output_tokens)
    return facts.get(name) or Usage(input_tokens=read, output_tokens=written)


def _price_factor(entry: ModelEntry, batch: bool) -> float:
    if not batch:
        return 1.0
    from merge_runner.llm.batch.providers import batch_terms  # here, since few runs need it

    terms = batch_terms(entry)
    return terms.price_factor if terms else 1.0


def _limited_s(options: Options, entry: ModelEntry, usage: Usage, latency_s: float) -> float:
    """Return the shortest time in s between two calls that the rate limits allow.

    In the minute's window a call counts with its output cap until its reply arrives, and then with
    its actual tokens.
    """
    rpm, tpm = options.rates(entry)
    waiting = min(latency_s / 60, 1.0)
    written = waiting * entry.max_output_tokens + (1 - waiting) * (usage.output_tokens or 0)
    tokens = (usage.input_tokens or 0) + written
    return max(60 / (rpm or math.inf), 60 * tokens / (tpm or math.inf))


def typical_prompt(plan: Plan, arm: Arm) -> str:
    """Return an arm's prompt in the middle of an approach, the longest; empty for programs."""
    return max(prompts_of(plan, arm).values(), key=len, default="")


def prompts_of(plan: Plan, arm: Arm) -> dict[str, str]:
    """Return, by prompt, the text that language models of an arm read in the middle of an approach.

    The texts have the numbers of the left driver in the plan's first condition.
    """
    scenario = arm.scenario
    world = World(scenario, plan.parts.conditions[plan.conditions[0]], TRACK)
    rest = (0.25,) * (scenario.plan_actions - scenario.executed_actions)
    seen = world.observe("left")
    return {
        name: render_prompt(seen, rest, prompt=plan.parts.prompts[name], scenario=scenario)
        for name in sorted({*arm.read_prompts.values()})
    }


def usd_text(cost_usd: float | None) -> str:
    """Return an amount as text, such as ``about 1.20 USD``."""
    return "an unknown price" if cost_usd is None else f"about {cost_usd:.2f} USD"
