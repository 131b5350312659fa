"""The figures by name, and how they are written: equal results give equal files."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import matplotlib as mpl
from matplotlib.figure import Figure

from merge_runner.errors import UsageError
from merge_runner_analysis.cache import remembered
from merge_runner_analysis.figures import FIGURES
from merge_runner_analysis.figures.effects import effects_figure
from merge_runner_analysis.figures.figure2 import figure2
from merge_runner_analysis.figures.first_action import first_action
from merge_runner_analysis.figures.style import SETTINGS
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.table_format import TableFormat
from merge_runner_analysis.tables import make_tables
from merge_runner_analysis.tables.formats import render

Form = Literal["pdf", "svg", "png"]
FORMS: tuple[Form, ...] = ("pdf", "svg", "png")
METADATA: dict[str, dict[str, None]] = {
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
    "png": {"Software": None},
    "svg": {"Date": None, "Creator": None},
}
MAKERS: dict[str, Callable[[StudyResults], Figure]] = {
    "effects": effects_figure,
    "figure2": lambda study: figure2(study, study.baselines),
    "figure2-variants": lambda study: figure2(study, study.groups),
    "first-action": first_action,
}


def write_figures(study: StudyResults, folder: Path) -> Iterator[Path]:
    """Write every figure in all FORMS, and its table; yields paths. Raises UsageError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as exc:
        raise UsageError(f"{folder} cannot be made: {exc}") from exc
    for name in MAKERS:
        for form in FORMS:
            path = folder / f"{name}.{form}"
            path.write_bytes(rendered(study, name, form))
            yield path
        if table := FIGURES[name].table:
            path = folder / f"{table}.csv"
            text = render(make_tables(study, [table]), TableFormat.CSV)
            path.write_text(text + "\n", encoding="utf-8")
            yield path


def rendered(study: StudyResults, name: str, form: Form) -> bytes:
    """Return a figure as a file, without a date, so that equal results give equal bytes."""
    out = io.BytesIO()
    with mpl.rc_context(SETTINGS):
        _drawn(study, name).savefig(out, format=form, metadata=METADATA[form])
    return out.getvalue()


@remembered
def _drawn(study: StudyResults, name: str) -> Figure:
    return MAKERS[name](study)
