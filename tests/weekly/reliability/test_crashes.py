from tests.support.kills import kill_again_and_again


async def test_a_sweep_that_is_killed_at_20_instants_asks_nothing_answered_again(
    merge_runner, quiet, tmp_path
):
    await kill_again_and_again(merge_runner, tmp_path, quiet, kills=20, latency_s=0.05)
