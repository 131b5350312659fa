"""Writes the report: one HTML file with everything in it, which needs no network."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from merge_runner.errors import UsageError
from merge_runner_analysis.data.derived_cache import finished, keep_finished
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.figures import FIGURES
from merge_runner_analysis.figures.gallery import rendered, write_figures
from merge_runner_analysis.report.page import report_html
from merge_runner_analysis.table_format import TableFormat
from merge_runner_analysis.tables import finished_tables
from merge_runner_analysis.tables.formats import render
from merge_runner_analysis.tables.model import Table


def write_report(
    db: Path,
    models: Sequence[str] | None,
    out: Path,
    files: Path | None,
    where: Mapping[str, Sequence[str]] | None = None,
    file: str | None = None,
) -> Iterator[Path]:
    """Write the report, and every table and figure into the folder ``files``; yields the paths.

    ``models``, ``where`` and ``file`` restrict the report as they do a study. Raises UsageError.
    """
    study = Study(db, models, where, file)
    tables = finished_tables(db, None, study=study)
    if files is not None:
        yield from write_figures(study, files)
        yield from write_tables(tables, files)
    text = report_html(study, tables, finished_figures(study))
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text, encoding="utf-8")
    except OSError as exc:
        raise UsageError(f"{out} cannot be written: {exc}") from exc
    yield out


def write_tables(tables: list[Table], folder: Path) -> Iterator[Path]:
    """Write each table in every format; yields the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    for table in tables:
        for form in TableFormat:
            path = folder / f"{table.name}.{form.suffix}"
            path.write_text(render([table], form) + "\n", encoding="utf-8")
            yield path


def finished_figures(study: Study) -> dict[str, str]:
    """Every figure by name as SVG in Base64: read from the database where stored, else drawn."""
    files = {f"{name}.svg": name for name in FIGURES}  # a table may have the name alone
    found = finished(study.db, study.state, study.options, list(files))
    drawn = {
        file: base64.b64encode(rendered(study, name, "svg")).decode()
        for file, name in files.items()
        if file not in found
    }
    if drawn:
        keep_finished(study.db, study.state, study.options, drawn)
    return {name: (found | drawn)[file] for file, name in files.items()}
