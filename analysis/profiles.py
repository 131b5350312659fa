"""The fits of I5: computed once for each vehicle, and kept in the database."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from analysis.kept import has, keep_fits, program
from analysis.piecewise import fit_profiles
from merge_runner.database import read_database

KEY = ["trial_id", "spec_hash", "side"]
# One row a vehicle; ``speeds`` is a hash of what is fitted.
VEHICLES = """
SELECT trial_id, spec_hash, side, sum(hash(step, time_s, velocity_mps))::VARCHAR AS speeds
FROM states WHERE time_s >= 0 GROUP BY ALL
"""
FITS = """
SELECT * EXCLUDE (program) FROM i5_fits
SEMI JOIN vehicles USING (trial_id, spec_hash, side, speeds) WHERE program = ?
"""
SPEEDS = """
SELECT trial_id, spec_hash, side, list(time_s ORDER BY step) AS time_s,
    list(velocity_mps ORDER BY step) AS velocity_mps
FROM states SEMI JOIN missing USING (trial_id, spec_hash, side) WHERE time_s >= 0 GROUP BY ALL
"""


def fitted_profiles(db: Path) -> pd.DataFrame:
    """The rows of ``fit_profiles`` that have a fit; what is not kept is fitted, and kept."""
    with read_database(db) as connection:
        vehicles = connection.execute(VEHICLES).df()
        connection.register("vehicles", vehicles)
        fits = vehicles[:0]
        if has(connection, "i5_fits"):
            fits = connection.execute(FITS, [program()]).df()
        missing = vehicles.merge(fits[KEY], on=KEY, how="left", indicator=True)
        missing = missing.loc[missing.pop("_merge") == "left_only"]
        if len(missing):
            connection.register("missing", missing)
            speeds = connection.execute(SPEEDS).df()
    if len(missing):
        new = fit_profiles(speeds).merge(missing, on=KEY)
        keep_fits(db, new.assign(program=program()))
        fits = pd.concat([fits, new]) if len(fits) else new
    return fits.drop(columns="speeds").dropna().sort_values(KEY, ignore_index=True)
