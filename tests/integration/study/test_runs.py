"""What is kept of a database where one of its studies is named."""

import json

import duckdb
import pytest

ONE = """
repetitions = 1
conditions = ["N_0_0"]
[factors]
temperature = [0.2, 0.9]
"""
OTHER = 'repetitions = 2\nconditions = ["L_4_0"]\n'


@pytest.fixture
def both(prepare, tmp_path):
    """A folder with a database of two studies, and one of the first alone."""
    for name, text in (("one", ONE), ("other", OTHER)):
        (tmp_path / f"{name}.toml").write_text(text)
    for study, db in (("one", "both"), ("other", "both"), ("one", "alone")):
        assert prepare(tmp_path, "sweep", f"{study}.toml", "--db", f"{db}.duckdb").code == 0
    return tmp_path


OF_ONE = ("--study", "one.toml")


def test_a_study_of_several_is_checked_exported_and_recorded_alone(both, prepare):
    def said(*words, db="both.duckdb"):
        run = prepare(both, *words, "--db", db, code=0)
        return run.out

    assert said("digest", *OF_ONE) == said("digest", db="alone.duckdb") != said("digest")
    audits = json.loads(said("audit", *OF_ONE, "--json"))["audits"]
    assert [audit["counts"]["trials"] for audit in audits] == [2]
    assert len(json.loads(said("audit", "--json"))["audits"]) == 3, "and what belongs to none"

    said("export", "of-one", *OF_ONE)
    said("export", "all")
    said("export", "of-alone", db="alone.duckdb")
    for file in (both / "of-alone").glob("*.parquet"):
        own, same, every = (
            duckdb.sql(f"FROM '{both / folder / file.name}'").fetchall()
            for folder in ("of-one", "of-alone", "all")
        )
        assert len(own) == len(same) <= len(every), file.name
    assert "temperature" in (both / "of-one/trials_wide.csv").read_text().splitlines()[0]

    said("recording", "export", "of-one.parquet", *OF_ONE)
    info = json.loads(prepare(both, "recording", "info", "of-one.parquet", "--json").out)
    calls = duckdb.sql(f"SELECT count(DISTINCT call_key) FROM '{both}/of-one/calls.parquet'")
    assert info["calls"] == calls.fetchall()[0][0]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("digest", "--study", "third.toml"), "holds no trial of the study third; its studies: "),
        (("audit", *OF_ONE, "--sweep", "x"), "leave one of them out"),
        (("recording", "export", "x.parquet", *OF_ONE, "--sweep", "x"), "leave one of them out"),
        (("audit", *OF_ONE, "--recording", "x.parquet"), "without --sweep, --study and --cache"),
    ],
)
def test_a_study_that_was_not_played_is_refused(both, prepare, words, message):
    (both / "third.toml").write_text(OTHER)
    db = () if "--recording" in words else ("--db", "both.duckdb")
    run = prepare(both, *words, *db, code=2)
    assert message in run.err
