"""The condition in which most trials collide is named where there is one."""

from __future__ import annotations

import re

import duckdb
import httpx
import pytest

from tests.explorer.serving import served

CONDITIONS = ("L_4_0", "N_0_0", "R_0_8")
pytestmark = pytest.mark.slow


@pytest.fixture
def sweep(merge_runner):
    """Plays one trial in each of some conditions."""

    async def run(driver, *conditions, **environment):
        some = ("--reps", 1, "--conditions", ",".join(conditions))
        return await merge_runner("sweep", "baseline", *some, "--model", driver, **environment)

    return run


def which_collides_most(tmp_path):
    """What the explorer's first page says of it in words."""
    with served(tmp_path / "results/merge.duckdb") as address:
        page = httpx.get(f"{address}/").text
    return page.split("collides most</h2>")[1].split("<table")[0]


def named(text):
    return [name for name in CONDITIONS if name in text]


async def test_the_condition_with_the_largest_share_of_collisions_is_named(sweep, tmp_path):
    for driver, *conditions in (("constant", "L_4_0"), ("projected-order", "N_0_0", "R_0_8")):
        assert (await sweep(driver, *conditions)).code == 0
    assert named(which_collides_most(tmp_path)) == ["L_4_0"]


@pytest.mark.xfail(
    strict=True,
    raises=AssertionError,
    reason="1.11: where all conditions collide alike, the first in order is named as the worst",
)
async def test_where_all_conditions_collide_alike_none_is_named_before_the_others(sweep, tmp_path):
    """Vehicles that keep their speeds collide in each."""
    run = await sweep("constant", *CONDITIONS)
    if run.code:
        pytest.fail(run.err)
    assert named(which_collides_most(tmp_path)) in ([], list(CONDITIONS))


@pytest.mark.xfail(
    strict=True,
    raises=AssertionError,
    reason="1.11: where no trial ended, none is said to have collided",
)
async def test_where_no_trial_ended_nothing_is_said_of_collisions(sweep, tmp_path):
    assert (await sweep("constant", "L_4_0")).code == 0
    with duckdb.connect(str(tmp_path / "results/merge.duckdb")) as connection:
        connection.execute("UPDATE trials SET status = 'failed', merged_first = NULL")
    text = which_collides_most(tmp_path)
    assert not re.search(r"No trial[^.]* collided", text)
    assert "ended" in text
