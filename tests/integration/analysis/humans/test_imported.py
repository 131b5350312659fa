"""What imported human trials are, beside the published counts, and how their rows are named."""

from dataclasses import replace

import pandas as pd
import pytest

from merge_runner.results.store import Store
from merge_runner.scenarios.merge.conditions import CONDITIONS, HUMAN_CONDITIONS
from merge_runner.trial_records import StateRow, TrialRecord, TrialSpec
from merge_runner_analysis.explain import explain
from merge_runner_analysis.frames import load
from merge_runner_analysis.humans.imported import by_condition, counted, findings, human_trials
from merge_runner_analysis.metrics import BOXES, COLLISIONS
from merge_runner_analysis.published import PAIRS, human_outcomes
from merge_runner_analysis.stats.measures import counts, known
from merge_runner_analysis.study import StudyResults
from tests.support.tables import made, notes_with

LEFT, RIGHT, CRASH = ("finished", "left"), ("finished", "right"), ("collided", None)
PUBLISHED = human_outcomes().assign(
    pair=[list(PAIRS.values())[i % 9] for i in range(990)], of_pages=False
)


def changed(condition: str, before: tuple, after: tuple, n: int = 1):
    """The trials, of which ``n`` of a condition came to another (status, merged first)."""
    chosen = (PUBLISHED["condition"] == condition) & (PUBLISHED["status"] == before[0])
    chosen &= PUBLISHED["merged_first"] == before[1]
    found = PUBLISHED.copy()
    found.loc[PUBLISHED.index[chosen][:n], ["status", "merged_first"]] = after
    return found


def moved(n: int) -> pd.DataFrame:
    """The trials, the first ``n`` of which are of a pair that was not published."""
    return PUBLISHED.assign(pair=PUBLISHED["pair"].mask(PUBLISHED.index < n, "experiment_7"))


@pytest.mark.parametrize(
    ("trials", "said"),
    [
        (PUBLISHED, []),
        (PUBLISHED[::8], ["124 of 990 trials are imported; who merged first and collisions are "]),
        (
            changed("N_0_0", LEFT, CRASH, 8),
            ["another data set than the published one: more of an outcome in N_0_0"],
        ),
        (
            changed("R_0_8", LEFT, RIGHT),
            ["another data set than the published one: more of an outcome in R_0_8"],
        ),
        (moved(1), ["989 of 990 trials"]),
        (moved(990), ["another data set than the published one"]),
    ],
)
def test_what_is_found_of_human_trials_is_said(trials, said):
    found = list(findings(trials))
    assert len(found) == len(said)
    assert all(one.startswith(start) for one, start in zip(found, said, strict=True))


@pytest.fixture
def stored(tmp_path):
    """Writes human trials, and a trial of a model, into a database."""

    def write(trials: pd.DataFrame):
        records = []
        for number, row in enumerate(trials.itertuples()):
            first = row.merged_first if isinstance(row.merged_first, str) else None
            spec = TrialSpec(
                f"human/{number}", "h", "human", "human", "human", None, row.condition, number,
                0, 0, pair=row.pair, kinematics=HUMAN_CONDITIONS[row.condition],
            )  # fmt: skip
            states = tuple(
                StateRow(0, 0.0, side, at_m, 10.0, 0.0)
                for side, at_m in (("left", 50), ("right", 60))
            )
            records.append(TrialRecord(spec, row.status, first, 5.0, None, states, ()))
        path = tmp_path / "merge.duckdb"
        model = replace(spec, trial_id="o3/1", source="llm", variant="baseline", pair=None)
        Store(path).add_recorded([*records, records[-1]._replace(spec=model)], {})
        return path

    return write


def test_a_complete_import_leads_to_the_trials_behind_the_published_outcomes(stored):
    study = StudyResults(stored(PUBLISHED))
    trials = human_trials(study.db)
    assert list(findings(trials)) == []
    assert list(by_condition(trials).index) == list(CONDITIONS)
    assert (by_condition(trials)["trials"] == 90).all()
    assert dict(counted(trials, "pair")["trials"]) == dict.fromkeys(PAIRS.values(), 110)
    assert (study.human.label, study.human.traced, study.complete) == ("human", True, True)
    assert counts(study.human, BOXES) == (28, 990)
    assert not known(study.human, COLLISIONS)


def test_another_data_set_is_named_under_every_table_with_humans(stored):
    study = StudyResults(stored(changed("N_0_0", LEFT, CRASH, 8)))
    for name in ("who-first", "ablation-quantitative"):
        assert notes_with(made(study, name), "more of an outcome in N_0_0")


def test_trials_of_other_pairs_are_in_no_row_and_in_no_query(stored):
    study = StudyResults(stored(moved(5)))
    assert len(study.human.trials) == by_condition(moved(5))["trials"].sum() == 985
    assert counted(moved(5), "pair")["trials"]["experiment_7"] == 5
    (source,) = explain(study, made(study, "who-first"), "human/intercept").sources
    trials = load(source.query, study.db)["trial_id"]
    assert trials.tolist() == list(source.trials)
    assert len(trials) == len(study.human.finished)
