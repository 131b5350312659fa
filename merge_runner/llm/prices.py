"""What tokens cost, from the registry's figures or from the table of genai-prices."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal

from merge_runner.config import ModelEntry, Price
from merge_runner.records import Usage

# The provider names of genai-prices where they differ from ours.
GENAI_PRICES_PROVIDER = {"gemini": "google"}
PER_MILLION = Decimal(1_000_000)


@dataclass(frozen=True, slots=True)
class Pricing:
    """The price of one model's tokens; ``known`` is False where nobody knows it."""

    provider: str
    model: str
    price: Price | str
    known: bool

    def cost_usd(self, usage: Usage) -> float | None:
        """The cost of an attempt in USD, None where the price or the tokens are unknown."""
        if self.price == "free":
            return 0.0
        if not self.known or usage.input_tokens is None or usage.output_tokens is None:
            return None
        cached = usage.cached_input_tokens or 0
        if cached > usage.input_tokens:
            cached = 0  # the server counts wrongly: none is taken for cheap
        if isinstance(self.price, Price):
            cached_price = self.price.cached_input
            cost = (
                (usage.input_tokens - cached) * Decimal(str(self.price.input))
                + cached * Decimal(str(self.price.input if cached_price is None else cached_price))
                + usage.output_tokens * Decimal(str(self.price.output))
            ) / PER_MILLION
            return float(cost)
        from genai_prices import Usage as PricedUsage
        from genai_prices import calc_price

        priced = PricedUsage(
            input_tokens=usage.input_tokens,
            cache_read_tokens=cached,
            output_tokens=usage.output_tokens,
        )
        return float(
            calc_price(priced, model_ref=self.model, provider_id=self.provider).total_price
        )


def pricing(entry: ModelEntry) -> Pricing:
    """The pricing of a model of the registry."""
    provider = GENAI_PRICES_PROVIDER.get(entry.provider, entry.provider)
    known = entry.price != "genai-prices" or _listed(provider, entry.id)
    return Pricing(provider, entry.id, entry.price, known)


def _listed(provider: str, model: str) -> bool:
    from genai_prices import Usage as PricedUsage
    from genai_prices import calc_price

    try:
        calc_price(PricedUsage(input_tokens=1), model_ref=model, provider_id=provider)
    except LookupError:
        return False
    return True
