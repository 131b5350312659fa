"""The measures in SQL (measures.sql), and the program's own numbers that they start from."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

from merge_runner.config import ScenarioConfig
from merge_runner.scenarios.merge.conditions import MEAN_SPEED_MPS
from merge_runner.scenarios.merge.geometry import TRACK


@cache
def measures_sql() -> str:
    """Definitions that take the place of older ones; the last makes ``measures_version`` known."""
    numbers = {
        "merge_point_m": TRACK.merge_point_m,
        "track_end_m": TRACK.end_m,
        "branch_sine": TRACK.branch_sine,
        "mean_speed_mps": MEAN_SPEED_MPS,
        "usual_length_m": ScenarioConfig().vehicle_length_m,
        "usual_width_m": ScenarioConfig().vehicle_width_m,
    }
    macros = [f"CREATE OR REPLACE MACRO {name}() AS {n!r}::DOUBLE;" for name, n in numbers.items()]
    views = Path(__file__).with_name("measures.sql").read_text(encoding="utf-8")
    text = "\n".join([*macros, "", views])
    return f"{text}\nCOMMENT ON VIEW trial_metrics IS '{_digest(text)}';\n"


def measures_version() -> str:
    """What tells these definitions from others: the comment on the view ``trial_metrics``."""
    return measures_sql().rpartition("IS '")[2].partition("'")[0]


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
