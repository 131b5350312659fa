"""Outcomes of trials as a regression reads them."""

import numpy as np
import pandas as pd

COLUMNS = ["projected_headway_m", "relative_velocity_mps", "status", "merged_first", "gap_m"]


def frame(rows) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=COLUMNS)


def who_first_arrays(trials):
    h, dv = trials["projected_headway_m"], trials["relative_velocity_mps"]
    return np.column_stack([np.ones(len(trials)), h, dv]), 1.0 * (trials["merged_first"] == "left")
