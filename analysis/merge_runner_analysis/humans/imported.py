"""The imported human trials beside the 990 published ones, whose outcomes these do not replace."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pandas as pd

from merge_runner.records import SIDES
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.frames import load
from merge_runner_analysis.published import HUMAN_TRIALS, PAIRS, published

OUTCOMES = ["left_first", "right_first", "collided"]
VELOCITY_PAGES = "velocity pages"  # what a spec says of trials that are not of the recordings
TRIALS = f"""
SELECT pair, condition, status, merged_first,
    coalesce(spec->>'$.origin' = '{VELOCITY_PAGES}', false) AS of_pages
FROM trials LEFT JOIN specs USING (spec_hash) WHERE source = 'human'
"""  # noqa: S608 # constants


def human_trials(db: Path) -> pd.DataFrame:
    """Return the human trials of a database; raises UsageError."""
    return load(TRIALS, db)


def of_published_pairs(trials: pd.DataFrame) -> pd.DataFrame:
    """Return the trials of the nine published pairs, or all trials if none is of these pairs."""
    is_published = trials["pair"].isin(PAIRS.values())
    return trials[is_published] if is_published.any() else trials


def findings(trials: pd.DataFrame) -> Iterator[str]:
    """Yield remarks on imported human trials, which have the columns of TRIALS."""
    chosen = of_published_pairs(trials)
    if len(chosen) < HUMAN_TRIALS:
        yield (
            f"{len(chosen)} of {HUMAN_TRIALS} trials are imported; who merged first and collisions "
            f"are the {HUMAN_TRIALS} published outcomes"
        )
    known = published("human_outcomes").set_index("condition")[OUTCOMES]
    more = (by_condition(trials)[OUTCOMES] > known).any(axis=1)
    if more.any() or not chosen["pair"].isin(PAIRS.values()).all():
        where = f": more of an outcome in {', '.join(known.index[more])}" if more.any() else ""
        yield f"another data set than the published one{where}"
    if pages := chosen["of_pages"].sum():
        yield (
            f"{pages} of {len(chosen)} trials are of the public velocity pages, with positions "
            "made of the speeds; the others are of the recordings"
        )


def by_condition(trials: pd.DataFrame) -> pd.DataFrame:
    """Return counts of each condition over the published pairs, and the published ones."""
    published_pairs = trials[trials["pair"].isin(PAIRS.values())]
    known = published("human_outcomes").set_index("condition")[OUTCOMES].astype(str)
    counts = counted(published_pairs, "condition").reindex(HUMAN_CONDITIONS, fill_value=0)
    return counts.assign(published=known.agg(" ".join, axis=1))


def counted(trials: pd.DataFrame, by: str) -> pd.DataFrame:
    """Return the numbers of trials and OUTCOMES by a column."""
    ways = {side: trials["merged_first"] == side for side in SIDES}
    frame = trials.assign(
        trials=1, left_first=ways["left"], right_first=ways["right"],
        collided=trials["status"] == "collided",
    )  # fmt: skip
    return frame.groupby(by)[["trials", *OUTCOMES]].sum().astype(int)
