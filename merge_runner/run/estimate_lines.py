"""The estimate of a run, and the prompts that it will ask, as text."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from merge_runner.prompts.blocks import decomposed
from merge_runner.records import SIDES
from merge_runner.run.estimate import Estimate, prompts_of, usd_text
from merge_runner.run.plan import Plan
from merge_runner.text_safety import first_of


def prompt_lines(plan: Plan) -> Iterator[str]:
    """Yield the blocks, in order, of each prompt with a text of the study's factors."""
    for name, prompt in plan.parts.prompts.items():
        if decomposed(name)[1]:
            yield f"prompt  {name}: {', '.join(prompt.blocks)}"


def shown_prompts(plan: Plan) -> list[dict[str, Any]]:
    """Return the text of each prompt of a plan, and the drivers that read it."""
    readers: dict[tuple[str, str], list[str]] = {}
    for arm in plan.arms:
        for name, text in prompts_of(plan, arm).items():
            sides = [side for side, read in arm.read_prompts.items() if read == name]
            drivers = "both drivers" if len(sides) == len(SIDES) else f"the {sides[0]} driver"
            readers.setdefault((name, text), []).append(f"{drivers} of {arm.label}")
    return [
        {"prompt": name, "read_by": drivers, "text": text}
        for (name, text), drivers in readers.items()
    ]


def shown_prompt_lines(plan: Plan) -> Iterator[str]:
    """Yield each prompt of a plan as text, with the numbers of one situation."""
    for prompt in shown_prompts(plan):
        readers = "; ".join(first_of(prompt["read_by"], "others"))
        yield f"\nprompt  {prompt['prompt']}, read by {readers}:\n{prompt['text']}"


def estimate_lines(expected: Estimate) -> Iterator[str]:
    """Yield the lines of an estimate."""
    measured = ", as measured before" if expected.measured else ""
    tokens = f"about {expected.input_tokens} in, {expected.output_tokens} out{measured}"
    if not expected.trials:
        if replayed := expected.planned - expected.stored:
            stored = f"{expected.stored} trials are stored"
            yield f"Nothing left to ask: {stored}, and {replayed} are played from recorded replies."
        else:
            yield f"Nothing left to play: all {expected.planned} trials are stored."
        return
    yield f"driver  {expected.driver}"
    yield f"trials  {expected.trials} to play"
    yield f"calls   about {expected.calls} not stored yet"
    yield f"tokens  {tokens}"
    if caps := expected.output_caps:
        same = len({*caps.values()}) == 1
        most = [f"{n}{'' if same else f' with {model}'}" for model, n in caps.items()]
        shown = ", ".join(most[:1] if same else most)
        yield f"        a reply is cut off at {shown} output tokens (max_output_tokens)"
    cost, time = usd_text(expected.cost_usd), f"{expected.minutes} minutes"
    if expected.rounds:
        cost += f" in batches; {usd_text(expected.singly_usd)} and {time} by normal requests"
        time = (
            f"{expected.rounds} rounds; each takes as long as its slowest batch: minutes, hours, "
            "two days at most"
        )
    yield f"cost    {cost}"
    if len(expected.usd_by_model) > 1:
        for model, usd in expected.usd_by_model.items():
            yield f"        {model}: {usd_text(usd)}"
    left_usd, cost_usd = expected.left_usd, expected.cost_usd
    if left_usd is not None and cost_usd and left_usd < cost_usd:
        yield (
            f"        stops at {left_usd:.2f} USD, about {100 * left_usd / cost_usd:.0f} % of it: "
            f"what {expected.cap_source} leaves"
        )
    yield f"time    about {time}{'' if expected.rounds else ' for these calls'}"
