"""The report: one HTML file with everything in it, which needs no network."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import unified_diff
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd

from merge_runner.errors import UsageError
from merge_runner.prompts.blocks import title_of
from merge_runner.results.provenance import program
from merge_runner_analysis.data.derived_cache import finished, keep_finished
from merge_runner_analysis.data.load import load_each
from merge_runner_analysis.data.provenance import provenance
from merge_runner_analysis.data.reference_data import published
from merge_runner_analysis.data.study import Study, levels_of
from merge_runner_analysis.explain import Source, sources_of, sql_command
from merge_runner_analysis.figures import FIGURES
from merge_runner_analysis.figures.gallery import rendered, write_figures
from merge_runner_analysis.names import BASELINE, DESCRIPTIONS
from merge_runner_analysis.report.alarms import alarms, posing
from merge_runner_analysis.stats.factors import levels_by_factor
from merge_runner_analysis.table_format import TableFormat
from merge_runner_analysis.tables import finished_tables
from merge_runner_analysis.tables.against import FILES, against
from merge_runner_analysis.tables.formats import render, table_view
from merge_runner_analysis.tables.model import Column, Row, Table
from merge_runner_analysis.tables.verdicts import verdicts
from merge_runner_analysis.verdict_words import TABLE, sentences

# What each variant asks first: of all of them in the same condition, as far as that was played.
PROMPTS = """
SELECT variant, spec_hash, arg_min(prompt, (condition, decisions.side, trial_id)) AS prompt
FROM decisions JOIN trials USING (trial_id, spec_hash)
WHERE decision = 0 AND prompt IS NOT NULL GROUP BY variant, spec_hash
ORDER BY min((condition, decisions.side, trial_id)) DESC
"""
TEMPLATES = Path(__file__).with_name("templates")
# At most so many trials are listed for a row: a page with all of them would be unwieldy.
LISTED = 300
LIBRARIES = ("statsmodels", "scipy", "numpy", "pandas", "matplotlib")


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
    tables = finished_tables(db, study=study)
    if files is not None:
        yield from write_figures(study, files)
        for table in tables:
            for form in TableFormat:
                path = files / f"{table.name}.{form.suffix}"
                path.write_text(render([table], form) + "\n", encoding="utf-8")
                yield path
    text = report_html(study, tables, finished_figures(study))
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text, encoding="utf-8")
    except OSError as exc:
        raise UsageError(f"{out} cannot be written: {exc}") from exc
    yield out


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


def report_html(study: Study, tables: list[Table], figures: dict[str, str]) -> str:
    """The report as one HTML document; ``figures`` maps names to SVG in Base64."""
    # Rows with equal sources share a number.
    numbers: dict[tuple[Source, ...], int] = {}

    def number(table: Table, row: Row, _column: Column) -> int:
        return numbers.setdefault(sources_of(study, table, row), len(numbers) + 1)

    without_factors = not levels_by_factor(study)
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=True,
        # A misspelt name fails the report rather than leaving a blank in it.
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    origin = provenance(study.db)
    finished = next((table for table in tables if table.name == TABLE), None)
    said = sentences((finished or verdicts(study)).rows)
    views = {
        table.name: table_view(table, number)
        for table in tables
        if table.name != "factors" or not without_factors
    }
    return environment.get_template("report.html").render(
        study=study,
        design=design(study),
        alarms=alarms(study, origin),
        headline=said[0],
        sentences=said[1:],
        posing=posing(study),
        figures=[
            {"name": name, "caption": FIGURES[name].caption, "data": data}
            for name, data in figures.items()
            if name != "factors" or not without_factors
        ],
        factors=views.pop("factors", None),
        tables=list(views.values()),
        beside=[
            table_view(against(table, study), number) for table in tables if table.name in FILES
        ],
        sources=[(place, sources) for sources, place in numbers.items()],
        listed=LISTED,
        command=sql_command(study),
        libraries=", ".join(f"{name} {version(name)}" for name in LIBRARIES),
        origin=origin,
        records=_records,
        readings=_records(published("readings")),
        sources_cited=_records(published("sources")),
        program=program(),
    )


@dataclass(frozen=True, slots=True)
class Design:
    """What a report says before any result.

    ``rows`` name the levels of each factor, the conditions and the trials; ``prompts`` have a title
    and the text of the first prompt, of variants the lines that differ from the baseline's.
    """

    descriptions: list[str]
    rows: list[tuple[str, str]]
    prompts: list[tuple[str, str]]


def design(study: Study) -> Design:
    """Read the design of a study from what was played."""
    found = load_each({"descriptions": DESCRIPTIONS, "prompts": PROMPTS}, study.db)
    specs = {name for group in study.played for name in group.trials["spec_hash"]}
    prompts = found["prompts"]
    own = prompts.loc[prompts["spec_hash"].isin(specs), ["variant", "prompt"]]
    texts = dict(own.itertuples(index=False))
    shown = [name for name in dict.fromkeys(g.setting for g in study.played) if name in texts]
    baseline = texts.get(BASELINE)
    levels = levels_of(study.played, study.order)
    factors = {name: levels[name] for name in levels if name != "model"}
    drivers = list(dict.fromkeys(group.label for group in study.played))
    driven = {name for group in study.played for name in group.trials["condition"]}
    rows = {"drivers": drivers, **factors, "conditions": sorted(driven)}
    trials = sum(len(group.trials) for group in study.played)
    return Design(
        list(found["descriptions"]["description"])
        if study.source is None
        else [study.source.file.description] * bool(study.source.file.description),
        [
            *((name, ", ".join(values)) for name, values in rows.items() if values),
            ("trials", str(trials)),
        ],
        [
            (f"{title_of(name)}: first prompt", texts[name])
            if baseline is None or name == BASELINE
            else (f"{title_of(name)}: against the baseline", _changes(baseline, texts[name]))
            for name in shown
        ],
    )


def _changes(baseline: str, prompt: str) -> str:
    """The lines that were taken out (-) and put in (+)."""
    lines = unified_diff(baseline.splitlines(), prompt.splitlines(), lineterm="", n=0)
    return "\n".join(line for line in lines if not line.startswith(("---", "+++", "@@")))


def _records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows for a template: missing values become empty text, whole floats integers."""
    rounded = frame.round(dict.fromkeys(frame.select_dtypes("number"), 6)).convert_dtypes()
    shown = rounded.astype(object).where(frame.notna(), "")
    records: list[dict[str, Any]] = shown.to_dict(orient="records")
    return records
