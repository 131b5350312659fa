"""The file of a study that was played: its primary measure, and the texts of its factors."""

from __future__ import annotations

from merge_runner.errors import UsageError
from merge_runner.registry import in_use, require
from merge_runner.study.arms import MODEL
from merge_runner.study.file import StudyFile, StudySource, StudyText
from merge_runner.text_safety import first_line
from merge_runner_analysis.cache import remembered
from merge_runner_analysis.grouping import levels_of
from merge_runner_analysis.metrics import COLLISIONS, LEFT_FIRST, METRICS, Metric
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.wording import UNREADABLE

PRIMARY = "goes_first"  # in a study's file, and where none is named


@remembered
def primary(study: StudyResults) -> Metric:
    """Return the study's primary measure, by default who goes first. Raises UsageError."""
    return _measures()[_named(study) or PRIMARY]


@remembered
def asks_of_models(study: StudyResults) -> bool:
    """Return whether a study names a primary measure, and varies nothing but the model."""
    factors = levels_of(study.models, study.order)
    varying = {name for name, levels in factors.items() if len(levels) > 1}
    return varying == {MODEL} and bool(_named(study))


def _measures() -> dict[str, Metric]:
    return {PRIMARY: LEFT_FIRST, "collided": COLLISIONS, **METRICS}


def _named(study: StudyResults) -> str:
    """Return the primary measure of the study's file, unless its plug-in is missing."""
    file, _ = _file(study)
    if file is None or "primary" not in file.model_fields_set:
        return ""
    if file.primary not in _measures() and not _text_at_hand(study):
        return ""
    require(_measures(), "measure", file.primary, "as the study's primary one")
    return file.primary


def texts_of(study: StudyResults) -> dict[str, dict[str, StudyText]]:
    """Return the texts of a study's factors by level; empty where its file is not known."""
    file, _ = _file(study)
    return {} if file is None else dict(file.texts)


def unreadable(study: StudyResults) -> str:
    """Return why the study that was played cannot be read; empty if it can."""
    return _file(study)[1]


def _text_at_hand(study: StudyResults) -> str:
    return study.source.text if study.source else in_use().text


@remembered
def _file(study: StudyResults) -> tuple[StudyFile | None, str]:
    """Return the study's file, or why the stored one cannot be read. Raises UsageError."""
    if text := _text_at_hand(study):
        return StudySource(name="", text=text, plugins={}).file, ""
    played = study.frames.studies
    text = played.texts.get(next(iter(played.orders)), "") if len(played.orders) == 1 else ""
    try:
        return StudySource(name="", text=text, plugins={}).file if text else None, ""
    except UsageError as exc:
        return None, f"{UNREADABLE}, which takes who goes first as its measure: {first_line(exc)}"
