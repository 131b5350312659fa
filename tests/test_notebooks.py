"""The notebooks of the docs, executed as notebooks."""

from __future__ import annotations

import os
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from tests.harness import CONFIGURING, PROJECT

NOTEBOOKS = sorted((PROJECT / "docs/notebooks").glob("*.ipynb"))
RUN_A_STUDY, OWN = "run-a-study", "own-driver-and-metric"


def code(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def shown(cell) -> str:
    """What stands below a cell, as text."""
    texts = [out.text if "text" in out else out["data"]["text/plain"] for out in cell.outputs]
    return "\n".join(texts)


@pytest.fixture(scope="module")
def executed(tmp_path_factory, emulator_url):
    """Executes a notebook in an empty folder, beside an emulator."""

    async def run(notebook):
        for name in [name for name in os.environ if name.endswith(CONFIGURING)]:
            del os.environ[name]
        os.environ |= {"EMULATOR_BASE_URL": emulator_url, "PYTHONPATH": str(PROJECT)}
        folder = tmp_path_factory.mktemp("notebook")
        client = NotebookClient(
            notebook, timeout=120, resources={"metadata": {"path": str(folder)}}
        )
        await client.async_execute()
        return code(notebook)

    before = dict(os.environ)
    yield run
    os.environ.clear()
    os.environ.update(before)


def named(name: str):
    return nbformat.read(PROJECT / f"docs/notebooks/{name}.ipynb", as_version=4)


@pytest.mark.slow
async def test_a_study_is_run_in_a_notebook_and_looked_at_by_factor(executed):
    cells = await executed(named(RUN_A_STUDY))
    (estimate, run, types, means, *_, replayed, tables) = map(shown, cells)
    assert estimate == "(48, 0.0)"
    assert "trials: 48/48 ended" in run
    assert run.count("trials: ") == 1, "one line, which is replaced"
    assert "\x1b" not in run
    assert "\r" not in run
    assert "temperature    float64" in types
    assert "projected-order 0.2" in means
    assert replayed.splitlines()[-1] == "(0, True)"
    assert "gap_m" in tables


@pytest.mark.slow
async def test_an_edited_cell_is_another_driver_and_a_metric_is_in_the_tables(executed):
    _, played, again, table = map(shown, await executed(named(OWN)))
    assert played.splitlines()[-1] == "22"
    assert again.splitlines()[-1] == "(0, set())"
    assert "hardest_braking_mps2" in table


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: Path(path).stem)
def test_notebooks_are_stored_without_outputs(path):
    notebook = nbformat.read(path, as_version=4)
    assert not any(cell.outputs or cell.execution_count for cell in code(notebook))
    assert path.stem in (RUN_A_STUDY, OWN)
