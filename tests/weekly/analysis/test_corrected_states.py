"""What the drivers of `sweep reference` are said to be follows the corrected p."""

from __future__ import annotations

import pytest

from merge_runner_analysis.data.study import Study
from merge_runner_analysis.tables import make_tables
from merge_runner_analysis.verdict_words import DIFFERS


@pytest.mark.long
def test_no_reference_driver_differs_in_a_measure_whose_corrected_p_is_5_percent(prepare, tmp_path):
    done = prepare(tmp_path, "sweep", "reference", "--db", "ref.duckdb")
    assert done.code == 0, done.err
    (table,) = make_tables(Study(tmp_path / "ref.duckdb"), ["verdicts"])
    rows = [row.values for row in table.rows if row.values.get("p_holm") is not None]
    assert rows
    for values in rows:
        assert (values["state"] in DIFFERS) == (values["p_holm"] < 0.05), values
    idm = next(row.values for row in table.rows if row.id == "idm/baseline/gap-velocity")
    # 2 m apart by the signed product, without spread: beyond the margin, and never "inconclusive".
    assert idm["estimate"] > 2
    assert idm["state"] == "unlike"
