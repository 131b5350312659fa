"""Runs as the database and their progress files know them: how far, how well, at what price."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from merge_runner.audit.checks import not_judged
from merge_runner.config import both_sides, pair_name
from merge_runner.drivers.registry import EMULATOR
from merge_runner.paths import DEFAULT_DB
from merge_runner.run.progress import Standing, read_standing
from merge_runner.study.crossing import MODEL, PROMPT
from merge_runner.study.file import study_files
from merge_runner_analysis.explorer.catalogue import COUNTS, FACTOR, Catalogue, Filter
from merge_runner_analysis.explorer.reading import Row

# What each run comes to, and, without an id, all of them together: whatever several runs or trials
# share counts once.
RUNS = f"""
WITH shown AS (FROM members SEMI JOIN (FROM listed WHERE {{where}}) USING (number)),
spans AS (FROM shown UNION ALL SELECT DISTINCT '', number FROM shown),
of_trials AS (
    SELECT sweep AS sweep_id, {COUNTS}, count(*) FILTER (scripted) AS scripted
    FROM spans JOIN listed USING (number) GROUP BY ALL
), of_attempts AS (
    SELECT sweep AS sweep_id, sum(times)::BIGINT AS attempts,
        sum(times) FILTER (outcome <> 'ok')::BIGINT AS faults,
        sum(times) FILTER (answered)::BIGINT AS answers, sum(times) FILTER
            (answered AND (requested, served) IN (FROM others))::BIGINT AS others,
        sum(unpriced)::BIGINT AS unpriced
    FROM spans JOIN tried USING (number) GROUP BY ALL
), of_replies AS (
    SELECT sweep AS sweep_id, count(*) AS replies, count(*) FILTER (trials > 1) AS shared,
        sum(usd) AS usd
    FROM (
        SELECT DISTINCT sweep, reply, usd, trials FROM spans JOIN replies USING (number)
        JOIN (SELECT reply, count(*) AS trials FROM replies GROUP BY ALL) USING (reply)
    ) GROUP BY ALL
)
FROM (
    SELECT sweep_id, name, started_at, ended_at, exit_code, config::VARCHAR AS config FROM sweeps
    UNION ALL SELECT '', '', NULL, NULL, NULL, '{{{{}}}}'
) LEFT JOIN of_trials USING (sweep_id) LEFT JOIN of_attempts USING (sweep_id)
LEFT JOIN of_replies USING (sweep_id)
ORDER BY started_at DESC NULLS LAST, sweep_id DESC
"""  # noqa: S608 # constants
NUMBERS = ("trials", "ended", "failed", "collided", "decisions", "asked", "invalid", "fallbacks",
           "scripted", "attempts", "faults", "answers", "others", "unpriced", "replies", "shared",
           "usd")  # fmt: skip
CAUSES = """
SELECT cause, count(*) AS trials, sum(times)::BIGINT AS times
FROM causes SEMI JOIN (FROM members WHERE sweep = ?) USING (number)
GROUP BY ALL ORDER BY trials DESC, cause
"""
# Why a run ended early, by its exit code.
REASONS = {
    2: "the service refused the key or the model, or a setting was wrong",
    3: "the account's quota or --max-cost was used up",
    4: "a replay makes no calls, and some replies are not recorded",
    130: "it was interrupted (Ctrl-C)",
}


@dataclass(frozen=True, slots=True)
class Rate:
    """``count`` of ``of`` are columns of a run; ``state`` filters the trials behind the count."""

    name: str
    count: str
    of: str
    things: str
    meaning: str
    state: dict[str, str]


# How often things happened that may cost trust.
TRUST = (
    Rate("collisions", "collided", "ended", "ended trials",
         "the vehicles came closer than the collision rule allows", {"outcome": "collided"}),
    Rate("failed trials", "failed", "trials", "stored trials",
         "a call got no answer; the trial has no outcome and can be played anew",
         {"outcome": "failed"}),
    Rate("invalid replies", "invalid", "asked", "decisions asked",
         "the reply held no valid plan", {"validity": "fallbacks"}),
    Rate("fallbacks", "fallbacks", "asked", "decisions asked",
         "an older plan was driven on, or none", {"validity": "fallbacks"}),
    Rate("faults", "faults", "attempts", "attempts",
         "no answer, a refusal, or one that was cut off", {}),
    Rate("another model answered", "others", "answers", "answers",
         "it is neither the one asked for nor a declared alias of it", {}),
    Rate("replies shared", "shared", "replies", "replies",
         "one reply decided in several trials, which are no separate samples there", {}),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Run:
    """A run of a sweep into ``db``. ``standing`` is what its process says, None: no file does.

    ``row`` has the columns of RUNS, and ``config`` what the run planned.
    """

    row: Row = field(repr=False)  # in the last digits sums differ from time to time
    config: dict[str, Any] = field(repr=False)
    standing: Standing | None
    db: Path = DEFAULT_DB

    @property
    def sweep_id(self) -> str:
        """The id, which no other run has."""
        return str(self.row["sweep_id"])

    @property
    def drivers(self) -> list[str]:
        """Who drives but for opponents."""
        return str(self.config.get("model", "")).split(",")

    @property
    def driver(self) -> str:
        """The drivers with their endpoints."""
        endpoints = self.config.get("endpoints", {})
        return ", ".join(pair_name(both_sides(name).values(), endpoints) for name in self.drivers)

    @property
    def stand_in(self) -> str:
        """What is said of a scripted stand-in that answers; empty where none is known to."""
        trials, scripted = self.row["trials"], self.row["scripted"]
        part = f", in {scripted} of {trials} trials" if scripted < trials else ""
        return f"{self.row['stand_in']}{part}" if scripted else ""

    @property
    def notes(self) -> list[str]:
        """What the registry says of its language models."""
        models = self.config.get("models", {}).items()
        return [f"{name}: {model['note']}" for name, model in models
                if model.get("note") and model["provider"] != EMULATOR]  # fmt: skip

    @property
    def state(self) -> str:
        """``running``, ``checking`` what is stored, ``lost``, ``finished``, or ``stopped``."""
        if self.row["ended_at"] is not None:
            return "stopped" if self.row["exit_code"] else "finished"
        if self.standing is None or not self.standing.alive:
            return "lost"
        return "running" if self.standing.doing == "playing" else "checking"

    @property
    def live(self) -> Standing | None:
        """What its process says, while it runs."""
        return self.standing if self.state in {"running", "checking"} else None

    @property
    def followed(self) -> bool:
        """Whether there may be news of it: one that is silent may have slept, and go on."""
        return self.row["ended_at"] is None and self.standing is not None

    @property
    def planned(self) -> int:
        """How many trials it wants; 0 where that is not known."""
        repetitions = sum(arm["repetitions"] for arm in self.config.get("arms", ()))
        return int(repetitions) * len(self.config.get("conditions", ()))

    @property
    def ended(self) -> int:
        """How many of its trials have an outcome."""
        return self.live.ended if self.live else int(self.row["ended"])

    @property
    def failed(self) -> int:
        """How many of its trials ended without one."""
        return self.live.failed if self.live else int(self.row["failed"])

    @property
    def last_word(self) -> datetime | None:
        """When it ended, or was last heard of; UTC, as the database has it without saying so."""
        if self.row["ended_at"] is None and self.standing:
            return self.standing.updated_at.astimezone(UTC).replace(tzinfo=None)
        ended_at: datetime | None = self.row["ended_at"]
        return ended_at

    @property
    def lasted_s(self) -> float | None:
        """For how long it ran."""
        if self.last_word is None:
            return None
        lasted: timedelta = self.last_word - self.row["started_at"]
        return lasted.total_seconds()

    @property
    def command(self) -> str:
        """What to type to go on with it."""
        name = str(self.row["name"])
        known = name in study_files() or not self.config.get("study")
        words = ["merge-runner", "sweep", name if known else f"{name}.toml"]
        for driver in self.drivers:
            words += ["--model", driver or "?"]
        if sample_set := self.config.get("sample_set"):
            words += ["--sample-set", str(sample_set)]
        if self.db != DEFAULT_DB:
            words += ["--db", str(self.db)]
        return shlex.join(words)


@dataclass(frozen=True, slots=True)
class Assessment:
    """Whether a run is finished and can be trusted, in a sentence.

    ``command`` goes on with it, unless a ``later`` run already did.
    """

    kind: str
    text: str
    command: str = ""
    later: str = ""


def list_runs(catalogue: Catalogue) -> list[tuple[Run, Assessment]]:
    """All runs, the newest first. Raises what ``Catalogue.refresh`` does."""
    catalogue.refresh()
    runs = _runs(catalogue)
    # A run notes its end in the database before its file goes: one that seems to be lost may have
    # ended since the rows were read, by whoever refreshed the catalogue since.
    if any(run.state == "lost" for run in runs):
        catalogue.refresh()
        runs = _runs(catalogue)
    later = [_later(run, runs[:place]) for place, run in enumerate(runs)]
    return [(run, assessment_of(run, other)) for run, other in zip(runs, later, strict=True)]


def numbers_of(
    catalogue: Catalogue, where: str = "true", values: Sequence[object] = ()
) -> dict[str, Row]:
    """The columns of RUNS by the run's id, counted in the listed trials that are wanted."""
    rows = catalogue.ask(RUNS.format(where=where), *values)
    return {row["sweep_id"]: row | {name: row[name] or 0 for name in NUMBERS} for row in rows}


