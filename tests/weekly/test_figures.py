"""Figures that the docs give are computed anew from what they are about."""

from merge_runner.results.store import query
from tests.support.harness import PROJECT

PAGE = PROJECT / "docs/reference-drivers.md"
SAID = "gaps of {:.1f} m (`highway-env`) and {:.1f} m (`treiber-kesting`) on average"
# No vehicle is ahead when the first reaches the merge point: who yields is drawn.
TIED = "L_0_-8,N_0_0,R_0_8"
GAPS = """
WITH ways AS (SELECT DISTINCT model_left, condition, round(gap_m, 6) AS gap_m
FROM trials JOIN trial_metrics USING (trial_id, spec_hash) WHERE status = 'finished'),
means AS (SELECT model_left, condition, avg(gap_m) AS gap_m FROM ways GROUP BY ALL)
SELECT avg(gap_m), count(*) FROM means GROUP BY model_left ORDER BY model_left
"""


async def test_the_gaps_of_idm(merge_runner, tmp_path):
    sets = ("highway-env", "treiber-kesting")
    drivers = "".join(f'[drivers.{name}]\nprogram = "idm"\nset = "{name}"\n' for name in sets)
    (tmp_path / "idm.toml").write_text(f"models = {[*sets]}\nrepetitions = 1\n{drivers}")
    for part in ((), ("--conditions", TIED, "--reps", 10)):
        assert (await merge_runner("sweep", "idm.toml", *part)).code == 0
    means_m, conditions = zip(*query(tmp_path / "results/merge.duckdb", GAPS)[1], strict=True)
    assert conditions == (11, 11)
    assert SAID.format(*means_m) in " ".join(PAGE.read_text(encoding="utf-8").split())
