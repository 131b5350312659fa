"""What a reply costs: by the registry's table, or by the figures of an entry."""

import pytest

from merge_runner.llm.prices import cost_usd, underpriced_tiers
from merge_runner.providers import ModelEntry, Price
from merge_runner.records import Usage
from tests.support.cases import cases, table

PRICE = Price(input=2.0, cached_input=0.5, output=8.0, source="contract")


def entry(provider="openai", model="o3-2025-04-16", **changes):
    given = {"format": "openai-chat", "max_output_tokens": 10}
    return ModelEntry(provider=provider, id=model, **{**given, **changes})


def priced(changes):
    """The price of a case."""
    if changes == "free":
        return changes
    told = {name: None if value == "none" else value for name, value in changes.items()}
    return PRICE.model_copy(update=told)


def is_usd(case):
    return pytest.approx(case["usd"]) if "usd" in case else None


@pytest.mark.parametrize(("name", "rates"), table("prices", "rates").items())
def test_the_table_of_prices_knows_the_models_of_the_registry(name, rates):
    model = entry(*name.split())
    new, cached, output = (rate / 1e6 for rate in rates)
    usage = Usage(1000, 500, 1000, 640)
    assert cost_usd(model, usage) == pytest.approx(500 * new + 500 * cached + 1000 * output)
    assert cost_usd(model, Usage(1000, None, 0)) == pytest.approx(1000 * new)


@pytest.mark.parametrize("case", cases("prices", "own"))
def test_explicit_figures_are_believed_before_the_table(case):
    usage = Usage(*(None if count == -1 else count for count in case["usage"]))
    assert cost_usd(entry(price=priced(case.get("price", {}))), usage) == is_usd(case)


def test_tokens_that_are_not_told_and_a_price_that_nobody_knows_have_no_cost():
    for usage in (Usage(), Usage(1000), Usage(output_tokens=1000)):
        assert cost_usd(entry(), usage) is None
    for model in (("openai", "no-such-model"), ("local", "anything")):
        assert cost_usd(entry(*model), Usage(1000, 0, 1000)) is None


@pytest.mark.parametrize("case", cases("prices", "tiers"))
def test_a_service_tier_is_priced_where_the_registry_knows_it(case):
    own = {"price": priced(case["price"])} if "price" in case else {}
    model = entry(*case.get("model", ()), **own)
    assert cost_usd(model, Usage(1000, 0, 1000), case.get("tier")) == is_usd(case)
    assert (case.get("tier") in underpriced_tiers(model)) == case.get("underpriced", False)
