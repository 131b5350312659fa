"""The numbers of every table, of shipped recordings and odd databases, stay what they are.

``python -m tests.integration.test_frozen_numbers --write`` renews them; what is equal but for noise
keeps its digits.
"""

import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from tests.support.frozen import MORE_DATABASES, NUMBERS, check, kept, tables_of
from tests.support.harness import asked_to_write

DATABASES = ("emulator", "separated")


@pytest.mark.parametrize("name", DATABASES)
def test_every_number_of_every_table_is_what_it_was(name, tmp_path):
    check(name, tmp_path)


def _text(frozen: dict) -> str:
    """As JSON, a row of a table a line."""

    def block(entries, indent):
        space = "\n" + " " * indent
        return "{" + ",".join(f"{space}{json.dumps(k)}: {v}" for k, v in entries) + "}"

    def table(one):
        rows = block([(row, json.dumps(v)) for row, v in one["rows"].items()], 3)
        return f'{{"columns": {json.dumps(one["columns"])}, "rows": {rows}}}'

    return block(
        [(db, block([(n, table(t)) for n, t in of.items()], 2)) for db, of in frozen.items()], 1
    )


if __name__ == "__main__":
    asked_to_write(sys.argv[1:], f"the numbers of every table into {NUMBERS}")
    known, renewed = json.loads(NUMBERS.read_text()), {}
    for each in (*DATABASES, *MORE_DATABASES):
        with TemporaryDirectory() as place:
            renewed[each] = kept(known.get(each, {}), tables_of(each, Path(place)))
    NUMBERS.write_text(_text(renewed) + "\n")
