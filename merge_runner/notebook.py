"""A study run from Python, as in a notebook: ``Study("study.toml").run()``, and its results.

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

from merge_runner.drivers.base import Driver
from merge_runner.drivers.program_seat import ProgramSeat
from merge_runner.drivers.registry import PROGRAMS, Program
from merge_runner.errors import UsageError
from merge_runner.paths import DEFAULT_CACHE, DEFAULT_DB, home_of
from merge_runner.registry import Catalogue, Registry, collecting, remember
from merge_runner.run.estimate import Estimate
from merge_runner.run.estimate_lines import estimate_lines
from merge_runner.run.plan import Options, Plan, make_plan
from merge_runner.run.summary import as_lines
from merge_runner.run.sweep import on_event, play, unsent
from merge_runner.study.crossing import level_text
from merge_runner.text_safety import say

if TYPE_CHECKING:
    import pandas as pd
    from pydantic import JsonValue

P = ParamSpec("P")
T = TypeVar("T")
PARTS = ("repetitions", "conditions", "variants")


def sync(method: Callable[P, Coroutine[Any, Any, T]]) -> Callable[P, T]:
    """Return the method as one that blocks; it raises UsageError where an event loop is running."""

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
    """What a run did, and its trials as data frames, those that were stored before among them.

    ``exit_code`` is that of the command line: 0 where all trials ended; ``messages`` say what went
    wrong. ``facts`` is the summary that ``merge-runner sweep --json`` prints.
    """

    facts: dict[str, Any]

    def __post_init__(self) -> None:
        self.exit_code: int = self.facts["exit_code"]
        self.ok = self.exit_code == 0
        self.messages: list[str] = self.facts["messages"]
        self.db = Path(self.facts["db"])
        self.sweep_id: str = self.facts["sweep_id"]

    def __repr__(self) -> str:
        """The summary, and what went wrong, for a reader."""
        errors = (f"error: {message}" for message in self.messages)
        return "\n".join([*as_lines(self.facts), *errors])

    def trials(self) -> pd.DataFrame:
        """One row a trial, with its measures in SI units and a column for each factor.

        A factor is of numbers where all its levels are numbers, of truth values likewise.
        """
        from merge_runner.results.frames import load_trials

        return load_trials(self.db, self.sweep_id)

    def rows(self, table: str) -> pd.DataFrame:
        """The rows of one of the tables that hold its trials."""
        from merge_runner.results.frames import load_of_sweep

        return load_of_sweep(self.db, self.sweep_id, table)

    # One row a decision, an attempt at a call, a vehicle and step.
    decisions = partialmethod(rows, "decisions")
    calls, states = partialmethod(rows, "calls"), partialmethod(rows, "states")

    def sql(self, query: str) -> pd.DataFrame:
        """The rows of one read-only query over the whole database; raises UsageError."""
        from merge_runner.results.frames import load

        return load(self.db, query)


class Study:
    """A study that can be run: a sweep of ``experiments``, or a file, and what of it is wanted.

    ``models``, ``repetitions``, ``conditions`` and ``prompts`` take the place of what the file
    says; ``only`` names a level, or a list of levels, by factor; ``mirror`` plays two different
    drivers both ways round; ``db`` and ``cache`` lie beside the file; ``trust`` agrees to the code
    of the study, and to where its models.toml sends keys. ``arun``, ``areplay`` and ``adry_run``
    are awaited, as in a notebook; ``run``, ``replay`` and ``dry_run`` are for scripts. How a run
    goes on is said by the fields of ``Options``, as ``in_flight=50, max_cost_usd=20``.

    Studies run side by side, in one event loop or in threads, each with its own parts.

    All of them raise UsageError for what cannot be run as it is asked for. What goes wrong on the
    way is in the outcome, beside the trials that ended: the same call goes on from there.
    """

    def __init__(
        self,
        file: Path | str,
        *,
        db: Path | str | None = None,
        cache: Path | str | None = None,
        only: Mapping[str, JsonValue] | None = None,
        prompts: Sequence[str] | None = None,
        **wanted: Any,  # noqa: ANN401 # as for make_plan
    ) -> None:
        self.file = str(file)
        home = home_of(self.file)
        self.db, self.cache = Path(db or home / DEFAULT_DB), Path(cache or home / DEFAULT_CACHE)
        levels = {
            name: [level_text(level) for level in (given if isinstance(given, list) else [given])]
            for name, given in (only or {}).items()
        }
        self._own = self._planned = Catalogue()
        self._wanted: dict[str, Any] = {"only": levels, "variants": prompts, **wanted}

    def register(self, registry: Registry[T], name: str, thing: T) -> T:
        """Add a prompt, a condition, a metric, ... of this study, and return it.

        It takes the place of what was so added by this name, so that a cell can be run again; a run
        that is under way goes on with what it began with. Raises UsageError where the name is that
        of something else.
        """
        self._own.parts.get(registry.kind, {}).pop(name, None)
        with collecting(self._own):
            registry.register(name, thing)
        known, own = self._planned.parts, self._own.parts
        parts = {kind: {**known.get(kind, {}), **own.get(kind, {})} for kind in {**known, **own}}
        remember(self.db, replace(self._planned, parts=parts))
        return thing

    def register_driver(
        self,
        name: str,
        driver: Callable[[ProgramSeat], Driver],
        meaning: str,
        **more: Any,  # noqa: ANN401 # fields of Program
    ) -> None:
        """Add a driver, with fields of ``Program``. Another ``revision`` is another one."""
        self.register(PROGRAMS, name, Program(driver, meaning, **more))

    def plan(self, *, first: bool = False, grid: str | None = None) -> Plan:
        """What would be played: all, or only the first decisions; raises UsageError."""
        wanted = {"db": self.db, "first": first, "grid": grid, **self._wanted}
        plan = make_plan(self.file, own=self._own, **wanted)
        self._planned = plan.parts.catalogue
        remember(self.db, self._planned)
        return plan

    async def adry_run(self) -> Estimate:
        """The trials, calls, tokens, cost and time of a run; nothing is sent."""
        return await unsent(self.plan(), Options(self.db, self.cache), say=say)

    async def arun(
        self,
        *,
        yes: bool = False,
        first: bool = False,
        grid: str | None = None,
        stop: asyncio.Event | None = None,
        **how: Any,  # noqa: ANN401 # fields of Options
    ) -> StudyOutcome:
        """Play all trials that are not stored yet; ``yes`` lets it spend money.

        Where ``stop`` is set, no more is asked, and what is paid for is saved; so it is where the
        task is cancelled.

        ``first`` asks only what drivers do first, in the study's conditions or on a ``grid``, as
        ``sweep --first`` and its ``--grid``.
        """

        def agree(expected: Estimate) -> None:
            if not yes:
                lines = "; ".join(estimate_lines(expected))
                raise UsageError(f"this run spends money; yes=True goes ahead: {lines}")

        plan = self.plan(first=first, grid=grid)
        options = Options(self.db, self.cache, **how)
        whole = any(self._wanted.get(each) is not None for each in PARTS)
        how_to_stop = on_event(stop)
        return StudyOutcome(
            await play(plan, options, whole=whole, say=say, agree=agree, stopping=how_to_stop)
        )

    async def areplay(self, *recordings: Path | str) -> StudyOutcome:
        """Play all trials from recorded replies alone, those of the files first; sends nothing."""
        return await self.arun(replay=True, recordings=tuple(map(Path, recordings)))

    dry_run, run, replay = sync(adry_run), sync(arun), sync(areplay)
