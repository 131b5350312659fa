"""A pickle that somebody planted in the cache is refused by the program, and never loaded."""

from __future__ import annotations

import os
import pickle
import sqlite3

import pytest

PART = ("baseline", "--reps", 1, "--conditions", "N_0_0")


class Bomb:
    """Makes a folder when it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


def plant(folder, statement, mark):
    """Run a statement on the cache's table; ``?`` is a pickle."""
    with sqlite3.connect(folder / "cache/responses/cache.db") as database:
        done = database.execute(statement, [pickle.dumps(Bomb(mark))])
        assert done.rowcount > 0
    database.close()


# diskcache's mode 4 is a pickle; raw = 0 says the same of a key.
@pytest.mark.parametrize(
    ("statement", "says"),
    [
        (
            "UPDATE Cache SET value = ?, mode = 4 WHERE length(key) = 64",
            "holds a pickle or names a file",
        ),
        (
            "INSERT INTO Cache (key, raw, store_time, access_time, mode, value) "
            "SELECT ?, 0, 0, 0, 1, '{}'",
            "a key that is no text",
        ),
    ],
    ids=["value", "key"],
)
async def test_a_planted_pickle_is_refused_in_one_line_and_not_executed(
    merge_runner, tmp_path, statement, says
):
    assert (await merge_runner("sweep", *PART)).code == 0
    mark = tmp_path / "mark"
    plant(tmp_path, statement, mark)
    # Another condition has no reply: to say what is nearest, every key and value is read.
    run = await merge_runner("replay", *PART[:-1], "N_0_0,L_4_0", "--db", "replay.duckdb")
    assert run.code in (1, 4)
    assert any(says in line for line in (run.out + run.err).splitlines())
    assert "Traceback" not in run.err
    assert not mark.exists()


def test_the_pickle_would_execute(tmp_path):
    """Or else the test above would show nothing."""
    pickle.loads(pickle.dumps(Bomb(tmp_path / "mark")))
    assert (tmp_path / "mark").exists()
