"""What tokens cost, from the registry's figures or from the table of genai-prices."""

from __future__ import annotations

from decimal import Decimal

from merge_runner.config import ModelEntry, Price
from merge_runner.records import Usage

# The provider names of genai-prices where they differ from ours.
GENAI_PRICES_PROVIDER = {"gemini": "google"}
PER_MILLION = Decimal(1_000_000)


def is_known(entry: ModelEntry) -> bool:
    """Return whether anybody knows the price of a model."""
    return cost_usd(entry, Usage(input_tokens=1, output_tokens=1)) is not None


def cost_usd(entry: ModelEntry, usage: Usage) -> float | None:
    """Return the cost of an attempt in USD, None where the price or the tokens are unknown."""
    if entry.price == "free":
        return 0.0
    if usage.input_tokens is None or usage.output_tokens is None:
        return None
    cached = usage.cached_input_tokens or 0
    if cached > usage.input_tokens:
        cached = 0  # the server counts wrongly: none is taken for cheap
    if isinstance(entry.price, Price):
        return _by_figures(entry.price, usage.input_tokens, cached, usage.output_tokens)
    return _by_table(entry, usage.input_tokens, cached, usage.output_tokens)


def _by_figures(price: Price, read: int, cached: int, written: int) -> float:
    cached_price = price.input if price.cached_input is None else price.cached_input
    # Decimals of the written figures, so that sums of costs have no digits that nobody wrote.
    cost = (
        (read - cached) * Decimal(str(price.input))
        + cached * Decimal(str(cached_price))
        + written * Decimal(str(price.output))
    )
    return float(cost / PER_MILLION)


def _by_table(entry: ModelEntry, read: int, cached: int, written: int) -> float | None:
    from genai_prices import Usage as PricedUsage  # here, since it takes long to load
    from genai_prices import calc_price

    priced = PricedUsage(input_tokens=read, cache_read_tokens=cached, output_tokens=written)
    provider = GENAI_PRICES_PROVIDER.get(entry.provider, entry.provider)
    try:
        found = calc_price(priced, model_ref=entry.id, provider_id=provider)
    except LookupError:
        return None
    return float(found.total_price)