def _runs(catalogue: Catalogue) -> list[Run]:
    return [
        Run(
            row,
            json.loads(row["config"]),
            None if row["ended_at"] else read_standing(catalogue.db, sweep_id),
            catalogue.db,
        )
        for sweep_id, row in numbers_of(catalogue).items()
        if sweep_id
    ]


def standing_of(catalogue: Catalogue) -> list[tuple[Run, Assessment]]:
    """The runs that go on, or ended early and nobody went on with them; else the newest one.

    The newest come first. Raises what ``Catalogue.refresh`` does.
    """
    runs = list_runs(catalogue)
    return [
        (run, said) for run, said in runs if run.state != "finished" and not said.later
    ] or runs[:1]


def arms_of(catalogue: Catalogue, run: Run) -> list[Row]:
    """What the stored trials of each arm come to, beside those that were ``planned``.

    ``state`` is the filter of its trials. Whoever was planned in no arm comes last.
    """
    columns = "model_left", "model_right", "variant", "levels"
    stored = {
        (*map(row.get, columns[:3]), *(row["levels"] or ())): row
        for row in catalogue.counts(Filter(sweep=run.sweep_id), *columns)
    }
    arms = []
    for arm in run.config.get("arms", ()):
        left, right = arm["sides"]["left"], arm["sides"]["right"]
        levels = {name: level for name, level in arm["factors"].items() if name != PROMPT}
        key = left, right, arm["variant"], *sorted(map("=".join, levels.items()))
        # The names of two drivers tell who sat on which side.
        named = {"q": f"{arm['model']}/"} if left != right else {f"{FACTOR}{MODEL}": arm["model"]}
        chosen = {f"{FACTOR}{name}": level for name, level in levels.items()}
        arms.append(
            dict.fromkeys(NUMBERS, 0)
            | stored.pop(key, {})
            | {
                "label": arm["label"] or arm["variant"],
                "planned": arm["repetitions"] * len(run.config["conditions"]),
                "state": {"variant": arm["variant"], **named, **chosen},
            }
        )
    others = [
        row | {"label": row["variant"] or "", "planned": 0, "state": {"variant": row["variant"]}}
        for row in stored.values()
    ]
    return arms + others


