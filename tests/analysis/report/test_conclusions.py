"""Every sentence of the conclusions says what its numbers are, for any database."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.data.provenance import provenance
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.report.conclusions import not_shown, nothing, shown
from merge_runner_analysis.stats.ceiling import Ceiling
from merge_runner_analysis.stats.group_scores import Score, score
from merge_runner_analysis.stats.indicators import TESTED
from merge_runner_analysis.tables import make_tables
from tests.analysis.studies import Drive, changed, write_study, yielding


def texts(study):
    """What is shown, and what is not."""
    return " ".join(shown(study)), " ".join(not_shown(study, provenance(study.db)))


def test_what_is_not_excluded_is_the_interval_of_these_trials(tmp_path):
    few = Study(write_study(tmp_path / "few.duckdb", yielding("o3", reps=1)[:2]))
    said, _ = texts(few)
    assert "o3 collided, by boxes that overlap, in 0.0 % of 2 trials (95 % CI 0.0 to 65.8)" in said
    told = re.search(r"points \(95 % CI ([+-][0-9.]+) to ([+-][0-9.]+); Fisher's exact test", said)
    low, high = map(float, told.groups())
    assert low < -2
    assert high > 60, "two trials exclude hardly anything"
    assert "a small one is not excluded" not in said


def test_a_difference_that_chance_seldom_makes_is_called_so(tmp_path):
    drives = [
        Drive("o3", "baseline", name, rep, (0.1 * rep,) * 9, (0.1 * rep,) * 9)
        for name in ("N_0_0", "L_4_0")
        for rep in range(1, 4)
    ]
    cut_off, _ = texts(Study(write_study(tmp_path / "cut_off.duckdb", drives)))
    assert "o3 is not compared with humans by its collisions: coll. boxes (%): 4 of 6" in cut_off
    boxes = ScenarioConfig(collision_rule="rectangle")
    said, _ = texts(Study(write_study(tmp_path / "t.duckdb", drives, boxes)))
    assert "o3 collided, by boxes that overlap, in 100.0 % of 6 trials" in said
    assert "p < 0.001: a difference that chance alone seldom makes" in said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robust", "paper", "strength"),
    [(0.99, 0.83, "strong"), (0.9, 0.5, "some"), (0.3, 0.39, "weak"), (0.04, 0.0, "no")],
)
def test_a_missing_mark_weighs_by_how_often_humans_have_it(
    tmp_path, monkeypatch, robust, paper, strength
):
    study = Study(write_study(tmp_path / "t.duckdb", level("o3")))
    share = Ceiling(
        dict.fromkeys((*TESTED, "I1-I4"), paper), dict.fromkeys((*TESTED, "I1-I4"), robust)
    )
    monkeypatch.setattr(Score, "ceiling", share)
    said, _ = texts(study)
    assert score(study, study.models[0]).robust["I2"].passed is False
    assert (
        "o3 does not show that going first becomes less likely with a relative velocity advantage: "
        f"{100 * robust:.0f} % of human data sets of this size do by the robust tests, "
        f"{100 * paper:.0f} % by the paper's, so that this is {strength} evidence against the "
        "driver." in said
    )


@pytest.mark.slow
def test_a_missing_mark_weighs_by_as_many_human_trials_as_lie_in_the_humans_conditions(tmp_path):
    db = write_study(tmp_path / "t.duckdb", level("o3"))
    said, _ = texts(Study(db))
    assert " % of human data sets of this size do by the robust tests" in said
    said, _ = texts(changed(db, "UPDATE trials SET condition = 'own' WHERE rep > 4"))
    assert " % of human data sets of the size of its 44 trials in the humans' conditions do" in said
    assert "of this size" not in said


@pytest.mark.slow
def test_nothing_is_said_of_a_ceiling_where_no_human_drove(tmp_path):
    db = write_study(tmp_path / "t.duckdb", level("o3"))
    said, limits = texts(changed(db, "UPDATE trials SET condition = 'own_' || condition"))
    assert "how often humans would in a study of this size is not known" in said
    assert "human data sets" not in said + limits


def level(driver):
    """A driver who goes by headway and, where level, by turns, whatever the relative velocity."""
    drives = yielding(driver, reps=10)
    return [
        replace(d, left=(0.5,) * 3, right=(-0.5,) * 3)
        if (d.rep + (CONDITIONS[d.condition].projected_headway_m > 0)) % 3 == 0
        else d
        for d in drives
    ]


def test_the_human_gap_is_that_of_the_reference_in_use(small):
    assert re.search(
        r"o3 leaves [0-9.]+ m on average of \d+ trials .*; humans 3.85 m as published",
        " ".join(shown(small)),
    )


@pytest.mark.slow
def test_what_was_sent_is_named_and_a_default_only_where_nothing_was(tmp_path):
    db = write_study(tmp_path / "t.duckdb", yielding("o3", reps=1))

    def sent(**body):
        driver = {
            "endpoint": "openai",
            "body": {"model": "o3", "messages": [{"content": ""}], **body},
        }
        spec = json.dumps({"left": driver, "right": driver})
        return texts(changed(db, f"UPDATE specs SET spec = '{spec}'"))[1]

    cold = sent(temperature=0.2, max_completion_tokens=16000)
    assert "for what was sent with it: temperature = 0.2, max_completion_tokens = 16000." in cold
    assert "no temperature" not in cold
    assert "reasoning_effort = medium, and no temperature." in sent(reasoning_effort="medium")
    nested = sent(generationConfig={"temperature": 1.0, "thinkingConfig": {"thinkingBudget": -1}})
    assert "temperature = 1.0, thinkingBudget = -1." in nested


@pytest.mark.slow
def test_a_program_has_no_wording_and_no_temperature(tmp_path):
    db = write_study(tmp_path / "t.duckdb", yielding("projected-order", reps=1))
    _, limits = texts(changed(db, "UPDATE trials SET source = 'driver'"))
    assert (
        "projected-order is a program: it reads no prompt; what is left to chance has a seed."
        in limits
    )
    assert "temperature" not in limits
    assert "wording" not in limits


@pytest.mark.slow
def test_a_separated_fit_is_not_judged_and_the_robust_verdict_stands(tmp_path):
    drives = [d for d in yielding("o3", reps=4) if d.condition != "N_0_0"]
    study = Study(write_study(tmp_path / "t.duckdb", drives))
    said, limits = texts(study)
    assert "o3: I1, I2 cannot be judged by the paper's test: separation" in limits
    assert (
        "by one rule alone: going first becomes likelier with a projected headway advantage "
        "(paper's rule: not judged, robust: yes)" in said
    )


@pytest.mark.long
def test_a_stand_in_is_in_no_conclusion_whatever_name_it_answered_in(tmp_path):
    db = write_study(tmp_path / "t.duckdb", [*yielding("o3", reps=1), *yielding("other", reps=1)])
    study = changed(db, "UPDATE trials SET scripted = true WHERE trial_id LIKE 'o3/%'")
    said, limits = texts(study)
    assert "other collided, by boxes that overlap, in" in said
    assert "o3" not in said
    assert "o3/baseline: scripted stand-in, not o3: its rows say nothing about a language" in limits
    alone = changed(db, "UPDATE trials SET scripted = true")
    assert shown(alone) == []
    assert nothing(alone) == "Nothing: with the baseline prompt only scripted stand-ins drove."


def test_failed_trials_alone_show_nothing(tmp_path):
    db = write_study(tmp_path / "t.duckdb", yielding("o3", reps=1)[:2])
    study = changed(
        db, "UPDATE trials SET status = 'failed', merged_first = NULL, error = 'no answer'"
    )
    assert shown(study) == ["o3: no trial ended (2 failed)."]


REPLAYED = {"program": "human-replay", "data": "a hash"}


def test_a_human_who_is_replayed_is_not_judged(tmp_path):
    study = Study(write_study(tmp_path / "t.duckdb", yielding("human-replay"), asked=REPLAYED))
    (group,) = study.models
    found = score(study, group)
    assert {v.passed for rule in found.rules.values() for v in rule.values()} == {None}
    why = "both humans are replayed and do not react"
    for table in make_tables(study, ["contrasts", "differences"]):
        assert table.rows == []
        assert any(f"{group.id}: {why}: it is not judged" in note for note in table.notes)
    said, limits = texts(study)
    assert said == ""
    assert f"{group.id}: {why}: it is not judged" in limits
    assert nothing(study) == "Nothing: with the baseline prompt only replayed humans were played."


def test_holm_is_named_wherever_it_decides(tmp_path):
    """A driver whose gaps are beside those of the humans."""
    drives = [replace(d, left=(1.0,) * 3, right=(-1.0,) * 3) for d in yielding("o3", reps=4)]
    said, _ = texts(Study(write_study(tmp_path / "t.duckdb", drives)))
    for claim in (
        r"differs from the humans, in one model of both and after Holm's correction",
        r"no difference from the humans is shown, after Holm's correction",
    ):
        assert re.search(claim, said), claim
