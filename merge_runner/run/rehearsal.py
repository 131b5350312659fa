"""A rehearsal: the sweep as it is, with the emulator in the place of the provider.

The emulator speaks the provider's format, writes as many tokens as the model typically does, and
fails now and then. Time runs ``SPEED`` times as fast: answers come so much sooner, and the limits
of a minute hold within so much less.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from merge_runner.config import PROVIDERS, REHEARSAL, ModelEntry, endpoint_identity
from merge_runner.emulator import Behaviour
from merge_runner.errors import UsageError
from merge_runner.llm.models import load_models
from merge_runner.paths import DEFAULT_CACHE, DEFAULT_DB
from merge_runner.run.plan import Options, Plan

SPEED = 10
FOLDER = Path("results/rehearsal")
# The share of attempts in which something goes wrong, as with providers.
RATES = {"rate_limit": 0.01, "server_error": 0.005, "overloaded": 0.005, "malformed": 0.005}


def rehearsed(plan: Plan, options: Options, home: Path) -> tuple[Plan, Options]:
    """Return the plan and its options as they are rehearsed; raises UsageError.

    ``home`` is the folder in which the results of the sweep lie.
    """
    usual = home / DEFAULT_DB, home / DEFAULT_CACHE
    elsewhere = options.replay or options.dask or options.batch
    if elsewhere or (options.db, options.cache) != usual:
        raise UsageError(
            f"a rehearsal keeps what it makes in {FOLDER}, plays in this process and asks one by "
            "one: leave --db, --cache, --dask, --replay and --batch out"
        )
    models = {plan.registered[name] for name in plan.entries}
    if len(models) != 1 or not all(map(_can_be_rehearsed, plan.entries.values())):
        registry = load_models(plan.study.path.parent)
        valid = ", ".join(name for name, entry in registry.items() if _can_be_rehearsed(entry))
        raise UsageError(
            f"--rehearse takes one model at its provider's own address: --model with one of {valid}"
        )
    plan = plan.model_copy(update={"endpoints": dict.fromkeys(plan.entries, REHEARSAL)})
    folder = home / FOLDER
    return plan, replace(options, db=folder / "merge.duckdb", cache=folder / "responses")


def behaviour(plan: Plan) -> Behaviour:
    """Return how the emulator answers in the place of a plan's one model."""
    entry = next(iter(plan.entries.values()))  # the others differ in parameters alone
    return Behaviour(
        rates=RATES,
        latency_s=entry.typical_latency_s / SPEED,
        delay_s=1.0,
        output_tokens=entry.typical_output_tokens,
    )


def _can_be_rehearsed(entry: ModelEntry) -> bool:
    provider = PROVIDERS.require(entry.provider)
    is_own = endpoint_identity(entry) == entry.provider and entry.path is None
    return is_own and provider.key_needed and provider.base_url_env is not None
