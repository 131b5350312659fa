"""A database opens in the oldest DuckDB that is promised, with every table and view."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from merge_runner.results.store import query

OLDEST = "1.2.2"
READ = """
import json, sys
sys.path.insert(0, sys.argv[1])
import duckdb
connection = duckdb.connect(sys.argv[2], read_only=True)
names = connection.execute(
    "SELECT table_name FROM duckdb_tables() UNION ALL "
    "SELECT view_name FROM duckdb_views() WHERE NOT internal"
).fetchall()
read = {name: len(connection.execute(f"FROM {name}").fetchall()) for (name,) in names}
measured = connection.execute(sys.argv[3]).fetchall()
print(json.dumps([duckdb.__version__, read, measured]))
"""
MEASURED = (
    "SELECT driver, trial_metrics.* FROM trial_drivers JOIN trial_metrics "
    "USING (trial_id, spec_hash) ORDER BY trial_id"
)


@pytest.fixture(scope="module")
def old_client(tmp_path_factory) -> Path:
    """A folder with the old DuckDB."""
    folder = tmp_path_factory.mktemp("old-duckdb")
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--only-binary=:all:"]
    done = subprocess.run(
        [*pip, "--target", folder, f"duckdb=={OLDEST}"],
        capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    if done.returncode:
        pytest.skip(f"DuckDB {OLDEST} cannot be installed here: {done.stderr.strip()[-200:]}")
    return folder


def read_by(client: Path, db: Path) -> dict[str, int]:
    """How many rows the old client finds in each table and view; it measures what we do."""
    done = subprocess.run(
        [sys.executable, "-c", READ, client, db, MEASURED],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    version, rows, measured = json.loads(done.stdout)
    assert version == OLDEST
    ours = [list(row) for row in query(db, MEASURED)[1]]
    assert [row[0] for row in measured] == [row[0] for row in ours]
    for theirs, own in zip(measured, ours, strict=True):
        assert theirs == pytest.approx(own, nan_ok=True)
    return rows


async def test_an_old_duckdb_reads_every_table_and_view(merge_runner, tmp_path, old_client):
    await merge_runner("sweep", "baseline", "--reps", 1, "--conditions", "N_0_0", code=0)
    rows = read_by(old_client, tmp_path / "results/merge.duckdb")
    assert rows["trial_metrics"] == rows["trials"] == 1
    assert min(rows[name] for name in ("states", "attempts", "geometry")) > 0
