"""What a replay plays, and from which recordings."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from merge_runner.llm.cache import ResponseCache
from merge_runner.paths import SHIPPED_RECORDINGS
from merge_runner.results.recorded_study import recorded_part
from merge_runner.run.plan import Options, Plan


def replayed(plan: Plan, options: Options, *, whole: bool) -> tuple[Plan, Options, list[str]]:
    """The plan and the options of a replay, with notes on what differs from what was asked for.

    Where no recording is named, and the cache has no reply of the models, the recording that ships
    with the program is replayed: a user's own replies are never mixed with those of somebody else.
    Unless the ``whole`` plan is wanted, no more than it holds is.
    """
    notes = []
    shipped = SHIPPED_RECORDINGS / f"{plan.model}-{plan.study.name}.parquet"
    if not options.recordings and shipped.is_file() and not _has_replies(options.cache, plan):
        options = replace(options, recordings=(shipped,))
        notes.append(f"The replies are from the recording that ships with merge-runner: {shipped}")
    part = plan
    if options.recordings and not whole:
        part = _recorded(plan, options.recordings)
    if part.trials < plan.trials:
        notes.append(f"note: the recording holds {part.trials} of the plan's {plan.trials} trials")
    return part, options, notes


def _has_replies(folder: Path, plan: Plan) -> bool:
    """Whether a cache holds replies of the plan's models."""
    if not (folder / "cache.db").is_file():
        return False
    ids = {entry.id for entry in plan.entries.values()}
    with closing(ResponseCache(folder, read_only=True)) as cache:
        return any(True for _ in cache.recorded(lambda request: request.model in ids))


def _recorded(plan: Plan, recordings: Sequence[Path]) -> Plan:
    """The part of a plan that recordings of the same sweep hold; all of it if they do not say.

    A sweep's recording holds its first situations, too.
    """
    names = {plan.study.name, plan.name}
    held = recorded_part(recordings, names, plan.model, plan.sample_set)
    if held is None:
        return plan
    arms = tuple(
        replace(arm, repetitions=min(arm.repetitions, held.repetitions[arm.variant]))
        for arm in plan.arms
        if held.repetitions.get(arm.variant) and (not held.arms or arm.label in held.arms)
    )
    conditions = tuple(one for one in plan.conditions if one in held.conditions)
    part = plan.model_copy(update={"arms": arms, "conditions": conditions})
    return part if part.trials else plan
