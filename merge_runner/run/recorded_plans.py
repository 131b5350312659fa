"""The plans in a recording, by which it is replayed without the file of its study."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from merge_runner.errors import RecordingError, UsageError
from merge_runner.records import DAMAGED
from merge_runner.results.recorded_sweeps import sweep_rows
from merge_runner.results.recording import read_provenance
from merge_runner.run.parts import find_parts
from merge_runner.run.plan import Plan, make_plan
from merge_runner.study.crossing import MOST_TRIALS
from merge_runner.study.file import study_files
from merge_runner.study.parts import load_study
from merge_runner.text_safety import first_line, one_line


def recorded_plans(file: Path, *, db: Path, trust: bool) -> Iterator[Plan]:
    """Yield the plans of the sweeps in a recording, equal ones once.

    A study's code needs the user's agreement, as with a study's file. ``db`` has the human
    trials that are to be replayed. Raises UsageError or RecordingError.
    """
    seen = set[str]()
    for row in sweep_rows(read_provenance(file)):
        try:
            name, config = str(row["name"]), dict(json.loads(row["config"]))
            plan = Plan.model_validate(config) if "study" in config else None
        except DAMAGED as exc:
            why = one_line(first_line(exc))
            raise RecordingError(f"{file} does not say what was played: {why}") from exc
        if plan is None:
            plan = _of_a_known_study(file, name, config, db)
        elif plan.trials > MOST_TRIALS:
            raise RecordingError(f"{file} claims {plan.trials:,} trials")
        else:
            # The file is named in the question and in errors.
            study = plan.study.model_copy(update={"path": file})
            _, catalogue = load_study(study, trust=trust)
            parts = find_parts(plan.arms, plan.conditions, catalogue).with_humans_of(db)
            plan = plan.model_copy(update={"study": study, "parts": parts})
        if (text := plan.model_dump_json()) not in seen:
            seen.add(text)
            yield plan
    if not seen:
        raise RecordingError(f"{file} does not say what was played")


def _of_a_known_study(file: Path, name: str, config: dict[str, object], db: Path) -> Plan:
    """Return the plan of an early recording, which names its study and does not hold it."""
    if name not in study_files():
        raise UsageError(
            f"{file} is of the study {name}, and does not hold it: `merge-runner replay STUDY.toml "
            f"--recording {file}` replays it by the study's file"
        )
    models, sample_set = str(config.get("model", "")), config.get("sample_set", 0)
    return make_plan(
        name, models.split(","), sample_set=sample_set if isinstance(sample_set, int) else 0, db=db
    )
