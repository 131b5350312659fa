"""The commands of the analysis; libraries are imported where they are used, to start at once."""

from __future__ import annotations

import gc
import json
import re
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from merge_runner.cli import app
from merge_runner.cli import options as cli
from merge_runner.cli.app import KEEP, LOOK, PLAY
from merge_runner.cli.options import (
    DbOption,
    StudyOption,
    TrustOption,
    beside_study,
    flag,
    listed,
    option,
    print_out,
    terminal_width,
    use_study,
)
from merge_runner.errors import UsageError
from merge_runner.paths import DEFAULT_CACHE, DEFAULT_DB, check_kind
from merge_runner.text_safety import say
from merge_runner_analysis.humans.commands import human_app
from merge_runner_analysis.selection import Selection
from merge_runner_analysis.table_format import TableFormat

if TYPE_CHECKING:
    from merge_runner_analysis.study import StudyResults

HTML = b"<!doctype html"
TOLD_EVERY = 100  # pages

NAMES = (
    "Tables, all if none is named: verdicts, who-first, gap, indicators, ablation-qualitative, "
    "ablation-quantitative, effects, levels, contrasts, factors, criticality, attempts, "
    "first-action."
)

app.add_typer(human_app, name="human", rich_help_panel=KEEP)

MODELS = "Only these drivers, separated by commas; human is one."
WHERE = "Only humans, and trials at this level of a factor, such as prompt=A1; may be repeated."
RUN = "Only humans, and trials of runs with this --name or sweep_id."
BY = "With the table effects: effects at each level of this factor, and its interactions."
NAME, ROW = "A table's name.", "ROW, or ROW:COLUMN; without it rows are listed."
ALL = "All trials, also those that the value does not count."
OUT, HTML_FILE = "The folder to write to.", "The HTML file to write."
ALSO, EXPORT = (
    "Also write all tables and figures here.",
    "A new folder, or the folder of an earlier export.",
)
SINGLE, STUDY_FILE = "Write one page with the --trials.", "experiments/STUDY.toml, or a path."
FORM = "text (the default), csv, json, md or latex."
AGAINST = "Add published values and differences, for drivers with the paper's names."
WITHOUT = "Only trials in which each reply has a valid plan."
WIDE = "All columns, even if the terminal is narrower."
TRIALS = "Trials to write: names, separated by commas; * matches any text."
READER = "Your name in notes; default: your user name."
ModelsOption = Annotated[str | None, option("A,B", MODELS, "--models")]
WhereOption = Annotated[list[str] | None, option("FACTOR=LEVEL", WHERE, "--where")]
RunOption = Annotated[str | None, option("NAME", RUN, "--run")]
ByOption = Annotated[str | None, option("FACTOR", BY, "--by")]


def _table_names() -> list[str]:
    from merge_runner_analysis.tables import TABLES

    return list(TABLES)


@app.command(rich_help_panel=LOOK)
def tables(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="NAME", autocompletion=_table_names, help=NAMES)
    ] = None,
    db: DbOption = DEFAULT_DB,
    models: ModelsOption = None,
    where: WhereOption = None,
    run: RunOption = None,
    study_file: StudyOption = None,
    trust: TrustOption = False,
    output: Annotated[
        TableFormat, option("FORM", FORM, "--format", show_default=False)
    ] = TableFormat.TEXT,
    against: Annotated[str | None, option("paper", AGAINST, "--against")] = None,
    by: ByOption = None,
    without_fallbacks: Annotated[bool, flag("--without-fallbacks", WITHOUT)] = False,
    wide: Annotated[bool, flag("--wide", WIDE)] = False,
    as_json: cli.JsonOption = False,
) -> None:
    """Print the paper's tables, and further ones.

    Example: merge-runner tables who-first gap --format csv
    """
    if by is not None and (not names or not {*names} <= {"effects", "factors"}):
        raise UsageError("--by FACTOR goes with the table effects: tables effects --by FACTOR")
    use_study(study_file, trust=trust)
    from merge_runner_analysis.tables import finished_tables
    from merge_runner_analysis.tables.formats import render

    selection = _selection(
        models, where, study_file, by, run=run, without_fallbacks=without_fallbacks
    )
    if against is None:
        made = finished_tables(db, names or (), selection=selection)
    else:
        from merge_runner_analysis.study import StudyResults
        from merge_runner_analysis.tables.against import PAPER
        from merge_runner_analysis.tables.against import against as with_paper

        if against != PAPER:
            raise UsageError(f"--against {against}: valid is {PAPER}")
        study = StudyResults(db, selection)
        made = [with_paper(table, study) for table in finished_tables(db, names or (), study)]
    width = None if wide else terminal_width()
    print_out(render(made, TableFormat.JSON if as_json else output, width))


