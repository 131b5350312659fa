"""Measures in SQL (measures.sql) with the program's constants."""

from __future__ import annotations

import hashlib
import re
from functools import cache
from pathlib import Path

from merge_runner.config import ScenarioConfig
from merge_runner.scenarios.merge.conditions import MEAN_SPEED_MPS
from merge_runner.scenarios.merge.geometry import TRACK

NO_CONFLICT_MPS = 0.01
"""Closing speed below which there is no conflict: equal speeds differ by rounding."""


def measures_sql() -> str:
    """Return definitions that replace older ones, with a macro of their version."""
    version = f"CREATE OR REPLACE MACRO measures_version() AS '{measures_version()}';"
    return f"{_definitions()}\n{version}\n"


def measures_version() -> str:
    """Return a hash of the definitions without their comments."""
    statements = re.sub(r"(?m)^[ \t]*--.*\n", "", _definitions()).rstrip("\n").split(";\n")
    defined = [text for text in statements if not text.lstrip().startswith("COMMENT ON")]
    return hashlib.sha256("\n".join(defined).encode()).hexdigest()


@cache
def _definitions() -> str:
    numbers = {
        "merge_point_m": TRACK.merge_point_m,
        "track_end_m": TRACK.end_m,
        "branch_sine": TRACK.branch_sine,
        "mean_speed_mps": MEAN_SPEED_MPS,
        "usual_length_m": ScenarioConfig().vehicle_length_m,
        "usual_width_m": ScenarioConfig().vehicle_width_m,
        "no_conflict_mps": NO_CONFLICT_MPS,
    }
    macros = [f"CREATE OR REPLACE MACRO {name}() AS {n!r}::DOUBLE;" for name, n in numbers.items()]
    views = Path(__file__).with_name("measures.sql").read_text(encoding="utf-8")
    return "\n".join([*macros, "", views])
