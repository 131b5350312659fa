"""A study's factors in the explorer: facets, pages of trials and sweeps, and exported lists."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from html import unescape

import duckdb
import pytest
from starlette.testclient import TestClient

from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.site import Site
from tests.support.harness import FAST

HOST = "127.0.0.1:8700"


@pytest.fixture(scope="module")
def client(played):
    return TestClient(explorer(Site(played.db)), base_url=f"http://{HOST}")


def test_the_list_of_trials_filters_by_factor(client):
    page = client.get("/trials").text
    assert '<select name="factor.temperature"' in page
    text = client.get("/trials?factor.temperature=0.2&factor.opponent=sleepy").text
    assert "<strong>6</strong> trials" in text
    assert '<option value="1.0">1.0 (6)</option>' in text
    assert '<option value="0.2" selected>0.2 (6)</option>' in text
    assert "<strong>0</strong> trials" in client.get("/trials?factor.mood=good").text
    rows = client.get("/trials.csv?factor.temperature=0.2").text.splitlines()
    assert rows[0].endswith(",factor.opponent,factor.temperature")
    assert {row[-4:] for row in rows[1:]} == {",0.2"}


def test_a_trials_page_names_its_levels(client):
    page = client.get("/trials/cheap+sleepy/baseline/N_0_0/rep01/temperature=0.2").text
    assert "opponent=sleepy, temperature=0.2." in page


@pytest.mark.slow
def test_a_sweeps_page_shows_each_driver_and_what_goes_on_with_it(client, played, tmp_path):
    (sweep,) = set(re.findall(r'href="(/sweeps/[^"]+)"', client.get("/sweeps").text))
    page = client.get(sweep).text
    assert "mine: cheap, dear drives" in page
    assert '<th scope="row">dear [temperature=0.2]</th>' in page
    cells = re.findall(r'id="arm-[0-9]+" href="([^"]+)">([0-9]+)<', page)
    assert len(cells) == 6
    for link, count in cells:
        assert f"<strong>{count}</strong> trials" in client.get(unescape(link)).text, link
    copy = tmp_path / "t.duckdb"
    copy.write_bytes(played.db.read_bytes())
    with duckdb.connect(str(copy)) as connection:
        connection.execute("UPDATE sweeps SET exit_code = 3")
        connection.execute("DELETE FROM trials WHERE trial_id LIKE '%rep02%'")
    stopped = TestClient(explorer(Site(copy)), base_url=f"http://{HOST}").get(sweep).text
    assert "18 of 36 trials have an outcome" in stopped
    typed = shlex.join(["merge-runner", "sweep", "mine.toml", "--yes", "--trust", "--db",
                        "t.duckdb", *map(str, FAST)])  # fmt: skip
    assert f"<code>{typed}</code>" in stopped


ASK = """
import sys
from html import unescape
from pathlib import Path
from merge_runner_analysis.explorer.computing import Worker
from merge_runner.registry import use
from merge_runner.study.parts import load_study

use(load_study(sys.argv[2], trust=True)[1])
Path(sys.argv[2]).with_name("mine.py").write_text("raise RuntimeError('nobody agreed to this')")
worker = Worker(Path(sys.argv[1]))
found = worker.submit(("table", "factors")).result(timeout=60)
worker.close()
print(found["table"])
"""


@pytest.mark.slow
def test_what_the_pages_compute_knows_the_study_as_the_explorer_was_given_it(played, tmp_path):
    for name in ("mine.toml", "mine.py"):
        shutil.copy(played.folder / name, tmp_path)
    told = subprocess.run(
        [sys.executable, "-c", ASK, played.db, tmp_path / "mine.toml"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "opponent=sleepy/duration_s" in told.stdout
