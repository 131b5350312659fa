"""The program's tables are those that independent code makes of the same database."""

import pytest

from analysis.research.independent.compare import compare
from tests.support.odd_databases import made

KINDS = (
    "emulator", "smollm2", "smollm2-free", "two_studies", "crossed_programs", "mirrored_chance",
    "separated", "all_tied", "complete_import",
)  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_independent_code_finds_the_numbers_of_the_tables(kind, tmp_path):
    db = made(tmp_path, kind)
    assert compare(db, imported=kind == "complete_import") == []
    if db.with_name("study.toml").exists():
        assert compare(db, "study") == []
