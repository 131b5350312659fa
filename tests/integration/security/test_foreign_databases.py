"""Names that a database holds, in paths that are written."""

from __future__ import annotations

import duckdb
import pytest

PART = ("baseline", "--reps", 1, "--conditions", "N_0_0")


def change(db, sql):
    with duckdb.connect(str(db)) as opened:
        opened.execute(sql)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a/b", "../up"])
async def test_no_name_of_a_condition_leads_out_of_the_folder_of_an_export(
    merge_runner, tmp_path, name
):
    if (await merge_runner("sweep", *PART, "--model", "constant")).code:
        pytest.fail("no trial is stored")
    change(tmp_path / "results/merge.duckdb", f"UPDATE trials SET condition = '{name}'")
    run = await merge_runner("view", "--trials", "*", "--export", "shared/pages")
    assert run.code == 0, run.err
    assert [path.name for path in (tmp_path / "shared").iterdir()] == ["pages"]
    pages = [path for path in (tmp_path / "shared/pages").iterdir() if path.is_file()]
    assert any("constant/baseline/N_0_0/rep01" in page.read_text() for page in pages)
