"""The same workload in inspect-ai, to be run in an environment of its own (make bench makes it).

110 samples, each of 10 rounds in which two prompts are answered at once, as a trial's two drivers
are; every prompt is a conversation of its own. ``--retry`` goes on with the last log.
"""

from __future__ import annotations

import argparse
import asyncio
import os
from pathlib import Path

from inspect_ai import Task, eval, eval_retry, task  # noqa: A004 # its name there
from inspect_ai.dataset import MemoryDataset, Sample
from inspect_ai.log import list_eval_logs
from inspect_ai.model import CachePolicy, ChatMessageUser, get_model
from inspect_ai.solver import Generate, Solver, TaskState, solver

from benchmarks.workload import CALLS, PROMPT, TRIALS


@solver
def drive(rounds: int, cached: bool) -> Solver:
    """Two conversations in step."""

    async def solve(state: TaskState, generate: Generate) -> TaskState:
        policy = CachePolicy(expiry=None, per_epoch=False) if cached else False
        for number in range(rounds):
            replies = await asyncio.gather(
                *(
                    get_model().generate(
                        [ChatMessageUser(content=f"{state.sample_id} {side} {number} {PROMPT}")],
                        cache=policy,
                    )
                    for side in ("left", "right")
                )
            )
            state.output = replies[0]
        return state

    return solve


@task
def merge(trials: int, rounds: int, cached: bool) -> Task:
    """One sample a trial."""
    samples = [Sample(id=number, input=f"trial {number}") for number in range(1, trials + 1)]
    return Task(dataset=MemoryDataset(samples), solver=drive(rounds, cached))


def main() -> None:
    """Run or go on."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--url", required=True)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--trials", type=int, default=TRIALS)
    parser.add_argument("--rounds", type=int, default=CALLS // 2)
    parser.add_argument("--in-flight", type=int, default=200)
    parser.add_argument("--cache", action="store_true")
    parser.add_argument("--retry", action="store_true")
    args = parser.parse_args()
    os.environ["OPENAI_API_KEY"] = "benchmark-key"
    os.environ["INSPECT_CACHE_DIR"] = str(args.folder / "cache")
    common = {"log_dir": str(args.folder / "logs"), "display": "none"}
    limits = {"max_connections": args.in_flight, "max_samples": args.in_flight}
    if args.retry:
        logs = list_eval_logs(common["log_dir"])
        done = eval_retry(logs[0], **common, **limits)
    else:
        done = eval(
            merge(args.trials, args.rounds, args.cache),
            model="openai/benchmark",
            model_base_url=args.url,
            model_args={"responses_api": False},
            **common,
            **limits,
        )
    if done[0].status != "success":
        raise SystemExit(f"it ended as {done[0].status}: {getattr(done[0].error, 'message', '')}")


if __name__ == "__main__":
    main()
