"""The paper's tables, and further tables for questions that those leave open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from merge_runner.errors import unknown_name
from merge_runner.registry import in_use_for, using
from merge_runner_analysis.cache import cache_finished, finished, present_state
from merge_runner_analysis.selection import Selection
from merge_runner_analysis.tables.formats import names_of, value_rows
from merge_runner_analysis.tables.model import Row, Table, from_text, to_text

if TYPE_CHECKING:
    import pandas as pd

    from merge_runner_analysis.study import StudyResults


class Listed(NamedTuple):
    """A table as lists show it: its title, and its number in the paper."""

    title: str
    number: str = ""

    @property
    def about(self) -> str:
        """Number and title."""
        return f"{self.number}: {self.title}" if self.number else self.title


TABLES = {
    "verdicts": Listed("Drivers compared with humans, measure by measure"),
    "who-first": Listed("Logistic regression of which driver merged first (1: left)", "Table III"),
    "gap": Listed(
        "Linear regression of the gap at the merge point (m, net of the vehicle length)",
        "Table IV",
    ),
    "indicators": Listed(
        "Qualitative and quantitative indicators of behaviour during merging conflicts",
        "Table V",
    ),
    "ablation-qualitative": Listed(
        "Alignment with qualitative indicators of human behaviour across prompt ablations",
        "Table VI",
    ),
    "ablation-quantitative": Listed("Quantitative measures across prompt ablations", "Table VII"),
    "effects": Listed("Effects of factors: each level against the reference, in every measure"),
    "levels": Listed("Means and rates at each level of each factor, and at combinations of levels"),
    "contrasts": Listed("Differences between prompts"),
    "factors": Listed(
        "Every metric at each level of each factor, and the difference from the reference"
    ),
    "criticality": Listed("When conflicts are resolved, and how close the vehicles come"),
    "attempts": Listed("Outcomes of calls: attempts, failures and invalid replies"),
    "first-action": Listed(
        "Net acceleration (m/s²) at the first decision, by own relative velocity"
    ),
}
# The table that also has drivers that were only asked.
OF_ASKED = "first-action"


def make_tables(study: StudyResults, names: Sequence[str] = ()) -> list[Table]:
    """Compute the named tables, or all of them; raises UsageError for an unknown name."""
    return [_made(name, study) for name in _valid(names)]


def _made(name: str, study: StudyResults) -> Table:
    """Return a table with its notes, and a row with a note alone for each group not judged."""
    # Imported only here, so that a table that is kept is shown without waiting for pandas.
    from merge_runner_analysis.tables.makers import MAKERS
    from merge_runner_analysis.tables.notes import footnoted

    table = MAKERS[name](study)
    shown = {name for row in table.rows for name in row.groups}
    first = table.columns[0].name
    of_drivers = any(column.name == "driver" for column in table.columns)
    rows = [
        Row(
            group.id,
            (group.id,),
            {"driver": group.label, "setting": group.setting} if of_drivers else {first: group.id},
            group.unjudged,
        )
        for group in study.unjudged + (study.unjudged_probes if name == OF_ASKED else [])
        if group.id not in shown
    ]
    title, number = TABLES[name].title, TABLES[name].number
    whole = replace(table, rows=[*table.rows, *rows], title=title, number=number)
    return footnoted(whole, study)


def finished_tables(
    db: Path,
    names: Sequence[str] = (),
    study: StudyResults | None = None,
    selection: Selection | None = None,
) -> list[Table]:
    """Return a database's tables, cached or computed. Raises UsageError."""
    chosen, selection = _valid(names), selection or Selection()
    options = study.options if study else selection.key(db)
    state = study.state if study else present_state(db)
    tables = {name: from_text(text) for name, text in finished(db, state, options, chosen).items()}
    # A name may be given twice; the table is computed once.
    missing = [name for name in dict.fromkeys(chosen) if name not in tables]
    if missing:
        from merge_runner_analysis.study import StudyResults

        study = study or StudyResults(db, selection)
        made = dict(zip(missing, make_tables(study, missing), strict=True))
        # The state is the one before the study was read: trials stored since then outdate it.
        cache_finished(db, study.state, options, {name: to_text(made[name]) for name in missing})
        tables |= made
    return [tables[name] for name in chosen]


def table(
    study: StudyResults | Path | str, name: str, selection: Selection | None = None
) -> pd.DataFrame:
    """Return a table of a study, or of a database's ``selection``, as its CSV has it.

    Values have full precision, and plug-ins of the study are in use. Raises UsageError.
    """
    import pandas as pd

    from merge_runner.results.frames import TEXT
    from merge_runner_analysis.study import StudyResults

    with using(in_use_for(study.db if isinstance(study, StudyResults) else Path(study))):
        read = (
            study
            if isinstance(study, StudyResults)
            else StudyResults(study, selection or Selection())
        )
        (made,) = make_tables(read, [name])
        frame = pd.DataFrame(value_rows(made), columns=names_of(made)).set_index("row")
    # pandas cannot infer the type of a column without a value.
    texts = {"note", *(column.name for column in made.columns if column.kind == "text")}
    missing = [name for name in frame if frame[name].isna().all()]
    return frame.astype({name: TEXT if name in texts else "float64" for name in missing})


def _valid(names: Sequence[str]) -> Sequence[str]:
    for name in names:
        if name not in TABLES:
            raise unknown_name("table", name, TABLES)
    return names or tuple(TABLES)
