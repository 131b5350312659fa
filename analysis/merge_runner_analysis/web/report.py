"""The report: one HTML file with everything in it, which needs no network."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import datetime
from difflib import unified_diff
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pandas as pd
from pandas.api.types import is_string_dtype

from merge_runner.errors import UsageError
from merge_runner.prompts.blocks import BASELINE, title_of
from merge_runner.results.database import read_database
from merge_runner.results.provenance import program
from merge_runner_analysis.cache import cached, digest_of
from merge_runner_analysis.explain import Source, sources_of, sql_command
from merge_runner_analysis.figures import FIGURES
from merge_runner_analysis.figures.gallery import rendered, write_figures
from merge_runner_analysis.frames import KEYS
from merge_runner_analysis.grouping import levels_of
from merge_runner_analysis.headlines import sentences
from merge_runner_analysis.provenance import provenance
from merge_runner_analysis.published import published
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.table_format import TableFormat
from merge_runner_analysis.tables import finished_tables
from merge_runner_analysis.tables.against import FILES, against
from merge_runner_analysis.tables.comparison import comparison
from merge_runner_analysis.tables.formats import render, table_view
from merge_runner_analysis.tables.model import Column, Row, Table
from merge_runner_analysis.tables.verdicts import verdicts
from merge_runner_analysis.web.alarms import alarms
from merge_runner_analysis.web.comparison import Comparison, comparison_of, no_trials
from merge_runner_analysis.web.listing import judged_collisions
from merge_runner_analysis.web.names import names_mean, programs_of, short_names
from merge_runner_analysis.web.phrases import plain
from merge_runner_analysis.web.question import answer_of
from merge_runner_analysis.web.rendering import STYLE, environment, inlined_texts, policy_of
from merge_runner_analysis.web.scope import DESCRIPTIONS
from merge_runner_analysis.web.urls import Links
from merge_runner_analysis.wording import HUMANS, LANGUAGE_MODEL, TABLE

# The first prompt of each variant, all of the same condition as far as that was played.
PROMPTS = """
SELECT variant, spec_hash, arg_min(prompt, (condition, decisions.side, trial_id)) AS prompt
FROM decisions JOIN trials USING (trial_id, spec_hash)
WHERE decision = 0 AND prompt IS NOT NULL GROUP BY variant, spec_hash
ORDER BY min((condition, decisions.side, trial_id)) DESC
"""
# Trials listed for a row: a page with all of them would be unwieldy.
LISTED = 300
# Findings of an alarm that stand open, and the open tables of a study with factors.
FEW, ANSWERING = 3, ("effects", "levels")
LIBRARIES = ("statsmodels", "scipy", "numpy", "pandas", "matplotlib")


def write_report(
    study: StudyResults, out: Path, files: Path | None, say: Callable[[str], object] = str
) -> Iterator[Path]:
    """Write the report, and every table and figure into the folder ``files``; yields the paths.

    ``say`` gets what is computed just now. Raises UsageError.
    """
    say("computing the tables")
    tables = finished_tables(study.db, study=study)
    if files is not None:
        yield from write_figures(study, files)
        for table in tables:
            for form in TableFormat:
                path = files / f"{table.name}.{form.suffix}"
                path.write_text(render([table], form) + "\n", encoding="utf-8")
                yield path
    text = report_html(study, tables, finished_figures(study, figures_of(study, tables), say))
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text, encoding="utf-8")
    except OSError as exc:
        raise UsageError(f"{out} cannot be written: {exc}") from exc
    yield out


def figures_of(study: StudyResults, tables: Iterable[Table]) -> list[str]:
    """Return the names of the figures that show something else than the others."""
    with_rows = {table.name for table in tables if table.rows}
    left_out = {"effects"} - with_rows
    if study.groups == study.baselines:
        left_out.add("figure2-variants")
    return [name for name in FIGURES if name not in left_out]


def finished_figures(
    study: StudyResults, names: Iterable[str] = FIGURES, say: Callable[[str], object] = str
) -> dict[str, str]:
    """Return figures by name as SVG in Base64: the stored ones, else new drawings."""

    def draw(name: str) -> str:
        say(f"drawing {name}")
        return base64.b64encode(rendered(study, name, "svg")).decode()

    kept = study.db, study.state, study.options
    # A table may have the name alone.
    return {name: cached(*kept, f"{name}.svg", partial(draw, name)) for name in names}


def report_html(study: StudyResults, tables: list[Table], figures: dict[str, str]) -> str:
    """Return the report as one HTML document; ``figures`` maps names to SVG in Base64."""
    origin = provenance(study.db)
    descriptions, levels, prompts = design(study)
    made = {table.name: table for table in tables}
    rows = (made[TABLE] if TABLE in made else verdicts(study)).rows
    headline, *others = sentences(rows)
    answer, rest = headline, ""
    apart = _apart(study)
    kinds = {row.values["kind"] for row in rows} - {HUMANS}
    if apart and kinds == {LANGUAGE_MODEL}:  # two models are the question
        answer, rest = apart.claim, headline
    question = answer_of(made.get("effects"), made.get("levels"))
    if question:
        answer, rest = question.claim, question.rest
    views, numbers = _views(study, tables)
    inlined = inlined_texts([STYLE])
    templates = environment(Links(lambda _: ""), policy_of(inlined), inlined)
    return templates.get_template("report.html").render(
        study=study,
        descriptions=descriptions,
        levels=levels,
        prompts=prompts,
        alarms=alarms(study, origin),
        crashes=crashes(study),
        answer=answer,
        rest=rest,
        headline=headline,
        sentences=others,
        question=question,
        apart=apart,
        names_mean=names_mean(
            programs_of(study.frames.specs.values()), [group.driver for group in study.played]
        ),
        linked=False,
        part={},
        figures=[(name, FIGURES[name].caption, data) for name, data in figures.items()],
        tables=views,
        notes=_once(views),
        numbers=numbers,
        most=LISTED,
        few=FEW,
        answering=ANSWERING,
        command=sql_command(study),
        libraries=", ".join(f"{name} {version(name)}" for name in LIBRARIES),
        origin=origin,
        shown_plainly=_plain,
        readings=published("readings"),
        cited=published("sources"),
        program=program(),
        version=version("merge-runner"),
        played_at="",  # equal results give equal reports
        trials=len(study.frames.trials),
        digest=digest_of(study.db, study.state),
    )


def _views(
    study: StudyResults, tables: list[Table]
) -> tuple[list[dict[str, Any]], dict[tuple[Source, ...], int]]:
    """Return the tables as templates need them, and the sources of their rows, numbered from 1.

    Rows with equal sources share a number.
    """
    numbers: dict[tuple[Source, ...], int] = {}

    links: dict[tuple[str, str], str] = {}

    def link(table: Table, row: Row, _column: Column) -> str:
        if (place := (table.name, row.id)) not in links:
            number = numbers.setdefault(sources_of(study, table, row), len(numbers) + 1)
            links[place] = f"#source-{number}"
        return links[place]

    compared = (against(table, study) if table.name in FILES else table for table in tables)
    return [_without_constant(table_view(table, link)) for table in compared], numbers


def _without_constant(view: dict[str, Any]) -> dict[str, Any]:
    """Return a table with the ``places`` of columns to show: no prompt that all rows have.

    Its heading says that prompt. Rows of people have no prompt.
    """
    places = [*range(len(view["columns"]))]
    headings = [column["heading"] for column in view["columns"]]
    if "prompt" in headings and len(view["rows"]) > 1:
        place = headings.index("prompt")
        prompts = {row["cells"][place]["text"] for row in view["rows"]} - {""}
        if len(prompts) == 1:
            places.remove(place)
            view["heading"] += f"; prompt: {prompts.pop()}"
    return view | {"places": places}


def _apart(study: StudyResults) -> Comparison | None:
    """Return the comparison of two drivers, where just two had the reference prompt."""
    groups = [group for group in study.models if group.setting == study.reference]
    if len(groups) != 2:
        return None
    first, second = groups
    named = short_names([first.driver, second.driver])
    names = (named[first.driver], named[second.driver])
    of_left = all(
        (rows["focal"].isna() & (rows["model_left"] == rows["model_right"])).all()
        for rows in (first.trials, second.trials)
    )
    table = comparison(study, first.id, second.id)
    return comparison_of(table, names, (no_trials, no_trials), of_left=of_left)


def _once(tables: Iterable[Mapping[str, Any]]) -> dict[str, list[str]]:
    """Return notes by table, without notes that an earlier table has."""
    earlier: dict[str, None] = {}
    notes = {}
    for table in tables:
        notes[table["name"]] = [note for note in table["notes"] if note not in earlier]
        earlier |= dict.fromkeys(table["notes"])
    return notes


def design(study: StudyResults) -> tuple[list[str], dict[str, list[str]], dict[str, str]]:
    """Read the design of a study from what was played: descriptions, levels, prompts.

    Levels are by factor, then conditions and trials; prompts have by title the
    text of the first one, of variants the lines that differ from the baseline's.
    """
    described, shown_to = study.read(DESCRIPTIONS), study.read(PROMPTS)
    played, levels = study.played, levels_of(study.played, study.order)
    levels.pop("model", None)  # the drivers say it
    specs = {name for group in played for name in group.trials["spec_hash"]}
    prompts = shown_to[shown_to["spec_hash"].isin(specs)]
    texts = dict(zip(prompts["variant"], prompts["prompt"], strict=True))
    baseline = texts.get(BASELINE)
    shown = {}
    for name in dict.fromkeys(group.setting for group in played if group.setting in texts):
        title, text = title_of(name), texts[name]
        if baseline and name != BASELINE:
            title, text = f"{title}: against the baseline", _changes(baseline, text)
        shown[title] = text
    return (
        list(described["description"])
        if study.source is None
        else [study.source.file.description] * bool(study.source.file.description),
        {
            "drivers": [group.label for group in played],
            **{name: [*known] for name, known in levels.items()},
            "conditions": sorted({name for group in played for name in group.trials["condition"]}),
            "trials": [str(sum(len(group.trials) for group in played))],
        },
        shown,
    )


def _changes(baseline: str, prompt: str) -> str:
    """Return the lines that were taken out (-) and put in (+)."""
    lines = unified_diff(baseline.splitlines(), prompt.splitlines(), lineterm="", n=0)
    return "\n".join(line for line in lines if not line.startswith(("---", "+++", "@@")))


def _plain(rows: pd.DataFrame) -> tuple[list[str], list[list[str]]]:
    """Return rows of the database as a reader sees them; # stands before the names of numbers."""
    frame = rows.convert_dtypes()
    names = [
        ("" if is_string_dtype(frame[name]) else "#")
        + str(name).replace("_usd", " (USD)").replace("_", " ")
        for name in frame
    ]
    cells = [
        ["" if pd.isna(value) else _shown(value) for value in row]
        for row in frame.itertuples(index=False)
    ]
    return names, cells


def _shown(value: object) -> str:
    match value:
        case float():
            return f"{value:.6g}"
        case datetime():
            return f"{value:%Y-%m-%d %H:%M:%S}"
    return str(value)


def crashes(study: StudyResults) -> dict[str, dict[str, int]]:
    """Return the number of crashes of each driver and prompt by cause, the most first."""
    with read_database(study.db) as connection:
        causes = {(name, spec): cause for name, spec, cause in judged_collisions(connection)}
    counted: dict[str, dict[str, int]] = {}
    for group in study.played:
        crashed = group.trials.loc[group.trials["status"] == "collided", KEYS]
        keys = crashed.itertuples(index=False, name=None)
        of_group = Counter(plain(cause) for key in keys if (cause := causes.get(key)))
        if of_group:
            counted[group.id] = dict(of_group.most_common())
    return counted
