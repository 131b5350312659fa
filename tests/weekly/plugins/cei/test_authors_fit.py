"""The authors' fit, on drivers whose thresholds are known."""

import sys

import numpy as np
import pytest
from scipy.stats import spearmanr

from merge_runner.errors import UsageError
from merge_runner.results.store import Store
from merge_runner_analysis.data.load import load
from merge_runner_cei.calibration import __main__ as calibration
from merge_runner_cei.calibration.authors_fit import GRID, REACTIONS, estimated, grid_speeds
from merge_runner_cei.parameters import OFFSETS, SETS, Base
from tests.support.cei_synthetic import write_humans


@pytest.fixture(scope="module")
def humans(tmp_path_factory):
    return write_humans(tmp_path_factory.mktemp("humans") / "merge.duckdb", SETS["K0"], 5)


@pytest.fixture
def command(monkeypatch, capsys):
    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["calibration", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            calibration.main()
        printed = capsys.readouterr()
        return ended.value.code, printed.out + printed.err

    return run


def test_a_database_without_humans_says_what_to_type(tmp_path, command):
    db = tmp_path / "merge.duckdb"
    Store(db).add_recorded([], {})
    code, printed = command("fit", "--db", db)
    assert (code, "human import PATH" in printed) == (2, True)


def test_the_order_of_the_drivers_is_found_again(humans):
    estimates = estimated(load(REACTIONS, humans))
    for n, threshold in enumerate(("lower", "upper")):
        planted = {
            f"pair{pair}-{side}": SETS["K0"].base(offset)[n]
            for pair, offsets in enumerate(OFFSETS, 1)
            for side, offset in zip(("left", "right"), offsets, strict=True)
        }
        found = estimates.groupby("driver")[threshold].mean()
        assert spearmanr(found, [planted[name] for name in found.index])[0] > 0.8


def test_an_agent_of_the_grid_is_given_its_own_thresholds_or_equal_ones():
    speeds = grid_speeds()
    assert {len(found) for found in speeds.values()} == {len(GRID)} == {625}
    # Mirrored conditions are one for the two sides.
    np.testing.assert_array_equal(speeds["L_4_8", "left"], speeds["R_-4_-8", "right"])
    agent = GRID.index(min(GRID, key=lambda one: abs(one.lower - 0.2) + abs(one.upper - 0.4)))
    assert speeds["N_0_0", "left"][agent] < 9.5
    assert isinstance(GRID[agent], Base)


def test_the_command_prints_a_driver_that_a_study_can_play(humans, command):
    code, printed = command("fit", "--db", humans)
    assert (code, printed.count("pair9-right")) == (0, 2)
    assert 'program = "cei"' in printed
    assert "upper_product = " in printed


def test_an_unknown_set_is_refused_with_those_that_there_are(command):
    code, printed = command("check", "K9")
    assert (code, "K0" in printed) == (UsageError.exit_code, True)
