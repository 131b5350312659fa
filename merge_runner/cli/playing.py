"""A plan is played, or it is said what that would take."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from merge_runner.cli.output import agree, print_out, say

if TYPE_CHECKING:
    from merge_runner.run.estimate import Estimate
    from merge_runner.run.plan import Options, Plan
    from merge_runner.run.sweep import Outcome


def play(
    plan: Plan, options: Options, *, whole: bool, dry_run: bool, yes: bool, as_json: bool
) -> int:
    """Play a plan, or print what that would take; return the exit code.

    A replay that is not ``whole`` plays what it can.
    """
    import asyncio

    from merge_runner.llm.models import shutdown_notes
    from merge_runner.run.sweep import unsent

    notes = [*plan.notes()]
    if options.replay:
        from merge_runner.run.recorded_plan import replayed

        plan, options, more = replayed(plan, options, whole=whole)
    else:
        asked = {plan.registered[name]: entry for name, entry in plan.entries.items()}
        more = [*shutdown_notes(asked, datetime.now(UTC).date())]
        options = plan.within_budget(options)
    for note in (*notes, *more):
        say(note)
    if dry_run:
        _print_estimate(asyncio.run(unsent(plan, options, say=say)), as_json=as_json)
        return 0
    return _run(plan, options, yes=yes, as_json=as_json)


def _run(plan: Plan, options: Options, *, yes: bool, as_json: bool) -> int:
    import asyncio

    from merge_runner.run import summary
    from merge_runner.run.sweep import INTERRUPTED, open_sweep

    expected = None if options.replay else _confirm(plan, options, yes=yes)

    async def run() -> Outcome:
        async with open_sweep(plan, options, say=say) as sweep:
            return await sweep.run()

    try:
        outcome = asyncio.run(run())
    except KeyboardInterrupt:  # before the trials began or after they ended
        say("interrupted: run the same command again to go on")
        return INTERRUPTED
    facts = summary.as_dict(outcome, options, expected)
    if as_json:
        print_out(json.dumps(facts, ensure_ascii=False))
    else:
        print_out("\n".join(summary.as_lines(outcome, facts)))
    for message in outcome.messages:
        say(f"error: {message}")
    return outcome.exit_code


def _confirm(plan: Plan, options: Options, *, yes: bool) -> Estimate | None:
    """Say what a live run of a paid model will cost, and ask once; None where there is no cost."""
    import asyncio

    from merge_runner.config import resolve_endpoint
    from merge_runner.run.sweep import unsent

    if all(entry.price == "free" for entry in plan.entries.values()):
        return None
    expected = asyncio.run(unsent(plan, options, say=say))
    if not expected.trials:
        return None
    if not plan.is_rehearsal:
        for name, entry in plan.entries.items():
            resolve_endpoint(name, entry)  # raises where its key is missing
    cost = "an unknown price" if expected.cost_usd is None else f"about {expected.cost_usd} USD"
    takes = f"{cost}, {expected.minutes} minutes or more"
    if (batch := expected.batch) is not None:
        halved = "" if batch.cost_usd is None else f"about {batch.cost_usd} USD in batches, "
        takes = f"{halved}{cost} singly, at most {batch.most_rounds} rounds of batches"
    agree(
        f"{expected.driver}: {expected.trials} trials, about {expected.calls} calls that are not "
        f"recorded yet, {takes}",
        "Go ahead?",
        otherwise="nothing was sent",
        yes=yes,
    )
    return expected


def _print_estimate(expected: Estimate, *, as_json: bool) -> None:
    from dataclasses import asdict

    if as_json:
        print_out(json.dumps(asdict(expected)))
        return
    cost = "unknown" if expected.cost_usd is None else f"{expected.cost_usd:.2f} USD"
    singly = ", asked singly" if expected.batch is not None else ""
    for name, text in (
        ("driver", expected.driver),
        ("trials", f"{expected.trials} that have not ended yet"),
        ("calls", f"about {expected.calls} that are not recorded yet"),
        (
            "tokens",
            f"about {expected.input_tokens} in, {expected.output_tokens} out"
            + (", as measured before" if expected.measured else ""),
        ),
        ("cost", f"about {cost}{singly}"),
        ("time", f"about {expected.minutes} minutes{singly}"),
    ):
        print_out(f"{name:<8}{text}")
    if (batch := expected.batch) is not None:
        usd = "unknown" if batch.cost_usd is None else f"{batch.cost_usd:.2f} USD"
        print_out(
            f"batch   about {usd} in about {batch.rounds} rounds, at most {batch.most_rounds}; a "
            "round takes as long as its slowest batch: minutes, an hour; after two the "
            "rest is asked singly"
        )
    if expected.trials_within_cap is not None:
        print_out(f"cap     buys about {expected.trials_within_cap} trials")
    print_out("Nothing was sent.")
