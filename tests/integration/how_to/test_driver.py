"""A driver from outside, with a rate of its own, from the sweep to the explorer."""

from __future__ import annotations

import json
import re

import duckdb
import pytest

from tests.support.harness import PROJECT, how_to, plugin

FINE = """
conditions = ["L_4_0", "N_0_0"]
[repetitions]
baseline = 1
[scenario]
step_s = 0.05
plan_step_s = 0.2
control_start = "own_exit"
"""
PAIRS = ("hesitant+impulsive", "emulator+impulsive")
RATES = {"emulator": 1, "hesitant": 5, "impulsive": 20}


@pytest.fixture(scope="module")
def installed(study):
    (study.folder / "fine.toml").write_text(FINE)
    return plugin(study.folder / "installed", how_to("add-a-driver"))


@pytest.fixture(scope="module")
def played(study, installed):
    """Both pairs in one database."""
    for pair in PAIRS:
        done = study.run("sweep", "fine.toml", "--model", pair, **installed)
        assert done.code == 0, done.err
    return installed


@pytest.mark.slow
def test_a_driver_decides_at_its_own_rate_and_is_drawn_from_its_seed(study, played):
    with duckdb.connect(str(study.folder / "results/merge.duckdb"), read_only=True) as connection:
        rows = connection.execute(
            "SELECT if(side = 'left', model_left, model_right), decision, time_s, len(applied), "
            "len(plan) FROM decisions JOIN trials USING (trial_id, spec_hash)"
        ).fetchall()
        seen = connection.execute(
            "SELECT count(DISTINCT prompt), max(len(split(regexp_extract(prompt, "
            "'other car \\(m/s\\): \\[([^]]*)', 1), ','))) FROM decisions WHERE prompt IS NOT NULL"
        ).fetchone()
    assert {name for name, *_ in rows} == set(RATES)
    for name, number, time_s, applied, plan in rows:
        assert time_s == pytest.approx(number / RATES[name])
        # An action of a program lasts a step of the world, one of the model's plan 0.2 s.
        in_a_second = 5 if name == "emulator" else 20
        assert applied == in_a_second / RATES[name]
        assert plan == 4 * in_a_second
    assert seen[0] > 10  # each is asked in a situation of its own
    assert seen[1] == 10  # the histories are those of a plan's steps

    other = ("--db", "other.duckdb")
    for pair in PAIRS:
        assert (study.run("replay", "fine.toml", "--model", pair, *other, **played)).code == 0
    digests = {(study.run("digest", *db, **played)).out for db in ((), other)}
    assert len(digests) == 1
    assert digests.pop().strip()


@pytest.mark.slow
def test_it_is_in_every_command_that_reads(study, played):
    audit = study.run("audit", "--json", **played)
    assert (audit.code, "not replayed" in audit.out) == (0, False), audit.out
    done = study.run("view", "--trials", "*", "--single", "trials.html", **played)
    assert done.code == 0, done.err
    tables = study.run("tables", "ablation-quantitative", "--format", "csv", **played)
    for name in PAIRS:
        assert name in tables.out
    assert "hesitant+impulsive" in (study.folder / "trials.html").read_text()


@pytest.mark.slow
def test_where_it_is_not_installed_the_rest_is_shown_and_checked(study, played):
    audit = study.run("audit", "--json")
    assert audit.code == 0
    notes = [note for one in json.loads(audit.out)["audits"] for note in one["notes"]]
    assert any(
        "unknown driver 'impulsive'; valid: " in note
        and "(install the package that registers it, or name the study: --study FILE)" in note
        for note in notes
    ), notes
    done = study.run("view", "--trials", "*", "--single", "bare.html")
    assert done.code == 0, done.err
    asked = study.run("sweep", "fine.toml", "--model", "impulsive")
    assert asked.code == 2
    assert "unknown model 'impulsive'; valid: " in asked.err
    assert "projected-order" in asked.err


def test_a_world_that_is_set_too_coarse_is_refused_with_what_to_type(study, installed):
    (study.folder / "coarse.toml").write_text(FINE.replace("0.05", "0.2"))
    done = study.run("sweep", "coarse.toml", "--model", "constant+impulsive", **installed)
    assert (done.code, done.out) == (2, "")
    assert done.err == (
        "error: the driver impulsive cannot decide 20.0 times a second: the time between two "
        "decisions = 0.05 s is no whole number of 0.2 s; set a step_s that fits under [scenario] "
        "of the sweep's file, and beside it plan_step_s = 0.2 to leave a language model's plan as "
        "it is\n"
    )


def test_a_study_gives_it_other_parameters_and_a_slower_clock(study, installed):
    (part,) = re.findall(
        r"```toml\n(\[drivers.*?)```", (PROJECT / "docs/how-to/add-a-driver.md").read_text(), re.S
    )
    (study.folder / "wild.toml").write_text(f'repetitions = 1\nconditions = ["N_0_0"]\n{part}')
    played = ("wild.toml", "--model", "wild", "--json", "--db", "wild.duckdb")
    done = study.run("sweep", *played, **installed)
    assert done.code == 0, done.err
    with duckdb.connect(str(study.folder / "wild.duckdb"), read_only=True) as connection:
        (interval, hardest) = connection.execute(
            "SELECT min(time_s) FILTER (time_s > 0), max(abs(plan[1])) FROM decisions"
        ).fetchone()
    assert interval == 1.0
    assert 0.5 < hardest <= 0.9
    audit = study.run("audit", "--db", "wild.duckdb", "--json", **installed)
    assert (audit.code, "not replayed" in audit.out) == (0, False), audit.out


def test_programs_are_listed_with_what_they_do(study, installed):
    listed = (study.run("models", **installed)).out.splitlines()
    named = {line.split()[0] for line in listed if " program " in line}
    assert {"constant", "projected-order", "idm", "impulsive", "hesitant"} <= named
    programs = {name: words for name, _, words in (line.partition(": ") for line in listed)}
    assert "(20 Hz); parameters: steady_from_m = 20.0, strength = 0.5" in programs["impulsive"]
    assert "set = highway-env | treiber-kesting" in programs["idm"]
    assert "this human does not react" in programs["human-replay"]
