"""The command ``merge-runner power``."""

from __future__ import annotations

import asyncio
import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from merge_runner.cli.options import (
    CacheOption,
    ConditionsOption,
    DbOption,
    JsonOption,
    ModelOption,
    OnlyOption,
    RepsOption,
    TrustOption,
    VariantsOption,
    levels,
    listed,
    print_out,
    terminal_width,
)
from merge_runner.paths import DEFAULT_CACHE, DEFAULT_DB
from merge_runner.text_safety import say


def power(
    study: Annotated[
        str, typer.Argument(metavar="STUDY", help="experiments/STUDY.toml, or a path.")
    ],
    model: ModelOption = None,
    only: OnlyOption = None,
    reps: RepsOption = None,
    conditions: ConditionsOption = None,
    variants: VariantsOption = None,
    sims: Annotated[
        int, typer.Option(metavar="N", help="Simulated studies of each size.", min=20)
    ] = 200,
    seed: Annotated[
        int, typer.Option(metavar="N", help="Another number draws other studies.", min=0)
    ] = 0,
    db: DbOption = DEFAULT_DB,
    cache: CacheOption = DEFAULT_CACHE,
    trust: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Say what a study could find and what it costs; send nothing."""
    from merge_runner.run.plan import Options, make_plan
    from merge_runner.run.sweep import unsent
    from merge_runner_analysis.data.study import Study
    from merge_runner_analysis.power.study import MULTIPLES, chances, times
    from merge_runner_analysis.power.table import table
    from merge_runner_analysis.table_format import TableFormat
    from merge_runner_analysis.tables.formats import render

    plan = make_plan(
        study,
        model or (),
        reps,
        listed(conditions),
        listed(variants),
        only=levels(only or (), "--only"),
        trust=trust,
    )
    expected = asyncio.run(
        unsent(plan, Options(db=Path(db), cache=Path(cache)), say=say, whole=True)
    )
    played = Study(db).models if Path(db).exists() else []
    found = {
        "study": plan.name,
        "driver": plan.driver,
        "arms": len(plan.arms),
        "trials": plan.trials,
        "costs_usd": [times(expected.cost_usd, multiple) for multiple in MULTIPLES],
        "free": expected.free,
        "measured": bool(expected.measured),
        "simulations": sims,
        "seed": seed,
    }
    rows = chances(plan, expected, played, simulations=sims, seed=seed)
    if as_json:
        found["chances"] = [asdict(row) for row in rows]
        print_out(json.dumps(found, ensure_ascii=False))
    else:
        print_out(render([table(found, rows)], TableFormat.TEXT, terminal_width()))
