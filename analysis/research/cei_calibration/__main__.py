"""Find thresholds, and print their results: ``python -m analysis.research.cei_calibration``."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from merge_runner.cli.options import DbOption, print_out
from merge_runner.config import Resistance
from merge_runner.drivers.cei.parameters import SETS, ThresholdSet
from merge_runner.errors import MergeRunnerError
from merge_runner.paths import DEFAULT_DB
from merge_runner.registry import require
from merge_runner.text_safety import say

if TYPE_CHECKING:
    import pandas as pd

    from analysis.research.cei_calibration.authors_fit import Fit

app = typer.Typer(help="Thresholds of the driver cei.", no_args_is_help=True)
SetArgument = Annotated[str, typer.Argument(metavar="SET", help=f"{', '.join(SETS)}.")]
ResistanceOption = Annotated[
    Resistance | None,
    typer.Option("--resistance", help="Not the one that the set was calibrated for."),
]


@app.command()
def check(
    name: SetArgument,
    resistance: ResistanceOption = None,
    sets: Annotated[int, typer.Option("--sets", help="How many times 990 trials.", min=1)] = 5,
    tunnel: Annotated[
        bool, typer.Option("--tunnel", help="Start in the tunnels, as the published model did.")
    ] = False,
) -> None:
    """Simulate 990 trials of each sample set from 0 on, and compare with what is published."""
    from analysis.research.cei_calibration.design import experiment
    from analysis.research.cei_calibration.search import compared, numbers_of
    from analysis.research.cei_calibration.searches import SEARCHES

    thresholds = require(SETS, "set", name)
    scenario = experiment(resistance or SEARCHES[name].resistance)
    numbers = [numbers_of(thresholds, scenario, n, tunnel=tunnel) for n in range(sets)]
    print_out(_text(compared(numbers)))


@app.command()
def search(
    name: SetArgument,
    generations: Annotated[int | None, typer.Option(min=1)] = None,
    size: Annotated[int | None, typer.Option(help="Candidates of a generation.", min=4)] = None,
    trials: Annotated[
        int | None,
        typer.Option(help="Of each synthetic pair in each condition; 10 are 990 in all.", min=2),
    ] = None,
    seed: int | None = None,
) -> None:
    """Search for a set anew, from where its search began; with other numbers, for a better one."""
    from analysis.research.cei_calibration.searches import SEARCHES

    changes = {
        "generations": generations,
        "size": size,
        "trials_of_a_pair": trials,
        "seed": seed,
    }
    given: dict[str, Any] = {key: value for key, value in changes.items() if value is not None}
    for step in replace(require(SEARCHES, "set", name), **given).run():
        say(f"generation {step.number}: cost {step.cost:.1f} at best; {_line(step.thresholds)}")
    print_out(_line(step.thresholds))


@app.command()
def fit(db: DbOption = DEFAULT_DB) -> None:
    """Fit thresholds to the imported humans, as the model's authors did."""
    from analysis.research.cei_calibration.authors_fit import fit_thresholds, threshold_set

    fits = fit_thresholds(Path(db))
    for name, model in zip(("lower", "upper"), fits, strict=True):
        print_out(
            f"{name} threshold, {model.n} trials; how far each driver's is off:\n{_drivers(model)}"
        )
    print_out(f'\n[drivers.fitted]\nprogram = "cei"\nset = "{next(iter(SETS))}"')
    print_out(_line(threshold_set(*fits), "\n"))


def _line(thresholds: ThresholdSet, between: str = ", ") -> str:
    return between.join(f"{name} = {value:.4f}" for name, value in thresholds._asdict().items())


def _drivers(model: Fit) -> str:
    return "\n".join(f"  {name} {effect:+.4f}" for name, effect in sorted(model.drivers.items()))


def _text(table: pd.DataFrame) -> str:
    return str(table.to_string(index=False, float_format="{:.2f}".format, na_rep=""))


def main() -> None:
    """Run the command line; exit codes are those of merge-runner."""
    try:
        app()
    except MergeRunnerError as exc:
        say(f"error: {exc}")
        sys.exit(exc.exit_code)


if __name__ == "__main__":
    main()
