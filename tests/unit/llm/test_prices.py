import pytest

from merge_runner.config import ModelEntry, Price
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.ledger import cost_usd, is_underpriced
from merge_runner.records import Usage

PRICE = Price(input=2.0, cached_input=0.5, output=8.0, source="contract")


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


def test_o3_with_half_the_input_cached():
    usage = Usage(input_tokens=1000, cached_input_tokens=500, output_tokens=1000)
    assert cost_usd(entry(), usage) == pytest.approx(0.001 + 0.00025 + 0.008)


def test_thoughts_of_gemini_are_paid_for():
    reading = FORMATS["gemini"].read(
        {
            "usageMetadata": {
                "promptTokenCount": 100,
                "candidatesTokenCount": 260,
                "thoughtsTokenCount": 640,
            }
        }
    )
    priced = entry("gemini", "gemini-2.5-pro", format="gemini")
    assert cost_usd(priced, reading.usage) == pytest.approx((100 * 1.25 + 900 * 10) / 1e6)


def test_explicit_figures_are_believed():
    priced = entry("local", "anything", price=PRICE)
    assert cost_usd(priced, Usage(1000, 400, 100)) == (600 * 2.0 + 400 * 0.5 + 100 * 8.0) / 1e6


def test_explicit_figures_go_before_the_table():
    assert cost_usd(
        entry(price=PRICE.model_copy(update={"output": 1.0})), Usage(0, None, 1_000_000)
    ) == pytest.approx(1.0)


def test_without_a_price_for_cached_input_it_costs_as_any_other():
    plain = Price(input=2.0, output=8.0, source="contract")
    assert cost_usd(entry(price=plain), Usage(1000, 400, 0)) == pytest.approx(0.002)
    free = Price(input=2.0, cached_input=0.0, output=8.0, source="contract")
    assert cost_usd(entry(price=free), Usage(1000, 400, 0)) == pytest.approx(0.0012)


@pytest.mark.parametrize(
    "model", [entry("openai", "no-such-model"), entry("local", "anything")], ids=str
)
def test_an_unknown_price_is_said_and_not_guessed(model):
    assert cost_usd(model, Usage(1000, 0, 1000)) is None


@pytest.mark.parametrize("model", [entry(), entry(price=PRICE)], ids=["table", "explicit"])
@pytest.mark.parametrize("usage", [Usage(), Usage(1000), Usage(output_tokens=1000)], ids=str)
def test_tokens_that_are_not_told_have_no_cost(model, usage):
    assert cost_usd(model, usage) is None


@pytest.mark.parametrize("usage", [Usage(), Usage(10**9, 0, 10**9)], ids=str)
def test_what_is_free_costs_nothing(usage):
    priced = entry("local", "anything", price="free")
    assert cost_usd(priced, usage) == 0.0


def test_more_cached_input_than_input_is_taken_for_none():
    """A server that counts wrongly neither ends a sweep nor makes it cheap."""
    priced = entry()
    assert cost_usd(priced, Usage(100, 500, 10)) == cost_usd(priced, Usage(100, 0, 10))


def test_a_service_tier_is_priced_where_the_registry_knows_it():
    """The table of genai-prices knows OpenAI's tiers; explicit figures have factors."""
    usage = Usage(1000, 0, 1000)
    assert cost_usd(entry(), usage) == pytest.approx(0.010)
    assert cost_usd(entry(), usage, "priority") == pytest.approx(0.0175)
    assert cost_usd(entry(), usage, "flex") == pytest.approx(0.005)
    assert cost_usd(entry(), usage, "default") == pytest.approx(0.010)
    with_tiers = entry(price=PRICE.model_copy(update={"tiers": {"priority": 2.0}}))
    assert cost_usd(with_tiers, usage, "priority") == pytest.approx(0.020)
    assert cost_usd(with_tiers, usage, "flex") == pytest.approx(0.010)
    assert not is_underpriced(entry(), "priority")
    assert not is_underpriced(with_tiers, "priority")


@pytest.mark.parametrize(
    ("model", "tier", "expected"),
    [
        (entry(price=PRICE), "priority", True),
        (entry("gemini", "gemini-3.8-flash"), "priority", True),
        (entry(price=PRICE), "default", False),
        (entry(price=PRICE), None, False),
        (entry(price="free"), "priority", False),
        (entry("local", "anything"), "priority", False),  # that the price is unknown is said
    ],
)
def test_a_dearer_tier_without_a_price_is_known_as_such(model, tier, expected):
    assert is_underpriced(model, tier) == expected
