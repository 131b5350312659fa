"""The limiter and the store by themselves, each against what it stands on."""

from __future__ import annotations

import asyncio
import json
import sys
import time
from bisect import bisect_left
from dataclasses import replace
from itertools import chain, pairwise
from pathlib import Path

import duckdb

from merge_runner.drivers.language_model import Question
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.limiter import BURST_S, Limiter
from merge_runner.llm.models import load_models
from merge_runner.records import Attempt, ChatReply, Decision, make_request
from merge_runner.results.database import schema_sql
from merge_runner.results.rows import rows_of
from merge_runner.results.store import Store
from merge_runner.run.plan import make_plan
from merge_runner.run.trials import TrialMaker
from merge_runner.trial import play_trial
from merge_runner.trial_records import TrialRecord

WAITERS, LIMIT, WINDOW_S = 2_000, 500, 1.0
BATCHES, TRIALS = 10, 60


async def limiter() -> dict[str, float]:
    """2,000 waiters at 500 a window, the window shortened from a minute to a second."""
    limit = Limiter(rpm=LIMIT, window_s=WINDOW_S)
    served: list[tuple[float, int]] = []
    loop = asyncio.get_running_loop()

    async def wait(order: int) -> None:
        await limit.acquire(0, order=order)
        served.append((loop.time(), order))

    cpu_s, began = time.process_time(), loop.time()
    await asyncio.gather(*(wait(order) for order in range(WAITERS)))
    wall_s, cpu_s = loop.time() - began, time.process_time() - cpu_s
    times = [at for at, _ in served]
    worst = max(bisect_left(times, at + WINDOW_S) - n for n, at in enumerate(times))
    orders = [order for _, order in served]
    # The last burst of the last window may go half a second before that window ends.
    ideal_s = WAITERS / LIMIT * WINDOW_S - BURST_S
    return {
        "limiter_achieved": ideal_s / (times[-1] - times[0]),
        "limiter_worst_window": worst / LIMIT,
        "limiter_displaced": sum(a > b for a, b in pairwise(orders)),
        "limiter_cpu_share": cpu_s / wall_s,
    }


def records(count: int) -> list[TrialRecord]:
    """Trials of a model that always yields, with prompts and replies of the usual length."""
    plan = make_plan("baseline", "emulator")
    entry = load_models()["emulator"]
    text = f"Y\n{'I keep my distance. ' * 80}\n```python\n{[-0.4] * 20}\n```"
    payload = {"id": "ID", "choices": [{"message": {"content": text}, "finish_reason": "stop"}]}

    def decide(question: Question) -> Decision:
        wire = FORMATS[entry.format].request(entry, question.prompt)
        request = make_request(
            provider=entry.provider,
            endpoint="benchmark",
            model=entry.id,
            path=wire.path,
            headers=wire.headers,
            body=wire.body,
            slot=question.slot,
        )
        attempt = Attempt(1, "ok", http_status=200, reply=json.dumps(payload))
        return question.decision(question.prompt, ChatReply(text, "ok", request, (attempt,), 0))

    trials = TrialMaker(plan)
    return [play_trial(trials.make(spec), decide) for spec in plan.trial_specs()[:count]]


def store(folder: Path) -> dict[str, float]:
    """Batches of trials: our store, and the bare Appender with rows that are made already."""
    played = records(TRIALS)
    ours, bare = Store(folder / "ours.duckdb"), folder / "bare.duckdb"
    with duckdb.connect(bare) as connection:
        connection.execute(schema_sql())
    ours_s = bare_s = 0.0
    rows = 0
    for number in range(BATCHES):
        batch = [
            record._replace(spec=replace(record.spec, trial_id=f"{record.spec.trial_id}/{number}"))
            for record in played
        ]
        made = [rows_of(record) for record in batch]
        tables = {
            name: list(chain.from_iterable(trial[name] for trial in made)) for name in made[0]
        }
        rows += sum(map(len, tables.values()))
        began = time.perf_counter()
        ours.write("benchmark", batch, patience_s=1.0)
        ours_s += time.perf_counter() - began
        began = time.perf_counter()
        with duckdb.connect(bare) as connection:
            for table, values in tables.items():
                appender = connection.appender(table)
                appender.append_rows(values)
                appender.flush()
        bare_s += time.perf_counter() - began
    return {
        "store_us_per_row": 1e6 * ours_s / rows,
        "appender_us_per_row": 1e6 * bare_s / rows,
        "store_ratio": ours_s / bare_s,
    }


def main() -> None:
    """Print all figures as JSON; the argument is a folder to work in."""
    figures = {**asyncio.run(limiter()), **store(Path(sys.argv[1]))}
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
