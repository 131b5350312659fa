"""The notebooks of the docs, executed as notebooks."""

import asyncio
import os
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import nbformat
import pytest
from nbclient import NotebookClient

from tests.support.harness import CONFIGURING, PROJECT, asked_to_write

NOTEBOOKS = sorted((PROJECT / "docs/notebooks").glob("*.ipynb"))
PICTURE = "a picture"


def code(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


async def execute(notebook, folder):
    """Run all cells in a folder; what they print stands below them."""
    client = NotebookClient(
        notebook, timeout=120, record_timing=False, resources={"metadata": {"path": str(folder)}}
    )
    await client.async_execute()


@pytest.fixture(scope="module")
def executed(tmp_path_factory, emulator_url):
    """Executes a notebook in an empty folder, beside an emulator."""

    async def run(notebook):
        for name in [name for name in os.environ if name.endswith(CONFIGURING)]:
            del os.environ[name]
        os.environ |= {"EMULATOR_BASE_URL": emulator_url, "PYTHONPATH": str(PROJECT)}
        await execute(notebook, tmp_path_factory.mktemp("notebook"))
        return code(notebook)

    with patch.dict(os.environ):
        yield run


def results(cells):
    """The value of each cell as text, and its pictures; the summary of a run names times."""
    kinds = ("execute_result", "display_data")
    values = [
        PICTURE if "image/png" in out.data else out.data["text/plain"]
        for cell in cells
        for out in cell.outputs
        if out.output_type in kinds and "decisions: " not in out.data["text/plain"]
    ]
    return [value for value in values if "trials: " not in value]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: Path(path).stem)
async def test_a_notebook_is_stored_with_what_its_cells_print_and_a_figure(executed, path):
    stored = nbformat.read(path, as_version=4)
    before = results(code(stored))
    assert PICTURE in before
    assert results(await executed(stored)) == before


def main(*arguments: str) -> None:
    """Write what the cells print, where that is asked for."""
    asked_to_write(arguments, "what the cells of docs/notebooks print below them")
    for path in NOTEBOOKS:
        notebook = nbformat.read(path, as_version=4)
        with TemporaryDirectory() as folder:
            asyncio.run(execute(notebook, folder))
        nbformat.write(notebook, path)


if __name__ == "__main__":
    main(*sys.argv[1:])
