"""What the docs say of prices, and what no file of the project says."""

import re
import subprocess

import pytest

from tests.support import program
from tests.support.harness import PROJECT, environment

RECORD = (PROJECT / "docs/recordings.md").read_text()
BINARY = (".parquet", ".duckdb", ".png", ".gz")


@pytest.mark.parametrize(
    "row", re.findall(r"^\| .*, (?:baseline|ablations) \|.*", RECORD, re.MULTILINE)
)
def test_the_page_on_recording_has_the_prices_that_a_dry_run_prints(tmp_path, row):
    what, *figures = (cell.strip() for cell in row.strip("|").split("|"))
    model, sweep = what.split(", ")
    asked = ("sweep", sweep, "--model", model, "--batch", "--dry-run", "--json")
    told = program.invoke(asked, cwd=tmp_path, env=environment()).summary
    singly, batched = (f"{told[name]:.2f}" for name in ("singly_usd", "cost_usd"))
    counts = [str(told[name]) for name in ("calls", "input_tokens", "output_tokens")]
    assert figures == [*counts, singly, str(told["minutes"]), batched]


def test_the_project_names_no_path_and_no_index_of_its_maker():
    listed = subprocess.check_output(["git", "ls-files"], cwd=PROJECT, text=True).split()
    for path in (PROJECT / name for name in listed):
        if path.is_file() and path.suffix not in BINARY:
            found = re.search(r"--(extra-)?index-url|/simpl[e]/|[.][.]/shared", path.read_text())
            assert not found, f"{path}: {found}"
