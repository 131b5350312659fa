"""What a run would send, found out without it."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from merge_runner.run.estimate import Estimate
from merge_runner.run.plan import Options, Plan
from merge_runner.run.sweep import Sweep


async def unsent(plan: Plan, options: Options, *, say: Callable[[str], None]) -> Estimate:
    """What is neither stored nor recorded yet; makes no database or cache that is not there."""
    with _prepared(plan, options, say) as prepared:
        return await prepared.estimate()


def of_all(plan: Plan, options: Options, *, say: Callable[[str], None]) -> Estimate:
    """What the whole plan takes, as if nothing were stored or recorded; makes nothing either."""
    with _prepared(plan, options, say) as prepared:
        return prepared.estimate_of_all()


@contextmanager
def _prepared(plan: Plan, options: Options, say: Callable[[str], None]) -> Iterator[Sweep]:
    with tempfile.TemporaryDirectory() as folder:
        db = options.db if options.db.is_file() else Path(folder) / "none.duckdb"
        recorded = (options.cache / "cache.db").is_file()
        cache = options.cache if recorded else Path(folder) / "responses"
        prepared = Sweep(plan, replace(options, db=db, cache=cache, dry_run=True), say=say)
        try:
            yield prepared
        finally:
            prepared.close()
