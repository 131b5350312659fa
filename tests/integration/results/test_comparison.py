"""A trial that is played again is compared with the stored one in every column."""

import pytest

from merge_runner.results.database import schema_sql
from merge_runner.results.instance import in_memory
from merge_runner.results.rows import KEY_COLUMNS, rows_of, stored_rows
from merge_runner.results.store import RUN_COLUMNS
from tests.support.studies import Drive, Said, played

ANOTHER = {
    "VARCHAR": "coalesce({0}, '') || 'x'", "JSON": "'[0]'", "BOOLEAN": "NOT coalesce({0}, false)",
    "DOUBLE[]": "[1.0]", "TIMESTAMP": "TIMESTAMP '2026-01-01 00:00:01'",
}  # fmt: skip


SAID = {1: Said(("overloaded", "ok")), 2: Said(failure="no_array")}
RECORD = played(Drive("o3\u20ac", "baseline", "L_4_0", 1, (0.1,), (0.0,), SAID))
HASH = RECORD.spec.spec_hash
KEY = (RECORD.spec.trial_id, HASH)


@pytest.fixture
def stored():
    """A database with the trial, and another one beside it."""
    connection = in_memory({})
    connection.execute(schema_sql())
    for table, rows in rows_of(RECORD).items():
        appender = connection.appender(table)
        appender.append_rows(rows)
        appender.append_rows([tuple("g" if v == HASH else v for v in row) for row in rows])
        appender.flush()
    yield connection
    connection.close()


def differing(connection, **how) -> list[str]:
    """The names of what is stored otherwise."""
    made = rows_of(RECORD)
    return [
        difference.name
        for table in KEY_COLUMNS
        for difference in stored_rows(connection, table, [KEY]).differences(KEY, made[table], **how)
    ]


with in_memory({}) as connection:
    connection.execute(schema_sql())
    COLUMNS = connection.execute(
        "SELECT table_name, column_name, data_type FROM duckdb_columns() "
        "WHERE table_name IN ('trials', 'states', 'decisions', 'calls') "
        "AND column_name NOT IN ('trial_id', 'spec_hash')"
    ).fetchall()


def change(stored, columns) -> None:
    """Change these columns of the first row that a table has of the trial."""
    for table, column, kind in columns:
        other = ANOTHER.get(kind, "coalesce({0}, 0) + 1").format(column)
        stored.execute(f"UPDATE {table} SET {column} = {other} WHERE rowid = "
                       f"(SELECT min(rowid) FROM {table} WHERE spec_hash = '{HASH}')")  # fmt: skip


@pytest.mark.parametrize("first", [0, 1])
def test_every_second_column_that_is_changed_is_found_and_no_other(stored, first):
    changed = [each for each in COLUMNS if each[1] not in KEY_COLUMNS[each[0]]][first::2]
    change(stored, changed)
    names = [f"{table}.{column}" for table, column, _ in changed]
    assert sorted(differing(stored)) == sorted(names)
    lasting = [name for name in names if name.partition(".")[2] not in RUN_COLUMNS]
    assert sorted(differing(stored, ignored=RUN_COLUMNS)) == sorted(lasting)


@pytest.mark.parametrize("place", [each for each in COLUMNS if each[1] in KEY_COLUMNS[each[0]]])
def test_a_row_at_another_place_is_another_row(stored, place):
    assert differing(stored) == []
    change(stored, [place])
    assert differing(stored) == [f"rows of {place[0]}"]


def test_rows_that_lack_or_are_too_many_are_counted(stored):
    stored.execute(f"DELETE FROM states WHERE spec_hash = '{HASH}' AND step = 3")
    stored.execute(
        f"INSERT INTO decisions FROM decisions WHERE spec_hash = '{HASH}' AND decision = 1"
    )
    states = stored_rows(stored, "states", [KEY])
    (difference,) = states.differences(KEY, rows_of(RECORD)["states"])
    assert difference.place == {"step": 3, "side": "left"}
    assert difference.text.endswith("at step 3 are missing or too many, and 1 more in the trial")
    assert differing(stored) == ["rows of states", "rows of decisions"]


def test_a_tolerance_holds_for_numbers_alone_and_those_of_lists_too(stored):
    stored.execute("UPDATE states SET position_m = position_m + 1e-12 WHERE step = 3")
    stored.execute("UPDATE decisions SET applied = list_transform(applied, lambda a : a + 1e-12)")
    assert differing(stored) == ["states.position_m", "decisions.applied"]
    assert differing(stored, tolerance=1e-9) == []
