"""A study finds the effect that it planted in the emulator."""

from merge_runner_analysis.stats.regressions import WHO_FIRST_TERMS
from merge_runner_analysis.tables import table

STUDY = "repetitions = 12\n[factors]\nx_relative_speed = [-2.0, 0.0]\n"


async def test_a_study_finds_what_it_planted_and_replays_it(merge_runner, tmp_path):
    (tmp_path / "planted.toml").write_text(STUDY)
    run = await merge_runner("sweep", "planted.toml", "--json")
    assert run.code == 0, run.err
    found = table(tmp_path / "results/merge.duckdb", "who-first")
    for speed in (-2.0, 0.0):
        for term, planted in zip(WHO_FIRST_TERMS, (-0.30, 1.11, speed), strict=True):
            row = found.loc[f"emulator [x_relative_speed={speed}]/baseline/{term}"]
            assert abs(row.b - planted) < 3 * row.se
    digest = (await merge_runner("digest")).out
    again = await merge_runner("replay", "planted.toml", "--db", "again.duckdb")
    assert again.code == 0, again.err
    assert (await merge_runner("digest", "--db", "again.duckdb")).out == digest
