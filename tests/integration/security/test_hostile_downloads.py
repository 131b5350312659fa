"""``human import`` of a zip that was made to harm: refused or read past, and nothing is run."""

import os
import pickle
import stat
import zipfile

import pytest

from merge_runner.results.store import query
from merge_runner_analysis.humans.archive import Unreadable, open_files
from tests.support import program
from tests.support.harness import environment
from tests.support.hostile import Bomb
from tests.support.recordings import drive, write_folder, write_zip

GOOD_CSV = drive("L_4_0").csv()
GOOD = {"a/experiment_4_iter_1.csv": GOOD_CSV}
TRIAL = "experiment_9_iter_9"


@pytest.fixture
def imported(tmp_path):
    """Imports a download with the program, in an empty folder."""

    def run(path):
        done = program.run(("human", "import", path), cwd=tmp_path, env=environment())
        assert "Traceback" not in done.err
        return done

    return run


def trials(tmp_path):
    return query(tmp_path / "results/merge.duckdb", "SELECT count(*) FROM trials")[1][0][0]


@pytest.mark.parametrize(
    ("member", "says"),
    [({"../out.csv": b"x"}, "is unsafe"), ({f"{TRIAL}.csv": bytes(65 * 2**20)}, "bytes unpacked")],
    ids=["leads out", "a bomb"],
)
def test_a_member_that_leads_out_or_unpacks_to_much_refuses_the_zip(
    imported, tmp_path, member, says
):
    path = write_zip(tmp_path / "d.zip", {**GOOD, **member})
    before = {*tmp_path.rglob("*"), *tmp_path.parent.glob("*")}
    run = imported(path)
    assert (run.code, len(run.err.splitlines())) == (2, 1)
    assert says in run.err
    assert {*tmp_path.rglob("*"), *tmp_path.parent.glob("*")} == before


def test_a_link_in_a_zip_is_not_followed(imported, tmp_path):
    secret = tmp_path / "secret"
    secret.write_text("private")
    path = write_zip(tmp_path / "d.zip", GOOD)
    with zipfile.ZipFile(path, "a") as archive:
        member = zipfile.ZipInfo(f"{TRIAL}.csv")
        member.create_system = 3
        member.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(member, str(secret))
    run = imported(path)
    assert run.code == 1
    assert f"error: {TRIAL}.csv: it lacks " in run.err
    assert "private" not in run.err + run.out
    assert trials(tmp_path) == 1


def test_a_device_or_a_pipe_in_a_folder_is_not_read(tmp_path):
    folder = write_folder(tmp_path / "d", GOOD)
    (folder / f"{TRIAL}.csv").symlink_to("/dev/zero")
    os.mkfifo(folder / f"{TRIAL}8.csv")
    with open_files(folder) as files:
        for file in files:
            if TRIAL in file.name:
                with pytest.raises(Unreadable, match="not a regular file"):
                    file.read()


def test_pickles_are_never_read_under_any_name(imported, tmp_path):
    mark = tmp_path / "mark"
    bomb = pickle.dumps(Bomb(mark))
    hostile = {f"{TRIAL[:-1]}{k}.{suffix}": bomb for k, suffix in enumerate(("pkl", "csv", "mat"))}
    hostile |= {"auto_save.pkl": bomb, "experiment_4_iter_1.pkl": bomb}
    run = imported(write_zip(tmp_path / "d.zip", {**GOOD, **hostile}))
    assert run.code == 1
    assert "1 files could not be read" in run.out
    assert trials(tmp_path) == 1
    assert not mark.exists()
    pickle.loads(bomb)
    assert mark.exists(), "or else this test would show nothing"


def test_names_cannot_speak_to_the_terminal(imported, tmp_path):
    name = f"two\nlines\x1b[2J\u202e/{TRIAL}.csv"
    run = imported(write_zip(tmp_path / "d.zip", {name: b"x"}))
    assert run.code == 1
    error, *notes = run.err.splitlines()
    assert error.startswith(f"error: two?lines?[2J?/{TRIAL}.csv: it lacks ")
    assert error.isprintable()
    assert {note[:6] for note in notes} == {"note: "}
