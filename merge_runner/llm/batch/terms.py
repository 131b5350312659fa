"""Which models have a batch mode, on what terms, and the service that speaks its format."""

from __future__ import annotations

from collections.abc import Mapping

from merge_runner.config import PROVIDERS, BatchTerms, ModelEntry, endpoint_identity
from merge_runner.errors import UsageError
from merge_runner.llm.batch.anthropic import AnthropicBatches
from merge_runner.llm.batch.gemini import GeminiBatches
from merge_runner.llm.batch.openai import OpenAIBatches
from merge_runner.llm.batch.service import BatchService

# By wire format.
SERVICES: Mapping[str, type[BatchService]] = {
    "openai-chat": OpenAIBatches,
    "openai-responses": OpenAIBatches,
    "gemini": GeminiBatches,
    "anthropic": AnthropicBatches,
}


def batch_terms(entry: ModelEntry) -> BatchTerms | None:
    """Return the terms on which a model answers in batches; None: it has no known batch mode."""
    # A path of its own leads to one deployment, which no batch can name.
    if entry.batch == "none" or entry.path is not None or entry.format not in SERVICES:
        return None
    if isinstance(entry.batch, BatchTerms):
        return entry.batch
    # A provider's price holds at its own address.
    is_its_own = endpoint_identity(entry) == entry.provider
    return PROVIDERS.require(entry.provider).batch if is_its_own else None


def require_batch(name: str, entry: ModelEntry, entries: Mapping[str, ModelEntry]) -> BatchTerms:
    """Return the terms of a model; raises UsageError, which lists those entries that have some."""
    terms = batch_terms(entry)
    if terms is None:
        valid = ", ".join(each for each, its in entries.items() if batch_terms(its))
        where = endpoint_identity(entry)
        at = "" if where == entry.provider else f" at {where}"
        raise UsageError(
            f"{name} has no batch mode that is known{at}; valid with --batch: {valid}. Leave "
            "--batch out, or give the entry in experiments/models.toml `batch = "
            "{ price_factor = 0.5, source = ... }` where its server has one in the same format"
        )
    return terms
