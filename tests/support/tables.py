"""The analysis's tables, as tests read them."""

from merge_runner_analysis.provenance import provenance
from merge_runner_analysis.tables import TABLES, make_tables
from merge_runner_analysis.web.report import alarms

# The comparison with humans takes seconds for each driver.
QUICK = [name for name in TABLES if name != "verdicts"]


def made(study, name):
    """A table of a study."""
    (table,) = make_tables(study, [name])
    return table


def by_id(table):
    """The rows of a table by their ids."""
    return {row.id: row for row in table.rows}


def values_of(study, name):
    """The values of a table of a study, by the ids of its rows."""
    return {row.id: row.values for row in made(study, name).rows}


def cell(table, row, column):
    return by_id(table)[row].values.get(column)


def notes_with(table, words):
    """The notes of a table that hold these words."""
    return [note for note in table.notes if words in note]


def alarms_of(study):
    found = alarms(study, provenance(study.db)).items()
    return {title: f"{'; '.join(texts)}. {meaning}" for title, (texts, meaning) in found}
