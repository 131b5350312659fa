"""What a reply costs: by the registry's table, or by the figures of an entry."""

import pytest

from merge_runner.config import ModelEntry, Price
from merge_runner.llm.ledger import cost_usd, is_underpriced
from merge_runner.records import Usage

PRICE = Price(input=2.0, cached_input=0.5, output=8.0, source="contract")


def price(**changes):
    return PRICE.model_copy(update=changes)


def entry(provider="openai", model="o3-2025-04-16", **changes):
    given = {"format": "openai-chat", "max_output_tokens": 10}
    return ModelEntry(provider=provider, id=model, **{**given, **changes})


# USD per million tokens: input, cached input, output.
@pytest.mark.parametrize(
    ("provider", "model", "rates"),
    [
        ("openai", "o3-2025-04-16", (2.00, 0.50, 8.00)),
        ("openai", "o3", (2.00, 0.50, 8.00)),
        ("openai", "gpt-6-sol", (2.00, 0.20, 10.00)),
        ("gemini", "gemini-2.5-pro", (1.25, 0.125, 10.00)),
        ("gemini", "gemini-3.8-flash", (0.75, 0.075, 3.75)),
        ("anthropic", "claude-sonnet-4-6", (3.00, 0.30, 15.00)),
        ("anthropic", "claude-sonnet-5-5", (2.00, 0.10, 10.00)),
    ],
)
def test_the_table_of_prices_knows_the_models_of_the_registry(provider, model, rates):
    priced = entry(provider, model)
    new, cached, output = (rate / 1e6 for rate in rates)
    usage = Usage(1000, 500, 1000, 640)
    assert cost_usd(priced, usage) == pytest.approx(500 * new + 500 * cached + 1000 * output)
    assert cost_usd(priced, Usage(1000, None, 0)) == pytest.approx(1000 * new)


@pytest.mark.parametrize(
    ("own", "usage", "usd"),
    [
        (PRICE, Usage(1000, 400, 100), 600 * 2e-6 + 400 * 0.5e-6 + 100 * 8e-6),
        (price(output=1.0), Usage(0, None, 1_000_000), 1.0),
        # Without a price of its own cached input costs as any other.
        (price(cached_input=None), Usage(1000, 400, 0), 0.002),
        (price(cached_input=0.0), Usage(1000, 400, 0), 0.0012),
        ("free", Usage(), 0.0),
        ("free", Usage(10**9, 0, 10**9), 0.0),
        # A server that counts wrongly neither ends a sweep nor makes it cheap.
        (PRICE, Usage(100, 500, 10), 100 * 2e-6 + 10 * 8e-6),
        # What is not told has no cost.
        (PRICE, Usage(), None),
        (PRICE, Usage(1000), None),
        (PRICE, Usage(output_tokens=1000), None),
    ],
    ids=str,
)
def test_explicit_figures_are_believed_before_the_table(own, usage, usd):
    cost = cost_usd(entry(price=own), usage)
    assert cost == (None if usd is None else pytest.approx(usd))


@pytest.mark.parametrize("usage", [Usage(), Usage(1000), Usage(output_tokens=1000)], ids=str)
def test_tokens_that_are_not_told_have_no_cost(usage):
    assert cost_usd(entry(), usage) is None


@pytest.mark.parametrize("model", [("openai", "no-such-model"), ("local", "anything")])
def test_a_price_that_nobody_knows_is_none(model):
    assert cost_usd(entry(*model), Usage(1000, 0, 1000)) is None


@pytest.mark.parametrize(
    ("model", "tier", "usd", "underpriced"),
    [
        # The table of genai-prices knows OpenAI's tiers; explicit figures have factors.
        (entry(), None, 0.010, False),
        (entry(), "priority", 0.0175, False),
        (entry(), "flex", 0.005, False),
        (entry(), "default", 0.010, False),
        (entry(price=price(tiers={"priority": 2.0})), "priority", 0.020, False),
        (entry(price=price(tiers={"priority": 2.0})), "flex", 0.010, False),
        (entry(price=PRICE), "priority", 0.010, True),
        (entry(price=PRICE), "default", 0.010, False),
        (entry(price=PRICE), None, 0.010, False),
        (entry("gemini", "gemini-3.8-flash"), "priority", 0.0045, True),
        (entry(price="free"), "priority", 0.0, False),
        (entry("local", "anything"), "priority", None, False),  # that it is unknown is said
    ],
)
def test_a_service_tier_is_priced_where_the_registry_knows_it(model, tier, usd, underpriced):
    cost = cost_usd(model, Usage(1000, 0, 1000), tier)
    assert cost == (None if usd is None else pytest.approx(usd))
    assert is_underpriced(model, tier) == underpriced