@app.command(rich_help_panel=LOOK)
def explain(
    table: Annotated[str, typer.Argument(metavar="TABLE", autocompletion=_table_names, help=NAME)],
    cell: Annotated[str, typer.Argument(metavar="ROW", help=ROW)] = "",
    db: DbOption = DEFAULT_DB,
    where: WhereOption = None,
    run: RunOption = None,
    study_file: StudyOption = None,
    trust: TrustOption = False,
    by: ByOption = None,
    whole: Annotated[bool, flag("--all", ALL)] = False,
    as_json: cli.JsonOption = False,
) -> None:
    """Explain a row of a table: its query and its trials.

    Example: merge-runner explain ablation-quantitative emulator/baseline:collided_percent
    """
    study = _study(db, _selection(where=where, file=study_file, by=by, run=run), trust=trust)
    from merge_runner_analysis.explain import explain as explain_cell
    from merge_runner_analysis.tables import finished_tables

    (made,) = finished_tables(db, [table], study)
    if not cell:
        names = {"rows": [row.id for row in made.rows], "columns": [c.name for c in made.columns]}
        columns = f"columns, each after ROW and a colon: {', '.join(names['columns'])}"
        lines = [*names["rows"], columns]
        print_out(json.dumps(names, indent=2) if as_json else "\n".join(lines))
        return
    explanation = explain_cell(study, made, cell)
    if as_json:
        sources = [source._asdict() for source in explanation.sources]
        facts = {**explanation._asdict(), "sources": sources}
        print_out(json.dumps(facts, indent=2, ensure_ascii=False))
    else:
        print_out("\n".join(explanation.lines(whole=whole)))


@app.command(rich_help_panel=PLAY)
def power(
    study: Annotated[str, typer.Argument(metavar="STUDY", help=STUDY_FILE)],
    model: cli.ModelOption = None,
    only: cli.OnlyOption = None,
    reps: cli.RepsOption = None,
    conditions: cli.ConditionsOption = None,
    variants: cli.VariantsOption = None,
    sims: Annotated[
        int, option("N", "Simulated studies for each number of repetitions.", min=20)
    ] = 100,
    db: DbOption = DEFAULT_DB,
    cache: cli.CacheOption = DEFAULT_CACHE,
    trust: TrustOption = False,
    as_json: cli.JsonOption = False,
) -> None:
    """Estimate which effects a study can detect, and its cost; send nothing.

    Example: merge-runner power my-study/study.toml
    """
    import asyncio

    from merge_runner.registry import use
    from merge_runner.run.options import Options
    from merge_runner.run.plan import make_plan
    from merge_runner.run.sweep import unsent
    from merge_runner_analysis.power import chances, power_table, unread_words
    from merge_runner_analysis.study import StudyResults
    from merge_runner_analysis.tables.formats import render

    plan = make_plan(
        study,
        models=model or (),
        repetitions=reps,
        conditions=listed(conditions),
        variants=listed(variants),
        only=cli.levels(only or (), "--only"),
        trust=trust,
    )
    use(plan.parts.catalogue)
    expected = asyncio.run(unsent(plan, Options(db=db, cache=cache), say=say, whole=True))
    cost_usd = 0.0 if expected.free else expected.cost_usd
    played = StudyResults(db).models if db.exists() else []
    with _status_line("simulating") as say_now:
        rows = list(chances(plan, cost_usd, played, sims, say_now))
    if as_json:
        facts = {"study": plan.name, "trials": plan.trials, "cost_usd": cost_usd}
        print_out(json.dumps({**facts, "chances": [row.values for row in rows]}))
        return
    costs = "an unknown price" if cost_usd is None else f"about {cost_usd:.2f} USD"
    about = f"{plan.name} ({plan.driver}, {plan.trials} trials, {costs}; {sims} simulated studies)"
    table = power_table(f"What can be found by {about}", rows, unread_words(plan))
    print_out(render([table], TableFormat.TEXT, terminal_width()))


@app.command(rich_help_panel=LOOK)
def figures(
    out: Annotated[Path, option("DIR", OUT, "--out", callback=beside_study)] = Path(
        "results/figures"
    ),
    db: DbOption = DEFAULT_DB,
    models: ModelsOption = None,
    where: WhereOption = None,
    run: RunOption = None,
    study_file: StudyOption = None,
    trust: TrustOption = False,
) -> None:
    """Draw all figures as PDF, SVG and PNG, with their numbers as CSV.

    Example: merge-runner figures --out results/figures
    """
    study = _study(db, _selection(models, where, study_file, run=run), trust=trust)
    from merge_runner_analysis.figures.gallery import write_figures

    with _while_computed(study, "figures") as say_now:
        for path in write_figures(study, out):
            say_now(f"wrote {path}")
    print_out(f"wrote the figures into {out}")


@app.command(rich_help_panel=KEEP)
def export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help=EXPORT)],
    db: DbOption = DEFAULT_DB,
    study_file: StudyOption = None,
) -> None:
    """Write every table as Parquet and CSV, with all columns explained.

    Example: merge-runner export results/tables
    """
    from merge_runner.results.export import export_tables

    export_tables(db, folder, cli.runs_of_study(study_file, db))
    print_out(f"wrote every table into {folder}: begin with {folder / 'dictionary.csv'}")


