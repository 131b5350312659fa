"""Which models have a batch mode, on what terms, and the service that speaks its format."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from merge_runner.config import PROVIDERS, BatchTerms, Endpoint, ModelEntry, endpoint_identity
from merge_runner.errors import UsageError
from merge_runner.llm.batch.anthropic import AnthropicBatches
from merge_runner.llm.batch.exchange import Exchange
from merge_runner.llm.batch.gemini import GeminiBatches
from merge_runner.llm.batch.openai import OpenAIBatches
from merge_runner.llm.batch.service import BatchService
from merge_runner.llm.formats import FORMATS
from merge_runner.registry import Registry

if TYPE_CHECKING:
    from merge_runner.llm.http import HttpTransport

BatchMode = Callable[[Exchange], BatchService]
BATCH_MODES: Registry[BatchMode] = Registry("batch mode")
BATCH_MODES.register("openai-chat", OpenAIBatches)
BATCH_MODES.register("openai-responses", OpenAIBatches)
BATCH_MODES.register("gemini", GeminiBatches)
BATCH_MODES.register("anthropic", AnthropicBatches)


def batch_terms(entry: ModelEntry) -> BatchTerms | None:
    """On what terms a model answers in batches; None: it has no batch mode that is known."""
    # A path of its own leads to one deployment, which no batch can name.
    if entry.batch == "none" or entry.path is not None or entry.format not in BATCH_MODES:
        return None
    if isinstance(entry.batch, BatchTerms):
        return entry.batch
    # A provider's price holds at its own address.
    is_its_own = endpoint_identity(entry) == entry.provider
    return PROVIDERS.require(entry.provider).batch if is_its_own else None


def require_batch(name: str, entry: ModelEntry, entries: Mapping[str, ModelEntry]) -> BatchTerms:
    """The terms of a model; raises UsageError, which lists those of the entries that have some."""
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


def batch_service(entry: ModelEntry, endpoint: Endpoint, transport: HttpTransport) -> BatchService:
    """The batch mode of a model that has one."""
    return BATCH_MODES[entry.format](Exchange(transport, endpoint, FORMATS[entry.format]))