def assessment_of(run: Run, later: str = "") -> Assessment:
    """Say whether it is finished, and can be trusted."""
    counted = f"{run.ended} of {run.planned or '?'} trials"
    failures = f", {run.failed} failed" if run.failed else ""
    complete, code = run.ended == run.planned, run.row["exit_code"]
    if run.state == "checking":
        return Assessment("running", f"Nearly done: {counted} ended{failures}; the audit runs.")
    if run.live:
        left_s = run.live.left_s
        left = f", about {duration(left_s)} left" if left_s is not None else ""
        return Assessment("running", f"Running: {counted} ended{failures}{left}.")
    if run.state == "finished":
        return _finished(run)
    if run.state == "lost":
        text = (
            "Stopped without a word: its process is gone, or frozen. "
            f"{counted} are stored{failures}."
        )
    elif code in REASONS:
        text = f"Stopped: {REASONS[code]}. {counted} have an outcome{failures}."
    elif complete:
        text = (
            f"Ended with faults: {counted} have an outcome, but what is stored does not hold "
            f"together. See: merge-runner audit --sweep {run.sweep_id}"
        )
    elif run.failed:
        text = f"Ended: {counted} have an outcome{failures}."
    else:
        text = f"Stopped by an error that it printed: {counted} have an outcome."
    goes_on = not (complete or later or code == 4)
    return Assessment("stopped", text, run.command if goes_on else "", later)


def _finished(run: Run) -> Assessment:
    if run.planned and run.ended < run.planned:
        return Assessment(
            "stopped",
            f"It had finished, but the database holds only {run.ended} of its {run.planned} "
            "trials.",
        )
    row, text = run.row, f"Finished: all {run.ended} trials ended"
    if why := not_judged(run.driver, row["invalid"], row["asked"]):
        return Assessment("doubtful", f"{text}; {why}.")
    text += ", and no problems were found"
    if others := row["others"]:
        return Assessment("doubtful", f"{text}; but another model gave {others} answers.")
    return Assessment("finished", f"{text}.")


def _later(run: Run, newer: list[Run]) -> str:
    """The newest run that went on with the same trials."""

    def plays(one: Run) -> tuple[object, ...]:
        return one.row["name"], one.config.get("model"), one.config.get("sample_set")

    return next((other.sweep_id for other in newer if plays(other) == plays(run)), "")


def duration(seconds: float) -> str:
    """A time span as a reader says it."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    if seconds < 5_400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
