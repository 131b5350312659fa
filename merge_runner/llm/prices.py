"""What tokens cost, from the registry's figures or from the table of genai-prices."""

from __future__ import annotations

from decimal import Decimal

from merge_runner.config import ModelEntry, Price
from merge_runner.records import Usage

# The provider names of genai-prices where they differ from ours.
GENAI_PRICES_PROVIDER = {"gemini": "google"}
PER_MILLION = Decimal(1_000_000)


def cost_usd(entry: ModelEntry, usage: Usage) -> float | None:
    """Return the cost of an attempt in USD, None where the price or the tokens are unknown."""
    price, read, written = entry.price, usage.input_tokens, usage.output_tokens
    if price == "free":
        return 0.0
    if read is None or written is None:
        return None
    cached = usage.cached_input_tokens or 0
    if cached > read:
        cached = 0  # the server counts wrongly: none is taken for cheap
    if isinstance(price, Price):
        cached_price = price.input if price.cached_input is None else price.cached_input
        parts = ((read - cached, price.input), (cached, cached_price), (written, price.output))
        # Decimals of the written figures, so that sums of costs have no digits that nobody wrote.
        return float(sum(n * Decimal(str(usd)) for n, usd in parts) / PER_MILLION)
    from genai_prices import Usage as PricedUsage  # here, since it takes long to load
    from genai_prices import calc_price

    priced = PricedUsage(input_tokens=read, cache_read_tokens=cached, output_tokens=written)
    provider = GENAI_PRICES_PROVIDER.get(entry.provider, entry.provider)
    try:
        found = calc_price(priced, model_ref=entry.id, provider_id=provider)
    except LookupError:
        return None
    return float(found.total_price)
