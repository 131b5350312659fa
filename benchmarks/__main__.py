"""Runs all cases, interleaved, and writes figures and goals: ``python -m benchmarks``."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from statistics import median

from benchmarks.cases import (
    STUDIES,
    Bench,
    Case,
    analysis,
    cached_floor,
    cold,
    cold_floor,
    committed_recording,
    further,
    import_humans,
    imports,
    in_flight,
    in_flight_floor,
    limited,
    on_a_cache,
    paid,
    parts,
    record_many,
    replay,
    replay_many,
    resume,
    short,
    short_floor,
    start,
)
from benchmarks.explorer import explorer, explorer_floor, export, first_page
from benchmarks.goals import judged
from benchmarks.peers import installed, peer_cached, peer_cold, peer_resume
from benchmarks.processes import served
from benchmarks.soak import soak

PEERS = (
    Case("inspect-ai, 0 ms", 1, peer_cold),
    Case("inspect-ai, cached", 1, peer_cached),
    Case("inspect-ai, killed at half, resumed", 1, peer_resume),
)
CASES = (
    Case("floor, 0 ms", 3, cold_floor(0)),
    Case("cold, 0 ms", 3, cold(0)),
    Case("floor, cached", 3, cached_floor),
    Case("replay", 3, replay),
    Case("replay of the committed recording", 1, committed_recording),
    Case("floor, imports", 3, imports("duckdb, httpx, pydantic")),
    Case("recording 1", 1, record_many(1)),
    Case("replay of 1", 3, replay_many(1)),
    Case("--help", 3, start("--help")),
    Case("sweep --dry-run", 2, start("sweep", "baseline", "--dry-run")),
    Case("cold, paid model", 1, paid),
    Case("cold, 200 ms", 1, cold(200)),
    Case("floor, further calls", 1, further(short_floor)),
    Case("cold, further calls", 1, further(short)),
    Case("50 in flight", 1, in_flight(200, 50)),
    Case("200 in flight", 1, in_flight(200, 200)),
    Case("2,000 in flight", 1, in_flight(2_000, 2_000)),
    Case("1,000 in flight, 1 s", 1, in_flight(1_000, 1_000, 1_000)),
    Case("floor, 1,000 in flight, 1 s", 1, in_flight_floor(1_000, 1_000, 1_000)),
    Case("killed at half, resumed", 1, resume),
    Case("6,000 requests/min", 1, limited),
    Case("limiter and store", 1, parts),
    Case("recording 110 short", 1, record_many(110)),
    Case("replay of 110 short", 1, replay_many(110)),
    Case("recording 11,000", 1, record_many(11_000)),
    Case("replay of 11,000", 1, replay_many(11_000)),
    Case("recording 11", 1, record_many(11)),
    *(
        Case(f"{what} of 11, {replies:,} replies", 3, on_a_cache(11, trials, replayed=replayed))
        for what, replayed in (("sweep", False), ("replay", True))
        for trials, replies in ((11, 88), (11_000, 88_000))
    ),
    Case("import of 990 human trials", 1, import_humans),
    Case("floor, libraries", 3, imports("pandas, scipy.stats, statsmodels.api")),
    *(
        Case(
            f"{what} of {trials:,}, {heat}",
            3 if (trials, heat) == (min(STUDIES), "cold") else 1,
            analysis(trials, what, warm=heat == "warm"),
        )
        for trials in STUDIES
        for what in ("tables", "report")
        for heat in ("cold", "warm")
        # A second report of the smaller studies says nothing new.
        if (what, heat) != ("report", "warm") or trials == max(STUDIES)
    ),
    Case("explorer of 11,000", 1, explorer(max(STUDIES))),
    Case("floor, explorer of 11,000", 1, explorer_floor),
    Case("first page of 2,200", 1, first_page(2_200)),
    Case("first page of 11,000", 1, first_page(max(STUDIES))),
    Case("export of 660", 1, export(660)),
    Case("soak of 200", 1, soak(200, lives_s=3), is_long=True),
    Case("soak of 10,000", 1, soak(10_000, lives_s=30), is_long=True),
    *PEERS,
)


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--only", default="*", help="cases whose name fits this pattern")
    parser.add_argument("--skip", default="", help="cases whose name does not fit this one")
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks.json"))
    args = parser.parse_args()
    cases = [case for case in CASES if case.chosen(args.only, args.skip)]
    if not installed():
        _say("inspect-ai is not compared with: `make bench` installs it")
        cases = [case for case in cases if case not in PEERS]
    samples: dict[str, list[dict[str, float]]] = {}
    began = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="merge-runner-") as folder, served() as server:
        bench = Bench(Path(folder), server)
        for number in range(max(case.rounds for case in cases)):
            for case in (case for case in cases if case.rounds > number):
                _say(f"[{time.perf_counter() - began:4.0f} s] {case.name}")
                figures = case.measure(bench)
                if figures:
                    samples.setdefault(case.name, []).append(figures)
    medians = {
        name: {figure: median(run[figure] for run in runs) for figure in runs[0]}
        for name, runs in samples.items()
    }
    goals = [
        {"what": goal.what, "bound": goal.bound, "value": value, "unit": goal.unit}
        | {"met": goal.met(value), "at_most": goal.at_most}
        for goal, value in judged(samples)
    ]
    args.out.parent.mkdir(parents=True, exist_ok=True)
    machine = {"cpus": os.cpu_count(), "system": platform.platform(), **_versions()}
    result = {"machine": machine, "cases": medians, "goals": goals, "samples": samples}
    args.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(tables(medians, goals))
    _say(f"{args.out} holds every figure; {time.perf_counter() - began:.0f} s")


def tables(medians: dict[str, dict[str, float]], goals: list[dict[str, object]]) -> str:
    """Both tables in Markdown."""
    lines = ["| goal | bound | here | |", "|---|---:|---:|---|"]
    for goal in goals:
        sign, verdict = "≤" if goal["at_most"] else "≥", "met" if goal["met"] else "**missed**"
        unit = goal["unit"]
        lines.append(
            f"| {goal['what']} | {sign} {goal['bound']:g} {unit} | {_short(goal['value'])} {unit} "
            f"| {verdict} |"
        )
    lines += ["", "| case | wall s | CPU s | peak MB | ms CPU per call | other |"]
    lines += ["|---|---:|---:|---:|---:|---|"]
    for name, figures in medians.items():
        known = [figures.get(figure) for figure in ("wall_s", "cpu_s", "peak_mb")]
        calls = figures.get("calls")
        known.append(1000 * figures["cpu_s"] / calls if calls else None)
        other = "; ".join(
            f"{figure} {_short(value)}"
            for figure, value in figures.items()
            if figure not in ("wall_s", "cpu_s", "peak_mb")
        )
        cells = [_short(value) if value else "" for value in known]
        lines.append(f"| {name} | {' | '.join(cells)} | {other} |")
    return "\n".join(lines)


def _short(value: object) -> str:
    assert isinstance(value, int | float)
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _versions() -> dict[str, str]:
    packages = ("aiohttp", "diskcache", "duckdb", "httpx", "httpx-aiohttp", "pydantic")
    return {"python": platform.python_version(), **{name: version(name) for name in packages}}


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
