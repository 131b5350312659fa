"""What drivers did first where they were only asked: one frame per driver and prompt."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import pandas as pd

from analysis.data.load import load_each
from analysis.data.study import Study, with_images
from merge_runner.drivers.registry import has_chance, stand_in
from merge_runner.records import SIDES
from merge_runner.results.first_looks import FIRST_LOOKS
from merge_runner.results.levels import LEVELS
from merge_runner.results.validity import not_judged

ROWS = (
    f"SELECT looks.*, driver, ego FROM ({FIRST_LOOKS}) AS looks "  # noqa: S608 # constants
    "JOIN trial_drivers USING (trial_id, spec_hash) ORDER BY ALL"
)
POINT = ["headway_m", "velocity_mps"]


@dataclass(frozen=True, eq=False)
class FirstLooks:
    """The answers of a driver under one prompt and equal parameters.

    ``rows`` are those of FIRST_LOOKS; of a driver without chance, whose repetitions are the same
    answers again, only the first, and it is not ``sampled``. ``label`` is how tables name the
    driver, ``model`` the name that was asked for; of a mixed pair each is one, and its ``seat`` is
    ``left`` for the ego, wherever it sat, and ``right`` for the other. ``driver`` is the label
    without what is said of a stand-in, ``spec_hashes`` those of its trials, both ways round.
    """

    driver: str
    label: str
    model: str
    setting: str
    seat: str
    spec_hashes: tuple[str, ...]
    rows: pd.DataFrame
    sampled: bool

    @property
    def id(self) -> str:
        """``o3/A2``, or ``o3+constant/A2/left`` of a mixed pair; tables name rows by it."""
        return "/".join(filter(None, (self.driver, self.setting, self.seat)))

    @property
    def valid(self) -> pd.DataFrame:
        """The answers with a plan: in the others what was driven is no choice."""
        return self.rows[self.rows["valid"]]

    @property
    def unjudged(self) -> str:
        """Why nothing is concluded from them; empty where something is."""
        asked = self.rows[self.rows["asked"]]
        return not_judged(self.model, int((~asked["valid"]).sum()), len(asked))

    @property
    def words(self) -> pd.DataFrame:
        """The answers with a tactical word."""
        return self.rows[self.rows["tactical"].notna()]


@cache
def first_looks(study: Study) -> list[FirstLooks]:
    """The drivers of a study's database that were only asked, as far as the study wants them."""
    found = load_each({"rows": ROWS, "levels": LEVELS}, study.db)
    rows, levels = found["rows"], found["levels"]
    rows = rows[study.is_of_file(rows)]
    if study.chosen is not None:
        rows = rows[rows["driver"].isin(study.chosen)]
    for factor, wanted in (study.where or {}).items():
        at = levels[(levels["factor"] == factor) & levels["value"].isin(wanted)]
        rows = rows.merge(at[["trial_id", "spec_hash"]], on=["trial_id", "spec_hash"])
    groups = _groups(with_images(rows, study.specs), study.specs)
    return [looks for looks in groups if not looks.unjudged]


def _groups(rows: pd.DataFrame, specs: Mapping[str, Mapping[str, Any]]) -> Iterator[FirstLooks]:
    keys = ["driver", "model", "variant", "image"]
    images = rows.groupby(keys[:-1])["image"].nunique()
    for (pair, model, variant, image), own in rows.groupby(keys):
        mark = f" [{image[:8]}]" if images[pair, model, variant] > 1 else ""
        driver = pair + mark
        label, seat = driver, ""
        if own["mixed"].any():
            first = own.iloc[0]
            label, seat = f"{model} of {driver}", SIDES[first["side"] != first["ego"]]
        label += f" ({stand_in(dict.fromkeys(SIDES, model))})" if own["scripted"].any() else ""
        seats = own[["spec_hash", "side"]].drop_duplicates().itertuples(index=False)
        ways = own.groupby(["condition", "side"])["action_mps2"].nunique()
        sampled = bool((ways > 1).any()) or any(
            has_chance(specs.get(name, {}), [side]) for name, side in seats
        )
        answers = own if sampled else own.groupby(["condition", "side"]).head(1)
        hashes = tuple(sorted(own["spec_hash"].unique()))
        yield FirstLooks(driver, label, model, variant, seat, hashes, answers, sampled)
