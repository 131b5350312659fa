"""Studies that several tests read."""

from dataclasses import replace

import pytest

from merge_runner.results.store import Store
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.humans.archive import open_files
from merge_runner_analysis.humans.load import import_trials, sort_files
from merge_runner_analysis.selection import Selection
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables import make_tables
from tests.support.recordings import drive, write_folder
from tests.support.studies import ANSWERS, Said, write_study, yielding
from tests.support.tables import QUICK

CONFIG = {"models": {"o3": {"id": "o3", "aliases": ["o3-alias"]}}}
# What went wrong at one decision of the first trials of A1; who drove it did not change.
TROUBLE = (
    *(Said((reason,), reason) for reason in ANSWERS[1:]),
    *(Said(failure=reason) for reason in ("no_array", "wrong_length", "no_array")),
    Said(("rate_limit", "timeout", "ok")),
    Said(("unknown", "ok")),
    Said(("empty", "ok")),
)


def asked(drives, said=()):
    """The drives with their calls; the first ones had this said at their second decision."""
    troubles = dict(enumerate(said))
    return [
        replace(drive, said={1: troubles[i]} if i in troubles else {})
        for i, drive in enumerate(drives)
    ]


@pytest.fixture(scope="session")
def study(tmp_path_factory):
    """o3 with two variants, and a driver that the paper does not have.

    A1 had trouble in some trials, A2 a fallback in each; the other driver lost a trial, and
    another model answered in its place.
    """
    weaker = [replace(d, right=tuple(0.8 * x for x in d.right)) for d in yielding("o3", "A2", 5)]
    drives = [
        *asked(yielding("o3", reps=10), [Said(served="o3-alias")]),
        *asked(yielding("o3", "A1", reps=5), TROUBLE),
        *asked(weaker, [Said(failure="out_of_range")] * len(weaker)),
        *asked(
            yielding("other", reps=4),
            [Said(("timeout", "timeout"), lost=True), *[Said(served="impostor")] * 3],
        ),
    ]
    path = tmp_path_factory.mktemp("study") / "study.duckdb"
    return StudyResults(write_study(path, drives, config=CONFIG))


@pytest.fixture(scope="session")
def small(tmp_path_factory):
    """o3 alone, once in every condition, and no model was asked: what drawing and writing need."""
    path = tmp_path_factory.mktemp("small") / "small.duckdb"
    return StudyResults(write_study(path, yielding("o3", reps=1)))


@pytest.fixture(scope="session")
def tables(study):
    """All tables of the study by name; the verdicts are of one driver, which takes seconds."""
    verdicts = make_tables(StudyResults(study.db, Selection(["other"])), ["verdicts"])
    return {table.name: table for table in [*verdicts, *make_tables(study, QUICK)]}


@pytest.fixture(scope="session")
def imported(tmp_path_factory):
    """Three pairs of humans, two trials each in every condition, beside a driver."""
    folder = tmp_path_factory.mktemp("imported")
    files = {}
    for experiment in (4, 6, 8):
        for number in range(2 * len(CONDITIONS)):
            played, condition = [*CONDITIONS.items()][number // 2]
            rep = number % 2
            ahead = condition.projected_headway_m + 0.1 * experiment - 0.5 + 0.3 * (rep - 1)
            yields = "both" if rep and experiment == 8 else "right" if ahead > 0 else "left"
            name = f"experiment_{experiment}/experiment_{experiment}_iter_{number + 1}.csv"
            files[name] = drive(played, yields=yields).csv()
    db = write_study(folder / "t.duckdb", yielding("o3", reps=2))
    with open_files(write_folder(folder / "recordings", files)) as found:
        import_trials(sort_files(found), Store(db))
    return StudyResults(db)
