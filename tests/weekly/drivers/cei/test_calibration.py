"""The calibration of cei: the authors' fit of known drivers, the search, and what the docs tell."""

import re
import subprocess
import sys
from dataclasses import replace

import pytest
from scipy.stats import spearmanr

from analysis.research.cei_calibration import __main__ as calibration
from analysis.research.cei_calibration.authors_fit import REACTIONS, estimated
from analysis.research.cei_calibration.design import design, experiment, model_of
from analysis.research.cei_calibration.search import MISSING, cost, search, targets
from analysis.research.cei_calibration.searches import SEARCHES
from analysis.research.cei_calibration.simulation import simulate
from merge_runner.drivers.cei.driver import check
from merge_runner.drivers.cei.parameters import OFFSETS, SETS, TICK_S
from merge_runner.errors import UsageError
from merge_runner.records import SIDES
from merge_runner.results.store import Store
from merge_runner_analysis.frames import load
from merge_runner_analysis.humans.record import SPEC, SPEC_HASH, Trace, trial_record
from merge_runner_analysis.published import PAIRS
from tests.support.cei_trials import scenario, simulated
from tests.support.harness import PROJECT, environment

ENDS = {"finished": "Finished", "collided": "Collided", "timeout": "Time ran out"}


@pytest.fixture(scope="module")
def humans(tmp_path_factory):
    """A database in which each pair of the model's has driven each condition, as humans."""
    trials = design(SETS["K0"], experiment(), 0, 5)
    traces = simulate(model_of(SETS["K0"], experiment()), trials, tunnel=True)

    def record(n):
        until, experiments = traces.ended_at[n] + 1, [*PAIRS]
        positions, speeds = (
            {side: of[:until, i, n].tolist() for i, side in enumerate(SIDES)}
            for of in (traces.positions_m, traces.speeds_mps)
        )
        trace = Trace(TICK_S, ENDS[str(traces.status[n])], positions, speeds)
        # The pairs of the design take turns.
        return trial_record(trace, experiments[n % len(OFFSETS)], n)

    db = tmp_path_factory.mktemp("humans") / "merge.duckdb"
    Store(db).add_recorded([record(n) for n in range(len(trials))], {SPEC_HASH: SPEC})
    return db


@pytest.fixture
def command(monkeypatch, capsys):
    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["calibration", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            calibration.main()
        printed = capsys.readouterr()
        return ended.value.code, printed.out + printed.err

    return run


def test_the_command_prints_a_driver_that_a_study_can_play(humans, command):
    code, printed = command("fit", "--db", humans)
    assert (code, printed.count("pair9-right")) == (0, 2)
    assert 'program = "cei"' in printed
    assert "upper_product = " in printed


def test_a_database_without_humans_or_an_unknown_set_says_what_to_type(tmp_path, command):
    Store(tmp_path / "merge.duckdb").add_recorded([], {})
    code, printed = command("fit", "--db", tmp_path / "merge.duckdb")
    assert (code, "human import PATH" in printed) == (2, True)
    code, printed = command("check", "K9")
    assert (code, "K0" in printed) == (UsageError.exit_code, True)


def test_the_order_of_the_drivers_is_found_again(humans):
    estimates = estimated(load(REACTIONS, humans))
    for n, threshold in enumerate(("lower", "upper")):
        planted = {
            f"pair{pair}-{side}": SETS["K0"].base(offset)[n]
            for pair, offsets in enumerate(OFFSETS, 1)
            for side, offset in zip(SIDES, offsets, strict=True)
        }
        found = estimates.groupby("driver")[threshold].mean()
        assert spearmanr(found, [planted[name] for name in found.index])[0] > 0.8


def test_the_design_has_each_pair_ten_times_in_each_condition_with_the_seeds_of_the_slots():
    trials = design(SETS["K0"], experiment(), 0)
    assert len(trials) == 990
    assert len({seed for one in trials for seed in one.seeds}) == 2 * 990
    assert trials[:90] == [simulated("R_-4_-8", n, scenario()) for n in range(1, 91)]


def test_a_miss_by_its_tolerance_costs_one_and_a_number_without_a_fit_much():
    wanted = targets()
    exact = {(one.measure, one.term): one.value for one in wanted}
    assert cost(exact, wanted) == 0
    assert cost({**exact, ("collisions", "count"): 33.0}, wanted) == pytest.approx(1)
    del exact["who_first", "intercept"]
    assert cost(exact, wanted) == MISSING**2


def test_a_search_looks_only_for_thresholds_that_a_study_may_set():
    edge = SETS["K0"]._replace(lower_spread=0.0, upper_spread=0.0, upper_mean=1.0)
    small = {"generations": 1, "size": 6, "seed": 1, "trials_of_a_pair": 1}
    for found in search(edge, experiment(), targets(), **small):
        check({"pair": 0, **found.thresholds._asdict()})


@pytest.mark.parametrize("name", SETS)
def test_the_search_for_a_set_can_be_repeated(name):
    small = replace(SEARCHES[name], generations=1, size=3, trials_of_a_pair=1)
    (*_, found), (*_, again) = small.run(), small.run()
    assert found == again
    assert found.thresholds != SEARCHES[name].start


SHOWN = [(3, ["K0"]), (4, ["F1"]), (5, ["drag-free"]), (6, ["K0", "--tunnel"])]


@pytest.mark.parametrize(("column", "command"), SHOWN)
def test_the_readme_prints_the_results_of_the_driver_cei(column, command):
    program = [sys.executable, "-m", "analysis.research.cei_calibration", "check", *command]
    out = subprocess.check_output(program, cwd=PROJECT, env=environment(), text=True)
    # Each line ends with the mean, its spread, the tolerance and by how many of these it is off.
    found = [tuple(map(float, line.split()[-4:-2])) for line in out.splitlines()[1:]]
    readme = PROJECT / "analysis/research/cei_calibration/README.md"
    text = readme.read_text("utf-8").replace("\N{MINUS SIGN}", "-")
    rows = re.findall(r"^\| (?:collisions|time-outs|who|gap|largest|conflict|first).*", text, re.M)
    cells = [re.split(r"(?<!\\)\|", row)[column].replace("*", "") for row in rows]
    shown = [tuple(map(float, re.findall(r"-?\d+(?:\.\d+)?", cell))) for cell in cells]
    # Counts are shown with one decimal of two.
    assert shown[:2] == [pytest.approx(pair, abs=0.051) for pair in found[:2]]
    assert shown[2:] == found[2:]
