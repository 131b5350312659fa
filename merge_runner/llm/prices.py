"""Costs of attempts, by the prices of the registry or of genai-prices."""

from __future__ import annotations

import contextlib
import time
from dataclasses import replace
from datetime import UTC, datetime
from decimal import Decimal
from functools import lru_cache, partial
from typing import TYPE_CHECKING

from merge_runner.providers import ModelEntry, Price
from merge_runner.records import Usage

if TYPE_CHECKING:
    from merge_runner.llm.endpoint_state import EndpointState
    from merge_runner.llm.sender import Sent

# Provider names of genai-prices where they differ from the registry's.
GENAI_PRICES_PROVIDER = {"gemini": "google"}
PER_MILLION = Decimal(1_000_000)
BYTES_A_TOKEN = 4  # about, in English
# Billed above the normal price, at OpenAI about twice.
DEARER_TIERS = frozenset({"priority"})


def cost_usd(entry: ModelEntry, usage: Usage, tier: str | None = None) -> float | None:
    """Return the cost of tokens in USD, None where the price or a count is unknown.

    ``tier`` is the service tier that the reply names; a tier without a price costs the normal one.
    """
    price, read, written = entry.price, usage.input_tokens, usage.output_tokens
    if price == "free":
        return 0.0
    if read is None or written is None:
        return None
    cached = usage.cached_input_tokens or 0
    if cached > read:
        cached = 0  # a wrong count: no token is priced as cached
    if isinstance(price, Price):
        cached_price = price.input if price.cached_input is None else price.cached_input
        # Decimals of the prices as written: binary fractions would add digits to sums.
        plain = (read - cached) * Decimal(str(price.input)) + cached * Decimal(str(cached_price))
        plain += written * Decimal(str(price.output))
        return float(plain / PER_MILLION * Decimal(str(price.tiers.get(tier or "", 1))))
    return _listed_usd(
        entry.provider, entry.id, (read, cached, written), tier, minute=int(time.time()) // 60
    )


@lru_cache(maxsize=1_024)
def _listed_usd(
    provider: str,
    model: str,
    tokens: tuple[int, int, int],
    tier: str | None,
    minute: int,
) -> float | None:
    """Return the cost by genai-prices, which is slow; the worst cases of many requests are equal.

    Some prices depend on the time of day, by ``minute`` since 1970.
    """
    from genai_prices import Usage as PricedUsage  # here, since it takes long to load
    from genai_prices import calc_price

    read, cached, written = tokens
    priced = PricedUsage(input_tokens=read, cache_read_tokens=cached, output_tokens=written)
    calculate = partial(
        calc_price,
        priced,
        model_ref=model,
        provider_id=GENAI_PRICES_PROVIDER.get(provider, provider),
        genai_request_timestamp=datetime.fromtimestamp(60 * minute, UTC),
    )
    try:
        # Older versions of the package know no tiers.
        with contextlib.suppress(TypeError):
            if tier is not None:
                return float(calculate(price_context={"service_tier": tier}).total_price)
        return float(calculate().total_price)
    except LookupError:
        return None


def attempt_usd(
    sent: Sent, worst: Usage, endpoint: EndpointState, price_factor: float
) -> float | None:
    """Return the cost of an attempt by its usage, which an error may have too; None: unknown.

    Output beyond the cap is billed even where the server does not report the input.
    """
    from merge_runner.llm.http_outcome import may_be_charged  # here, since no replay needs it

    outcome, entry = sent.outcome, endpoint.entry
    raw, usage = outcome.raw, outcome.reading.usage
    if entry.price == "free":
        return 0.0
    if raw is None:
        return None if outcome.charged else 0.0
    if sent.took_s is None and raw.status != 200 and usage == Usage():
        return 0.0  # a failed request of a batch is not billed
    usd: float | None
    if usage.input_tokens and usage.output_tokens is not None:
        usd = cost_usd(entry, usage, outcome.reading.service_tier)
    elif (usage.output_tokens or 0) > entry.max_output_tokens:
        most = replace(worst, output_tokens=usage.output_tokens)
        usd = cost_usd(entry, most, outcome.reading.service_tier)
    else:
        # Where no model ever answered, a web page comes from another server.
        stray = raw.status == 200 and raw.is_web_page and not endpoint.has_answered
        usd = None if may_be_charged(raw, endpoint.identity) and not stray else 0.0
    return usd and usd * price_factor


def worst_case(entry: ModelEntry, body: str) -> tuple[Usage, float]:
    """Return an upper bound of the tokens of a request, and their cost in USD.

    The input tokens are the request's bytes: no tokeniser makes more.
    """
    worst = Usage(input_tokens=len(body.encode()), output_tokens=entry.max_output_tokens)
    tier = entry.parameters.get("service_tier")
    in_tier_usd = cost_usd(entry, worst, tier) if isinstance(tier, str) else None
    return worst, max(cost_usd(entry, worst) or 0.0, in_tier_usd or 0.0)


def underpriced_tiers(entry: ModelEntry) -> set[str]:
    """Return the service tiers that cost more than the registry's price."""
    million = Usage(1_000_000, 0, 1_000_000)
    plain_usd = cost_usd(entry, million)
    return {t for t in DEARER_TIERS if plain_usd and cost_usd(entry, million, t) == plain_usd}
