"""What a replay plays, and from which recordings."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from merge_runner.errors import MergeRunnerError
from merge_runner.llm.cache import ResponseCache
from merge_runner.paths import SHIPPED_RECORDINGS
from merge_runner.results.recorded_study import recorded_part
from merge_runner.run.plan import Options, Plan


def replayed(plan: Plan, options: Options, *, whole: bool) -> tuple[Plan, Options, list[str]]:
    """The plan and the options of a replay, with notes on what differs from what was asked for.

    Where no recording is named, and the cache has no reply of the models, the recording that ships
    with the program is replayed. Unless the ``whole`` plan is wanted, no more than it holds is.
    """
    notes = []
    if not options.recordings and (file := _shipped(plan, options.cache)):
        options = replace(options, recordings=(file,))
        notes.append(f"The replies are from the recording that ships with merge-runner: {file}")
    if options.recordings and not whole:
        plan, note = as_recorded(plan, options.recordings)
        notes += [note] if note else []
    return plan, options, notes


def _shipped(plan: Plan, folder: Path) -> Path | None:
    """The recording of a sweep that ships with the program.

    A user's own replies of the same model are never mixed with those of somebody else.
    """
    file = SHIPPED_RECORDINGS / f"{plan.model}-{plan.study.name}.parquet"
    return file if file.is_file() and not _has_replies(folder, plan) else None


def _has_replies(folder: Path, plan: Plan) -> bool:
    """Whether a cache holds replies of the plan's models, or is one that cannot be read here."""
    if not (folder / "cache.db").is_file():
        return False
    ids = {entry.id for entry in plan.entries.values()}
    unreadable: list[str] = []
    try:
        with closing(ResponseCache(folder, read_only=True)) as cache:
            found = any(entry.request.model in ids for entry in cache.entries(unreadable))
    except MergeRunnerError:
        return True  # it says so when the replay opens it
    return found or bool(unreadable)


def as_recorded(plan: Plan, recordings: Sequence[Path]) -> tuple[Plan, str]:
    """The part of a plan that recordings of the same sweep hold, and a line that says so.

    A sweep's recording holds its first situations, too. The line is empty, and the plan as it was,
    where they hold all of it, or say nothing of it.
    """
    names = {plan.study.name, plan.name}
    held = recorded_part(recordings, names, plan.model, plan.sample_set)
    if held is None:
        return plan, ""
    arms = tuple(
        replace(arm, repetitions=min(arm.repetitions, held.repetitions[arm.variant]))
        for arm in plan.arms
        if held.repetitions.get(arm.variant) and (not held.arms or arm.label in held.arms)
    )
    conditions = tuple(one for one in plan.conditions if one in held.conditions)
    if not arms or not conditions:
        return plan, ""
    part = plan.model_copy(update={"arms": arms, "conditions": conditions})
    if part.trials == plan.trials:
        return plan, ""
    variants = ", ".join(f"{wanted} x {variant}" for variant, wanted in part.repetitions.items())
    return part, (
        f"note: what the recording holds is played: {variants} in {len(conditions)} conditions, "
        f"{part.trials} trials; the sweep {plan.name} has {plan.trials}"
    )
