"""The command ``merge-runner power``."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from merge_runner.cli import options as cli
from merge_runner.paths import DEFAULT_CACHE, DEFAULT_DB
from merge_runner.text_safety import say

Named = Annotated[str, typer.Argument(metavar="STUDY", help="experiments/STUDY.toml, or a path.")]
Simulated = Annotated[int, typer.Option(metavar="N", help="Simulated studies a size.", min=20)]


def power(
    study: Named,
    model: cli.ModelOption = None,
    only: cli.OnlyOption = None,
    reps: cli.RepsOption = None,
    conditions: cli.ConditionsOption = None,
    variants: cli.VariantsOption = None,
    sims: Simulated = 100,
    db: cli.DbOption = DEFAULT_DB,
    cache: cli.CacheOption = DEFAULT_CACHE,
    trust: cli.TrustOption = False,
    as_json: cli.JsonOption = False,
) -> None:
    """Say what a study could find and what it costs; send nothing."""
    import asyncio

    from merge_runner.run.plan import Options, make_plan
    from merge_runner.run.sweep import unsent
    from merge_runner_analysis.data.study import Study
    from merge_runner_analysis.power.study import chances, power_table
    from merge_runner_analysis.table_format import TableFormat
    from merge_runner_analysis.tables.formats import render

    parts, wanted = (cli.listed(conditions), cli.listed(variants)), cli.levels(only or (), "--only")
    plan = make_plan(study, model or (), reps, *parts, only=wanted, trust=trust)
    expected = asyncio.run(unsent(plan, Options(db=db, cache=cache), say=say, whole=True))
    cost_usd = 0.0 if expected.free else expected.cost_usd
    played = Study(db).models if db.exists() else []
    rows = list(chances(plan, cost_usd, played, sims))
    if as_json:
        facts = {"study": plan.name, "trials": plan.trials, "cost_usd": cost_usd}
        cli.print_out(json.dumps({**facts, "chances": [row.values for row in rows]}))
        return
    costs = "an unknown price" if cost_usd is None else f"about {cost_usd:.2f} USD"
    about = f"{plan.name} ({plan.driver}, {plan.trials} trials, {costs}; {sims} simulated studies)"
    table = power_table(f"What can be found by {about}", rows)
    cli.print_out(render([table], TableFormat.TEXT, cli.terminal_width()))
