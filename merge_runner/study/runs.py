"""Runs of a study in a database."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

from merge_runner.errors import UsageError
from merge_runner.results.database import read_database
from merge_runner.study.arms import MODEL, PROMPT
from merge_runner.study.file import StudySource

NAMED = """
SELECT sweep_id, name, coalesce('-' || nullif(config->>'$.seat', ''), '') AS suffix,
    coalesce(config->'$.levels', '{}') AS levels
FROM sweeps ORDER BY started_at, sweep_id
"""


def study_name(name: str, factors: Iterable[str]) -> str:
    """Return the name with its factors, as ``mood (opponent, temperature)``."""
    varied = sorted({*factors} - {MODEL, PROMPT})
    return f"{name} ({', '.join(varied)})" if varied else name


def runs_of(db: Path, study: StudySource) -> list[str]:
    """Return the ids of a study's runs, oldest first; raises UsageError without any."""
    with read_database(db) as connection:
        rows = connection.execute(NAMED).fetchall()
    requested = study_name(study.name, study.file.factors)
    played = {
        sweep_id: study_name(name.removesuffix(suffix), json.loads(levels))
        for sweep_id, name, suffix, levels in rows
    }
    if requested not in played.values():
        studies = ", ".join(dict.fromkeys(played.values())) or "none"
        raise UsageError(f"{db} holds no trial of the study {requested}; its studies: {studies}")
    return [sweep_id for sweep_id, name in played.items() if name == requested]
