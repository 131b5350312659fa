"""Summary of a recording as text."""

from __future__ import annotations

import json
import shlex
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from merge_runner.records import DAMAGED, is_scripted
from merge_runner.results.recorded_sweeps import carried_plugins, sweep_rows
from merge_runner.results.recording import read_provenance, read_recording
from merge_runner.text_safety import one_line


def summarise(file: Path) -> dict[str, Any]:
    """Verify a recording and count its calls by model, endpoint and outcome.

    ``scripted`` is the number of calls that a mock model answered, ``cost_usd`` the cost of the
    replies when they were made. ``plugins`` are the files whose source the recording has.
    """
    names = ("models_requested", "models_served", "endpoints", "outcomes")
    counts = {name: Counter[str]() for name in names}
    numbers = Counter(calls=0, scripted=0, attempts=0)
    cost_usd, provenance = 0.0, read_provenance(file)
    for entry in read_recording(file):
        request, last = entry.request, entry.attempts[-1]
        numbers.update(calls=1, scripted=is_scripted(request, last), attempts=len(entry.attempts))
        cost_usd += sum(attempt.cost_usd or 0.0 for attempt in entry.attempts)
        values = (request.model, last.model_served or "unknown", request.endpoint, last.outcome)
        for count, value in zip(counts.values(), values, strict=True):
            count[value] += 1
    origin = {"plugins": carried_plugins(provenance), "provenance": provenance}
    return {**numbers, "cost_usd": round(cost_usd, 6), **counts, **origin}


def summary_lines(file: Path, summary: dict[str, Any]) -> Iterator[str]:
    """Yield the summary of a recording (``summarise``) as lines of text."""
    for row in sweep_rows(summary["provenance"]):
        study, trials, models = "unknown", "unknown", ""
        with suppress(*DAMAGED):
            study, config = row["name"], json.loads(row["config"])
            models = config["model"]
            arms = config.get("arms") or [
                {"repetitions": n} for n in config["repetitions"].values()
            ]
            planned = sum(arm["repetitions"] for arm in arms) * len(config["conditions"])
            trials = f"{planned} of {models}"
        times = (str(row.get(name) or "?")[:16] for name in ("started_at", "ended_at"))
        yield one_line(f"study    {study}")
        yield one_line(f"trials   {trials}")
        yield f"played   {' to '.join(times)} UTC"
    for model, calls in summary["models_requested"].items():
        yield f"model    {model}: {calls} calls"
    scripted, calls = summary["scripted"], summary["calls"]
    if scripted:
        yield f"         {scripted} of {calls} calls were answered by a mock model"
    outcomes = ", ".join(f"{number} {outcome}" for outcome, number in summary["outcomes"].items())
    usd = f"{summary['cost_usd']:.2f} USD"
    yield f"calls    {calls} ({outcomes}), {summary['attempts']} attempts, {usd}"
    if summary["plugins"]:
        yield f"code     {', '.join(summary['plugins'])}: runs where the study is played again"
    yield f"hash     {summary['provenance']['content_sha256']} (of its replies, not of results)"
    yield f"again    merge-runner replay {shlex.quote(str(file))}"
