"""What drivers did first where they were only asked: one frame per driver and prompt."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import pandas as pd

from analysis.data.load import load_each
from analysis.data.study import Study
from merge_runner.drivers.registry import stand_in
from merge_runner.records import SIDES
from merge_runner.results.first_looks import FIRST_LOOKS
from merge_runner.results.levels import LEVELS

ROWS = (
    f"SELECT looks.*, driver FROM ({FIRST_LOOKS}) AS looks "  # noqa: S608 # constants
    "JOIN trial_drivers USING (trial_id, spec_hash) ORDER BY ALL"
)
POINT = ["headway_m", "velocity_mps"]


@dataclass(frozen=True, eq=False)
class FirstLooks:
    """The answers of a driver under one prompt and equal parameters.

    ``rows`` are those of FIRST_LOOKS; of a driver without chance, whose repetitions are the same
    answers again, only the first, and it is not ``sampled``. ``label`` is how tables name the
    driver, ``model`` the name that was asked for; of a mixed pair each is one.
    """

    label: str
    model: str
    setting: str
    spec_hash: str
    rows: pd.DataFrame
    sampled: bool

    @property
    def id(self) -> str:
        """``o3/A2``; tables name rows by it."""
        return f"{self.label}/{self.setting}"

    @property
    def valid(self) -> pd.DataFrame:
        """The answers with a plan: in the others what was driven is no choice."""
        return self.rows[self.rows["valid"]]

    @property
    def words(self) -> pd.DataFrame:
        """The answers with a tactical word."""
        return self.rows[self.rows["tactical"].notna()]


@cache
def first_looks(study: Study) -> list[FirstLooks]:
    """The drivers of a study's database that were only asked, as far as the study wants them."""
    found = load_each({"rows": ROWS, "levels": LEVELS}, study.db)
    rows, levels = found["rows"], found["levels"]
    if study.chosen is not None:
        rows = rows[rows["driver"].isin(study.chosen)]
    for factor, wanted in (study.where or {}).items():
        at = levels[(levels["factor"] == factor) & levels["value"].isin(wanted)]
        rows = rows.merge(at[["trial_id", "spec_hash"]], on=["trial_id", "spec_hash"])
    return list(_groups(rows))


def _groups(rows: pd.DataFrame) -> Iterator[FirstLooks]:
    keys = ["driver", "model", "variant", "spec_hash"]
    specs = rows.groupby(keys[:-1])["spec_hash"].nunique()
    for (driver, model, variant, spec), own in rows.groupby(keys):
        label = f"{model} of {driver}" if own["mixed"].any() else driver
        label += f" [{spec[:8]}]" if specs[driver, model, variant] > 1 else ""
        label += f" ({stand_in(dict.fromkeys(SIDES, model))})" if own["scripted"].any() else ""
        sampled = _sampled(own)
        # Repetitions of a driver without chance are the same answer again.
        answers = own if sampled else own.groupby(["condition", "side"]).head(1)
        yield FirstLooks(label, model, variant, spec, answers, sampled)


def _sampled(rows: pd.DataFrame) -> bool:
    """Whether chance is in the answers, as far as those to a repeated situation tell."""
    ways = rows.groupby(["condition", "side"])[["tactical", "action_mps2"]].agg(["size", "nunique"])
    again = ways[ways["action_mps2", "size"] > 1]
    differ = bool((again.xs("nunique", axis=1, level=1) > 1).any(axis=None))
    # A program has chance where it shows. Of a model equal answers to a single situation may be
    # chance.
    return differ or (bool(rows["asked"].any()) and len(again) < 2)
