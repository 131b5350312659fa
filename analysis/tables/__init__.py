"""The paper's tables, and those that say what these cannot."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pandas as pd

from analysis.study import Study
from analysis.tables.ablations import ablation_qualitative, ablation_quantitative
from analysis.tables.attempts import attempts
from analysis.tables.conflicts import conflict_resolution, criticality
from analysis.tables.contrasts import contrasts
from analysis.tables.fallbacks import fallbacks
from analysis.tables.formats import value_rows
from analysis.tables.indicators import indicators
from analysis.tables.model import Table
from analysis.tables.profiles import velocity_profiles
from analysis.tables.regressions import gap, who_first
from analysis.tables.robustness import robustness
from analysis.tables.windows import speed_windows
from merge_runner.errors import UsageError

TABLES: dict[str, Callable[[Study], Table]] = {
    "who-first": who_first,
    "gap": gap,
    "indicators": indicators,
    "ablation-qualitative": ablation_qualitative,
    "ablation-quantitative": ablation_quantitative,
    "contrasts": contrasts,
    "velocity-profiles": velocity_profiles,
    "conflict-resolution": conflict_resolution,
    "criticality": criticality,
    "speed-windows": speed_windows,
    "robustness": robustness,
    "attempts": attempts,
    "fallbacks": fallbacks,
}


def make_tables(study: Study, names: Sequence[str] = ()) -> list[Table]:
    """The named tables, or all; raises UsageError."""
    for name in names:
        if name not in TABLES:
            raise UsageError(f"there is no table {name!r}; valid: {', '.join(TABLES)}")
    return [TABLES[name](study) for name in names or TABLES]


def table(study: Study, name: str) -> pd.DataFrame:
    """A table as a data frame, at full precision, one row as in its CSV; raises UsageError."""
    (made,) = make_tables(study, [name])
    return pd.DataFrame(value_rows(made)).set_index("row")
