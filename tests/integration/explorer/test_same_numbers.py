"""A verdict's numbers are the same in the table, in its JSON, on Study and on the driver's page."""

from __future__ import annotations

import json
import re
import subprocess
from html import unescape

import pytest
from starlette.testclient import TestClient

from merge_runner_analysis.data.study import Study
from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.site import Site
from merge_runner_analysis.tables import make_tables
from tests.integration.explorer.test_tables_pages import Awaited, InProcess
from tests.support.harness import PROGRAM, environment
from tests.support.studies import Drive, write_study, yielding

NUMBER = re.compile(r"[−-]?\d+(?:\.\d+)?(?:e-\d+)?")


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    """A driver that yields as humans do, but crashes where nobody is ahead.

    It drove one condition less often, so that the humans beside it weigh otherwise than by
    themselves.
    """
    crashes = [
        Drive("o3", "baseline", "N_0_0", rep, (0.1 * rep,) * 9, (0.1 * rep,) * 9)
        for rep in range(1, 4)
    ]
    drives = {(one.condition, one.rep): one for one in [*yielding("o3", reps=4), *crashes]}
    kept = [one for (name, rep), one in drives.items() if name != "R_-2_8" or rep == 1]
    return write_study(tmp_path_factory.mktemp("same") / "study.duckdb", kept)


@pytest.fixture(scope="module")
def rows(db):
    """The values of o3 by measure."""
    (table,) = make_tables(Study(db), ["verdicts"])
    return {
        row.values["measure"]: row.values for row in table.rows if row.groups == ("o3/baseline",)
    }


@pytest.fixture(scope="module")
def pages(db):
    """Study and the page of o3, once they have their numbers."""
    site = Site(db)
    site.computing = Awaited(db, InProcess)
    site.catalogue.refresh()
    client = TestClient(explorer(site), base_url="http://127.0.0.1:8700")
    yield [unescape(client.get(path).text) for path in ("/", "/drivers/o3")]
    site.computing.close()


def printed(html: str) -> list[str]:
    """The numbers in a piece of a page."""
    return [text.replace("−", "-") for text in NUMBER.findall(re.sub(r"<[^>]*>", " ", html))]


def agree(texts: list[str], values: list[float]) -> bool:
    """Whether these are the values, each rounded to the decimals that it is printed with."""
    if len(texts) < len(values):
        return False
    return all(
        abs(float(text) - value) <= 0.5000001 * 10.0 ** -len(text.partition(".")[2])
        for text, value in zip(texts, values, strict=False)
    )


def test_json_has_the_numbers_of_the_table(db, rows):
    done = subprocess.run(
        [PROGRAM, "tables", "verdicts", "--format", "json", "--db", db.name],
        cwd=db.parent, env=environment(), capture_output=True, text=True, check=True,
    )  # fmt: skip
    (table,) = json.loads(done.stdout)["tables"]
    found = {row["measure"]: row for row in table["rows"] if row["row"].startswith("o3/")}
    assert found.keys() == rows.keys()
    for name, values in rows.items():
        for column, value in values.items():
            if isinstance(value, tuple):
                ends = found[name][f"{column}_low"], found[name][f"{column}_high"]
                assert ends == pytest.approx(value, rel=1e-9), (name, column)
            elif isinstance(value, float):
                assert found[name][column] == pytest.approx(value, rel=1e-9), (name, column)
            else:
                assert found[name].get(column) == value, (name, column)


def test_study_has_the_numbers_of_the_table(rows, pages):
    told = dict(re.findall(r'href="/drivers/o3[^"#]*#([\w-]+)"\s+title="([^"]+)"', pages[0]))
    judged = {name: values for name, values in rows.items() if values["estimate"] is not None}
    assert len(judged) >= 5
    assert told.keys() >= judged.keys()
    for name, values in judged.items():
        assert agree(printed(told[name]), [values["estimate"], *values["ci"]]), (name, told[name])
        assert f"n = {values['n']}" in told[name]


def test_a_drivers_page_has_the_numbers_of_the_table(rows, pages):
    table = pages[1].split('class="verdicts')[1].split("</table>")[0]
    for name, values in rows.items():
        row = table.split(f'id="{name}"')[1].split("</tr>")[0]
        cells = dict(re.findall(r'<td[^>]*data-l="([^"]+)"[^>]*>(.*?)</td>', row, re.DOTALL))
        expected = {
            "o3": [values["estimate"], *(values["ci"] or ())],
            "humans": [values.get("human"), *(values.get("human_ci") or ())],
            "difference": [values.get("difference"), *(values.get("difference_ci") or ())],
            "detectable": [values.get("detectable")],
        }
        for label, numbers in expected.items():
            if numbers[0] is not None:
                assert agree(printed(cells[label]), numbers), (name, label, cells[label], numbers)
