"""The HTML of the report: verdicts, figures, tables, provenance, and the trials behind them."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

import jinja2
import pandas as pd

from merge_runner.results.provenance import program
from merge_runner_analysis.data.provenance import provenance
from merge_runner_analysis.data.reference_data import published
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.explain import Source, sources_of, sql_command
from merge_runner_analysis.figures import FIGURES
from merge_runner_analysis.report.alarms import alarms, posing
from merge_runner_analysis.report.design import design
from merge_runner_analysis.stats.factors import levels_by_factor
from merge_runner_analysis.tables.against import FILES, against
from merge_runner_analysis.tables.formats import table_view
from merge_runner_analysis.tables.model import Column, Row, Table
from merge_runner_analysis.tables.verdicts import verdicts
from merge_runner_analysis.verdict_words import TABLE, sentences

TEMPLATES = Path(__file__).with_name("templates")
# At most so many trials are listed for a row: a page with all of them would be unwieldy.
LISTED = 300
LIBRARIES = ("statsmodels", "scipy", "numpy", "pandas", "matplotlib")


@dataclass
class Links:
    """The sources of all rows, numbered; rows with equal sources share a number."""

    study: Study
    found: dict[tuple[Source, ...], int] = field(default_factory=dict)

    def to(self, table: Table, row: Row, _column: Column) -> int:
        """The number under which the sources of a row are listed."""
        sources = sources_of(self.study, table, row)
        return self.found.setdefault(sources, len(self.found) + 1)


def report_html(study: Study, tables: list[Table], figures: dict[str, str]) -> str:
    """The report as one HTML document; ``figures`` maps names to SVG in Base64."""
    links = Links(study)
    empty = {
        "factors": not levels_by_factor(study),
        **{table.name: not table.rows for table in tables if table.name == "words"},
    }
    left_out = {name for name, is_empty in empty.items() if is_empty}
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
        table.name: table_view(table, links.to) for table in tables if table.name not in left_out
    }
    return environment.get_template("report.html").render(
        study=study,
        design=design(study, origin.sent),
        alarms=alarms(study, origin),
        headline=said[0],
        sentences=said[1:],
        posing=posing(study),
        figures=[
            {"name": name, "caption": FIGURES[name].caption, "data": data}
            for name, data in figures.items()
            if name not in left_out
        ],
        factors=views.pop("factors", None),
        tables=list(views.values()),
        beside=[
            table_view(against(table, study), links.to) for table in tables if table.name in FILES
        ],
        sources=[(number, sources) for sources, number in links.found.items()],
        listed=LISTED,
        command=sql_command(study),
        libraries=", ".join(f"{name} {version(name)}" for name in LIBRARIES),
        origin=origin,
        records=_records,
        readings=_records(published("readings")),
        sources_cited=_records(published("sources")),
        program=program(),
    )


def _records(frame: pd.DataFrame) -> list[dict[str, object]]:
    """Rows for a template: missing values become empty text, whole floats integers."""
    return [
        {str(name): _plain(value) for name, value in row.items()}
        for row in frame.to_dict(orient="records")
    ]


def _plain(value: object) -> object:
    if value is None or value is pd.NaT or (isinstance(value, float) and pd.isna(value)):
        return ""
    if isinstance(value, float):
        # Pandas turns a column of integers into floats where any is missing.
        return int(value) if value.is_integer() else round(value, 6)
    return value
