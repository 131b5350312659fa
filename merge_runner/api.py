"""Study for Python and notebooks: ``Study("study.toml").run()``, and its results.

>>> from merge_runner import Study
>>> outcome = await Study("study.toml").arun()
>>> outcome.trials().groupby("temperature")["gap_m"].mean()
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partialmethod, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from merge_runner.drivers.base import Driver, DriverContext
from merge_runner.drivers.registry import PROGRAMS, Program
from merge_runner.errors import UsageError
from merge_runner.paths import DEFAULT_CACHE, DEFAULT_DB, home_of
from merge_runner.registry import Catalogue, Registry, collecting, remember
from merge_runner.run.estimate import Estimate
from merge_runner.run.estimate_lines import estimate_lines
from merge_runner.run.interrupt import on_event
from merge_runner.run.options import Options
from merge_runner.run.plan import Plan, make_plan
from merge_runner.run.summary import as_lines
from merge_runner.run.sweep import play, unsent
from merge_runner.study.arms import level_text
from merge_runner.text_safety import say

if TYPE_CHECKING:
    import pandas as pd
    from pydantic import JsonValue

P = ParamSpec("P")
T = TypeVar("T")
PARTS = ("repetitions", "conditions", "variants")


def sync(method: Callable[P, Coroutine[Any, Any, T]]) -> Callable[P, T]:
    """Return a blocking version of a method; it raises UsageError if an event loop is running."""

    @wraps(method)
    def blocking(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            asyncio.get_running_loop()
        except RuntimeError:
            return asyncio.run(method(*args, **kwargs))
        awaited = f"await study.{method.__name__}(...)"
        raise UsageError(f"an event loop is running, as in a notebook: {awaited}")

    return blocking


@dataclass(repr=False)
class StudyOutcome:
    """Outcome of a run, with its trials as data frames, including those stored before.

    ``exit_code`` is as on the command line: 0 if all trials ended; ``messages`` are its errors.
    ``facts`` is the summary that ``merge-runner sweep --json`` prints.
    """

    facts: dict[str, Any]

    def __post_init__(self) -> None:
        self.exit_code: int = self.facts["exit_code"]
        self.ok = self.exit_code == 0
        self.messages: list[str] = self.facts["messages"]
        self.db = Path(self.facts["db"])
        self.sweep_id: str = self.facts["sweep_id"]

    def __repr__(self) -> str:
        """Return the summary and the errors as text."""
        errors = (f"error: {message}" for message in self.messages)
        return "\n".join([*as_lines(self.facts), *errors])

    def trials(self) -> pd.DataFrame:
        """Return one row per trial, with measures in SI units and a column for each factor.

        The column of a factor is numeric if all its levels are numbers, boolean likewise.
        """
        from merge_runner.results.frames import load_trials

        return load_trials(self.db, self.sweep_id)

    def rows(self, table: str) -> pd.DataFrame:
        """Return the rows of its trials in one table of the database."""
        from merge_runner.results.frames import load_of_sweep

        return load_of_sweep(self.db, self.sweep_id, table)

    # One row per decision; per attempt at a call; per vehicle and step.
    decisions = partialmethod(rows, "decisions")
    calls, states = partialmethod(rows, "calls"), partialmethod(rows, "states")

    def sql(self, query: str) -> pd.DataFrame:
        """Return the rows of a read-only query over the whole database; raise UsageError."""
        from merge_runner.results.frames import load

        return load(self.db, query)


class Study:
    """Study to run: a sweep of ``experiments`` by name, or a file.

    ``models``, ``repetitions``, ``conditions`` and ``prompts`` override the file; ``only`` selects
    a level, or a list of levels, by factor; ``mirror`` counterbalances the sides of two different
    drivers; ``trust`` agrees to run the code of the study, and to send keys where its models.toml
    says. ``db`` and ``cache`` are ``results/merge.duckdb`` and ``cache/responses`` by default: in
    the file's folder, in the parent of a folder ``experiments``, or for a name in the working
    directory. ``arun``, ``areplay`` and ``adry_run`` are awaited, as in a notebook; ``run``,
    ``replay`` and ``dry_run`` are for scripts. Fields of ``Options`` configure a run, as
    ``in_flight=50, max_cost_usd=20``.

    Studies run side by side, in one event loop or in threads, each with its own parts.

    All methods raise UsageError for an invalid study or option. Errors of trials and calls are in
    the outcome, beside the trials that ended; the same call continues from there.
    """

    def __init__(
        self,
        file: Path | str,
        *,
        db: Path | str | None = None,
        cache: Path | str | None = None,
        only: Mapping[str, JsonValue] | None = None,
        prompts: Sequence[str] | None = None,
        **choices: Any,  # noqa: ANN401 # as for make_plan
    ) -> None:
        self.file = str(file)
        home = home_of(self.file)
        self.db, self.cache = Path(db or home / DEFAULT_DB), Path(cache or home / DEFAULT_CACHE)
        levels = {
            name: [level_text(level) for level in (given if isinstance(given, list) else [given])]
            for name, given in (only or {}).items()
        }
        self._added = self._planned = Catalogue()
        self._choices: dict[str, Any] = {"only": levels, "variants": prompts, **choices}

    def register(self, registry: Registry[T], name: str, thing: T) -> T:
        """Add a prompt, a condition, a metric, ... to this study, and return it.

        It replaces an earlier one of this name, so that a cell can be run again; a run under way
        keeps the earlier one. Raise UsageError if the name is taken elsewhere.
        """
        self._added.parts.get(registry.kind, {}).pop(name, None)
        with collecting(self._added):
            registry.register(name, thing)
        known, new = self._planned.parts, self._added.parts
        parts = {kind: {**known.get(kind, {}), **new.get(kind, {})} for kind in {**known, **new}}
        remember(self.db, replace(self._planned, parts=parts))
        return thing

    def register_driver(
        self,
        name: str,
        driver: Callable[[DriverContext], Driver],
        meaning: str,
        **more: Any,  # noqa: ANN401 # fields of Program
    ) -> None:
        """Add a driver, with fields of ``Program``; another ``revision`` is another driver."""
        self.register(PROGRAMS, name, Program(driver, meaning, **more))

    def plan(self, *, first: bool = False, grid: str | None = None) -> Plan:
        """Return the plan of a run, or of its first decisions only; raise UsageError."""
        choices = {"db": self.db, "first": first, "grid": grid, **self._choices}
        plan = make_plan(self.file, registered=self._added, **choices)
        self._planned = plan.parts.catalogue
        remember(self.db, self._planned)
        return plan

    async def adry_run(self) -> Estimate:
        """Estimate trials, calls, tokens, cost and time of a run; nothing is sent."""
        return await unsent(self.plan(), Options(self.db, self.cache), say=say)

    async def arun(
        self,
        *,
        yes: bool = False,
        first: bool = False,
        grid: str | None = None,
        stop: asyncio.Event | None = None,
        **fields: Any,  # noqa: ANN401 # fields of Options
    ) -> StudyOutcome:
        """Play all trials that are not stored yet; ``yes`` agrees to spend money.

        Once ``stop`` is set, or the task is cancelled, no new call is sent, and paid replies are
        saved. ``first`` asks only for first decisions, in the study's conditions or on a ``grid``,
        as ``sweep --first`` and its ``--grid``.
        """

        def agree(expected: Estimate) -> None:
            if not yes:
                lines = "; ".join(estimate_lines(expected))
                raise UsageError(f"this run spends money; yes=True goes ahead: {lines}")

        plan = self.plan(first=first, grid=grid)
        options = Options(self.db, self.cache, **fields)
        whole = any(self._choices.get(name) is not None for name in PARTS)
        how_to_stop = on_event(stop)
        return StudyOutcome(
            await play(plan, options, whole=whole, say=say, agree=agree, stopping=how_to_stop)
        )

    async def areplay(self, *recordings: Path | str) -> StudyOutcome:
        """Play trials from recorded replies alone; send nothing.

        With ``recordings`` it plays the trials that these hold; without any, all trials from the
        cache, or those of a shipped recording if the cache has no replies of the models. Chosen
        ``repetitions``, ``conditions`` or ``prompts`` are all played.
        """
        return await self.arun(replay=True, recordings=tuple(map(Path, recordings)))

    dry_run, run, replay = sync(adry_run), sync(arun), sync(areplay)