@app.command(rich_help_panel=LOOK)
def report(
    out: Annotated[Path, option("FILE", HTML_FILE, "--out", callback=beside_study)] = Path(
        "results/report.html"
    ),
    files: Annotated[Path | None, option("DIR", ALSO, "--files")] = None,
    db: DbOption = DEFAULT_DB,
    models: ModelsOption = None,
    where: WhereOption = None,
    run: RunOption = None,
    study_file: StudyOption = None,
    trust: TrustOption = False,
) -> None:
    """Write conclusions, tables and figures as one HTML file.

    Example: merge-runner report --study my-study/study.toml
    """
    check_kind(out, HTML, "page of HTML")
    gc.set_threshold(0)  # what a report makes lasts until it ends: there is no garbage to look for
    study = _study(db, _selection(models, where, study_file, run=run), trust=trust)
    from merge_runner_analysis.web.report import write_report

    with _while_computed(study, "tables and figures") as say_now:
        for path in write_report(study, out, files, say_now):
            say_now(f"wrote {path}")
    also = "" if files is None else f", and its tables and figures into {files}"
    print_out(f"wrote {out}{also}")


@contextmanager
def _while_computed(study: StudyResults, what: str) -> Iterator[Callable[[str], None]]:
    """Announce a long computation, and show its progress in a terminal."""
    say(
        f"computing the {what} of {len(study.frames.trials)} trials; a thousand take about a minute"
    )
    with _status_line(what) as say_now:
        yield say_now


@contextmanager
def _status_line(what: str) -> Iterator[Callable[[str], None]]:
    """Show a line of progress in a terminal; the body passes its new texts."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.markup import escape

    with Console(stderr=True).status(what) as status:
        yield lambda text: status.update(escape(text))


def open_browser(address: str) -> bool:
    """Open a page in a browser, where somebody sits at a terminal with a screen; return whether."""
    import webbrowser

    from merge_runner.config import has_screen

    if not (sys.stdout.isatty() and has_screen()):
        return False
    # In a thread: the browser asks for a page that is served only once this has returned.
    threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()
    return True


def _selection(
    models: str | None = None,
    where: Sequence[str] | None = None,
    file: str | None = None,
    by: str | None = None,
    *,
    run: str | None = None,
    without_fallbacks: bool = False,
) -> Selection:
    levels = cli.levels(where or (), "--where") or None
    return Selection(drivers(models), levels, file, by, without_fallbacks, run or "")


def _study(db: Path, selection: Selection, *, trust: bool) -> StudyResults:
    use_study(selection.file, trust=trust)
    from merge_runner_analysis.study import StudyResults

    return StudyResults(db, selection)


def drivers(text: str | None) -> list[str] | None:
    """Return the drivers that an option names; commas within brackets separate a driver's levels.

    >>> drivers("human, o3 [reasoning_effort=low, temperature=0.2]")
    ['human', 'o3 [reasoning_effort=low, temperature=0.2]']
    """
    if text is None:
        return None
    return [part.strip() for part in re.split(r",(?![^\[]*\])", text) if part.strip()]


@app.command(rich_help_panel=LOOK)
def view(
    port: Annotated[int, option("N", "0: any free port.", min=0, max=65535)] = 8700,
    export: Annotated[
        Path | None, option("DIR", "Write a folder of pages instead of serving.", "--export")
    ] = None,
    single: Annotated[Path | None, option("FILE", SINGLE, "--single")] = None,
    trials: Annotated[str | None, option("NAMES", TRIALS, "--trials")] = None,
    no_open: Annotated[bool, flag("--no-open", "Do not open a browser.")] = False,
    reader: Annotated[str | None, option("NAME", READER, "--reader")] = None,
    db: DbOption = DEFAULT_DB,
    study_file: StudyOption = None,
    trust: TrustOption = False,
) -> None:
    """Serve the explorer: trials, decisions and sweeps in a browser.

    Example: merge-runner view --study my-study/study.toml
    """
    use_study(study_file, trust=trust)
    patterns = listed(trials) or []
    if trials is not None and export is None and single is None:
        raise UsageError("--trials goes with --export DIR or --single FILE.html")
    if trials is None and single is not None:
        raise UsageError("--single FILE.html needs --trials: name some, or all with '*'")
    from merge_runner_analysis.web.app import serve
    from merge_runner_analysis.web.export import export_folder, export_page
    from merge_runner_analysis.web.note_file import reader_of

    def announce(address: str) -> None:
        print_out(address)
        opened = not no_open and open_browser(address)
        say(f"{'' if opened else 'open this address in a browser; '}Ctrl-C ends the explorer")

    def progress(pages: int) -> None:
        if pages % TOLD_EVERY == 0:
            say(f"{pages} pages so far")

    if export is not None:
        say(f"open {export_folder(db, export, patterns, progress)}, or send the folder {export}")
    if single is not None:
        say(f"wrote {export_page(db, single, patterns)}")
    if export is None and single is None:
        serve(db, port, announce, reader_of(reader), study_file or "")
