"""The command ``merge-runner power``."""

from __future__ import annotations

import asyncio
import json
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
    ] = 100,
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
    from merge_runner_analysis.power.study import chances, power_table
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
    options = Options(db=Path(db), cache=Path(cache))
    expected = asyncio.run(unsent(plan, options, say=say, whole=True))
    cost_usd = 0.0 if expected.free else expected.cost_usd
    played = Study(db).models if Path(db).exists() else []
    rows = list(chances(plan, cost_usd, played, sims, seed))
    if as_json:
        facts = {"study": plan.name, "driver": plan.driver, "trials": plan.trials}
        facts |= {"cost_usd": cost_usd, "simulations": sims, "seed": seed}
        print_out(json.dumps(facts | {"chances": rows}, ensure_ascii=False))
        return
    costs = "an unknown price" if cost_usd is None else f"about {cost_usd:.2f} USD"
    about = f"{plan.driver}, {plan.trials} trials, {costs}; {sims} simulated studies"
    table = power_table(f"What the study {plan.name} can find ({about})", rows)
    print_out(render([table], TableFormat.TEXT, terminal_width()))
