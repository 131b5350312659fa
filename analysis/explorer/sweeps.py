"""Sweeps as the database and their progress files know them: how far, how well, at what price."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterable
from dataclasses import astuple, dataclass, field
from datetime import UTC, datetime, timedelta

from pydantic import BaseModel, ConfigDict, JsonValue, ValidationError

from merge_runner.config import both_sides, pair_name
from merge_runner.drivers.registry import EMULATOR
from merge_runner.run.progress import Standing, read_standing
from merge_runner.study.crossing import MODEL, PROMPT
from merge_runner.study.file import study_files
from merge_runner_analysis.data.driver_words import stand_in
from merge_runner_analysis.explorer.catalogue import FACTOR, Catalogue, Filter
from merge_runner_analysis.explorer.reading import Row

OF_SWEEP = "SEMI JOIN (FROM members WHERE sweep = ?) USING (number)"
SWEEPS = """
SELECT sweep_id, name, started_at, ended_at, exit_code, config::VARCHAR AS config,
    coalesce(trials, 0) AS trials, coalesce(failed, 0) AS failed,
    coalesce(cost_usd, 0) AS cost_usd, coalesce(scripted, 0) AS scripted, stand_ins
FROM sweeps LEFT JOIN (
    SELECT sweep AS sweep_id, count(*) AS trials, count(*) FILTER (status = 'failed') AS failed,
        sum(cost_usd) AS cost_usd, count(*) FILTER (scripted) AS scripted,
        string_agg(DISTINCT stand_in, '; ') AS stand_ins
    FROM members JOIN listed USING (number) GROUP BY ALL
) USING (sweep_id)
ORDER BY started_at DESC, sweep_id DESC
"""
TRIED = f"""
SELECT requested, served, answered, outcome, sum(times)::BIGINT AS times,
    sum(unpriced)::BIGINT AS unpriced, answered AND (requested, served) IN (FROM others) AS other
FROM tried {OF_SWEEP} GROUP BY ALL ORDER BY ALL
"""  # noqa: S608 # constants
CAUSES = f"""
SELECT cause, count(*) AS trials, sum(times)::BIGINT AS times
FROM causes {OF_SWEEP} WHERE NOT starts_with(cause, 'model: ')
GROUP BY ALL ORDER BY trials DESC, cause
"""  # noqa: S608 # constants
# Why a run ended early, by its exit code.
REASONS = {
    2: "the service refused the key or the model, or a setting was wrong",
    3: "the account's quota or --max-cost was used up",
    4: "a replay makes no calls, and some replies are not recorded",
    130: "it was interrupted (Ctrl-C)",
}


# Who drives left and right, the prompt, and the levels of the other factors as texts.
ARM = ("model_left", "model_right", "variant", "levels")
ArmKey = tuple[str, str, str, tuple[str, ...]]


class Model(BaseModel):
    """What a sweep says of one of its models."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    id: str
    provider: str
    note: str = ""


class Arm(BaseModel):
    """What a sweep says of an arm of its study; ``asked`` are keys of the sweep's models."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    model: str
    variant: str
    repetitions: int
    sides: dict[str, str]
    asked: dict[str, str]
    factors: dict[str, str] = {}
    label: str

    @property
    def key(self) -> ArmKey:
        """What its trials have in common."""
        levels = (f"{name}={level}" for name, level in self.factors.items() if name != PROMPT)
        return self.sides["left"], self.sides["right"], self.variant, tuple(sorted(levels))

    @property
    def state(self) -> dict[str, str]:
        """The filter of its trials; of two drivers their names tell who sat on which side."""
        mixed = self.sides["left"] != self.sides["right"]
        levels = {} if mixed else {MODEL: self.model}
        levels |= {name: level for name, level in self.factors.items() if name != PROMPT}
        named = {"q": f"{self.model}/"} if mixed else {}
        return {
            "variant": self.variant,
            **named,
            **{f"{FACTOR}{name}": level for name, level in levels.items()},
        }


class Config(BaseModel):
    """What a sweep planned, as far as its row tells; an older program may have told less."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    model: str = ""
    models: dict[str, Model] = {}
    endpoints: dict[str, str] = {}
    repetitions: dict[str, int] = {}
    conditions: tuple[str, ...] = ()
    sample_set: int = 0
    max_cost_usd: float | None = None
    arms: tuple[Arm, ...] = ()
    study: dict[str, JsonValue] = {}

    @property
    def registered(self) -> set[str]:
        """The names of its language models in the registry, whatever their parameters."""
        named = {arm.asked[side]: name for arm in self.arms for side, name in arm.sides.items()}
        return {named.get(asked, asked) for asked in self.models}

    @property
    def drivers(self) -> tuple[str, ...]:
        """Who drives but for opponents."""
        return tuple(self.model.split(","))

    @property
    def driver(self) -> str:
        """The drivers with their endpoints."""
        names = (pair_name(both_sides(name).values(), self.endpoints) for name in self.drivers)
        return ", ".join(names)

    @property
    def planned(self) -> dict[str, int]:
        """How many repetitions each arm has by its label; where only prompts vary, each prompt."""
        return {arm.label: arm.repetitions for arm in self.arms} or self.repetitions


@dataclass(frozen=True, slots=True)
class ListedSweep:
    """One sweep of the list. ``standing`` is what its process says, None where no file does."""

    row: Row
    config: Config
    standing: Standing | None

    @property
    def sweep_id(self) -> str:
        """The id, which no other sweep has."""
        return str(self.row["sweep_id"])

    @property
    def stand_in(self) -> str:
        """What is said of a scripted stand-in that answers; empty where none is known to.

        Its trials say so, in how many of them; before there are any, what is asked.
        """
        trials, scripted = self.row["trials"], self.row["scripted"]
        if scripted:
            part = f", in {scripted} of {trials} trials" if scripted < trials else ""
            return f"{self.row['stand_ins']}{part}"
        asked = {model.provider for model in self.config.models.values()}
        if EMULATOR not in asked or trials:
            return ""
        models = self.config.registered
        pairs = map(both_sides, self.config.drivers)
        return "; ".join(
            stand_in({side: name for side, name in pair.items() if name in models})
            for pair in pairs
        )

    @property
    def notes(self) -> list[str]:
        """What the registry says of its language models."""
        models = self.config.models.items()
        return [f"{n}: {m.note}" for n, m in models if m.note and m.provider != EMULATOR]

    @property
    def state(self) -> str:
        """``running``, ``checking`` what is stored, ``lost``, ``finished``, or ``stopped``."""
        if self.row["ended_at"] is None:
            return self._unended
        return "stopped" if self.row["exit_code"] else "finished"

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
        return sum(self.config.planned.values()) * len(self.config.conditions)

    @property
    def ended(self) -> int:
        """How many of its trials have an outcome."""
        if self.live:
            return self.live.ended
        return int(self.row["trials"] - self.row["failed"])

    @property
    def failed(self) -> int:
        """How many of its trials ended without one."""
        if self.live:
            return self.live.failed
        return int(self.row["failed"])

    @property
    def last_word(self) -> datetime | None:
        """When it ended, or was last heard of."""
        told: datetime | None = self.row["ended_at"]
        return self.standing.updated_at if told is None and self.standing else told

    @property
    def lasted_s(self) -> float | None:
        """For how long it ran; the database's times are UTC without saying so."""
        if self.last_word is None:
            return None
        until = self.last_word.astimezone(UTC) if self.last_word.tzinfo else self.last_word
        lasted: timedelta = until.replace(tzinfo=None) - self.row["started_at"]
        return lasted.total_seconds()

    @property
    def _unended(self) -> str:
        if self.standing is None or not self.standing.alive:
            return "lost"
        return "running" if self.standing.doing == "playing" else "checking"


@dataclass(frozen=True, slots=True)
class VariantCondition:
    """Stored trials of one variant, or arm, and condition, of those that were planned.

    ``state`` is the filter of the variant's or arm's trials.
    """

    variant: str
    condition: str
    state: dict[str, str]
    planned: int
    ended: int
    failed: int
    asked: int
    invalid: int


@dataclass(frozen=True, slots=True)
class Rate:
    """``count`` of ``of`` things; ``state`` is the filter of the trials behind it."""

    name: str
    count: int
    of: int
    things: str
    meaning: str
    state: dict[str, str]


@dataclass(frozen=True, slots=True)
class Assessment:
    """Whether a sweep is finished and can be trusted, in a sentence.

    ``command`` goes on with it, unless a ``later`` sweep already did.
    """

    kind: str
    text: str
    command: str = ""
    later: str = ""


@dataclass(frozen=True, slots=True)
class Sweep:
    """One sweep with all that its page shows."""

    entry: ListedSweep
    newest: ListedSweep = field(repr=False)  # of which the page shows little
    assessment: Assessment
    cells: dict[tuple[str, str], VariantCondition]
    rates: list[Rate]
    mismatches: dict[str, int]
    causes: list[Row]
    unpriced: int


def list_sweeps(catalogue: Catalogue) -> list[ListedSweep]:
    """All sweeps, the newest first. Raises what ``Catalogue.refresh`` does."""
    catalogue.refresh()
    entries = _entries(catalogue)
    # A sweep notes its end in the database before its file goes: one that seems to be lost may have
    # ended since the rows were read, by whoever refreshed the catalogue since.
    if any(entry.state == "lost" for entry in entries):
        catalogue.refresh()
        return _entries(catalogue)
    return entries


def _entries(catalogue: Catalogue) -> list[ListedSweep]:
    return [
        ListedSweep(
            row,
            config_of(row["config"]),
            None if row["ended_at"] else read_standing(catalogue.db, row["sweep_id"]),
        )
        for row in catalogue.ask(SWEEPS)
    ]


def standing_of(catalogue: Catalogue) -> list[tuple[ListedSweep, Assessment]]:
    """The runs that go on, or ended early and nobody went on with them; else the newest one.

    The newest come first. Raises what ``Catalogue.refresh`` does.
    """
    entries = list_sweeps(catalogue)
    found = []
    for place, entry in enumerate(entries):
        later = _later(entry, entries[:place])
        if entry.state != "finished" and not later:
            found.append((entry, assessment_of(entry, later, 0)))
    if found or not entries:
        return found
    mismatches = mismatches_of(catalogue.ask(TRIED, entries[0].sweep_id))
    return [(entries[0], assessment_of(entries[0], "", sum(mismatches.values())))]


def find_sweep(catalogue: Catalogue, sweep_id: str) -> Sweep | None:
    """One sweep; None where there is none. Raises what ``Catalogue.refresh`` does."""
    entries = list_sweeps(catalogue)
    place = next((i for i, entry in enumerate(entries) if entry.sweep_id == sweep_id), None)
    if place is None:
        return None
    entry = entries[place]
    stored = catalogue.counts(Filter(sweep=sweep_id), *ARM, "condition")
    tried = catalogue.ask(TRIED, sweep_id)
    mismatches = mismatches_of(tried)
    return Sweep(
        entry=entry,
        newest=entries[0],
        assessment=assessment_of(entry, _later(entry, entries[:place]), sum(mismatches.values())),
        cells=cells_of(entry, stored),
        rates=rates_of(stored, tried, mismatches, sweep_id),
        mismatches=mismatches,
        causes=catalogue.ask(CAUSES, sweep_id),
        unpriced=sum(row["unpriced"] for row in tried),
    )


def config_of(text: str) -> Config:
    """The configuration in a sweep's row."""
    try:
        return Config.model_validate_json(text)
    except ValidationError:
        return Config()


def cells_of(entry: ListedSweep, stored: list[Row]) -> dict[tuple[str, str], VariantCondition]:
    """Every cell that was planned, and any other that holds a trial."""
    planned = {
        (label, condition): repetitions
        for label, repetitions in entry.config.planned.items()
        for condition in entry.config.conditions
    }
    arms = {arm.key: arm for arm in entry.config.arms}
    states = {arm.label: arm.state for arm in arms.values()}
    found = {(_label(row, arms), row["condition"]): row for row in stored}
    cells = {}
    for variant, condition in planned | found:
        row = found.get((variant, condition), {})
        cells[variant, condition] = VariantCondition(
            variant,
            condition,
            states.get(variant, {"variant": variant}),
            planned.get((variant, condition), 0),
            row.get("ended", 0),
            row.get("failed", 0),
            row.get("asked", 0) or row.get("decisions", 0),
            row.get("invalid", 0),
        )
    return cells


def total_of(cells: Iterable[VariantCondition | None]) -> VariantCondition:
    """The trials of one variant over all conditions."""
    there = [astuple(cell) for cell in cells if cell is not None]
    variant, _, state, *_ = there[0]
    return VariantCondition(
        variant, "", state, *map(sum, zip(*[cell[3:] for cell in there], strict=True))
    )


def _label(row: Row, arms: dict[ArmKey, Arm]) -> str:
    """The arm of stored trials by its label, or their prompt where only prompts vary."""
    left, right, variant, levels = (row[name] for name in ARM)
    arm = arms.get((left, right, variant or "", tuple(levels or ())))
    return arm.label if arm else variant or ""


def rates_of(
    stored: list[Row], tried: list[Row], mismatches: dict[str, int], sweep_id: str
) -> list[Rate]:
    """How often things happened that may cost trust, each with what it is counted over."""
    sums = Counter[str]()
    for row in stored:
        sums.update({name: value for name, value in row.items() if isinstance(value, int)})
    outcomes = Counter[str]()
    for row in tried:
        outcomes[row["outcome"]] += row["times"]
    answers = sum(row["times"] for row in tried if row["answered"])
    # A list of trials has one cause: where there are several pairs, each has its own link below.
    pair = next(iter(mismatches)) if len(mismatches) == 1 else ""
    other = {"cause": f"model: {pair}"} if pair else {}
    played, attempts = sums["ended"] + sums["failed"], outcomes.total()
    # A program's decisions count where no model was asked.
    decided, decisions = sums["asked"] or sums["decisions"], "decisions"
    if sums["asked"]:
        decisions = "decisions asked"
    return [
        Rate(name, count, of, things, meaning, {"sweep": sweep_id, **state} if state else {})
        for name, count, of, things, meaning, state in (
            ("collisions", sums["collided"], sums["ended"], "ended trials",
             "the vehicles came closer than the collision rule allows", {"outcome": "collided"}),
            ("failed trials", sums["failed"], played, "stored trials",
             "a call got no answer; the trial has no outcome and can be played anew",
             {"outcome": "failed"}),
            ("invalid replies", sums["invalid"], decided, decisions,
             "the reply held no valid plan", {"validity": "fallbacks"}),
            ("fallbacks", sums["fallbacks"], decided, decisions,
             "an older plan was driven on, or none", {"validity": "fallbacks"}),
            ("refusals", outcomes["refusal"], attempts, "attempts",
             "the model, or a filter before it, declined", {"cause": "attempt: refusal"}),
            ("truncated replies", outcomes["truncated"], attempts, "attempts",
             "the reply was cut off at its longest", {"cause": "attempt: truncated"}),
            ("another model answered", sum(mismatches.values()), answers, "answers",
             "it is neither the one asked for nor a declared alias of it", other),
        )
    ]  # fmt: skip


def mismatches_of(tried: list[Row]) -> dict[str, int]:
    """How often another model answered, by the requested and the served one."""
    others = Counter[str]()
    for row in tried:
        if row["other"]:
            others[f"{row['requested']} → {row['served']}"] += row["times"]
    return dict(others)


def assessment_of(entry: ListedSweep, later: str, mismatches: int) -> Assessment:
    """Say whether it is finished, and can be trusted."""
    counted = f"{entry.ended} of {entry.planned or '?'} trials"
    failures = f", {entry.failed} failed" if entry.failed else ""
    if entry.state == "checking":
        return Assessment("running", f"Nearly done: {counted} ended{failures}; the audit runs.")
    if entry.live:
        left_s = entry.live.left_s
        left = f", about {duration(left_s)} left" if left_s is not None else ""
        return Assessment("running", f"Running: {counted} ended{failures}{left}.")
    if entry.state == "finished":
        return _finished(entry, mismatches)
    complete = entry.ended == entry.planned
    code = entry.row["exit_code"]
    if entry.state == "lost":
        text = (
            "Stopped without a word: its process is gone, or frozen. "
            f"{counted} are stored{failures}."
        )
    elif code in REASONS:
        text = f"Stopped: {REASONS[code]}. {counted} have an outcome{failures}."
    elif complete:
        text = (
            f"Ended with faults: {counted} have an outcome, but what is stored does not hold "
            f"together. See: merge-runner audit --sweep {entry.sweep_id}"
        )
    elif entry.failed:
        text = f"Ended: {counted} have an outcome{failures}."
    else:
        text = f"Stopped by an error that it printed: {counted} have an outcome."
    if complete or later or code == 4:
        return Assessment("stopped", text, later=later)
    return Assessment("stopped", text, command=_again(entry))


def duration(seconds: float) -> str:
    """A time span as a reader says it."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    if seconds < 5_400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


def _finished(entry: ListedSweep, mismatches: int) -> Assessment:
    if entry.planned and entry.ended < entry.planned:
        return Assessment(
            "stopped",
            f"It had finished, but the database holds only {entry.ended} of its {entry.planned} "
            "trials.",
        )
    text = f"Finished: all {entry.ended} trials ended, and the audit found nothing"
    if mismatches:
        return Assessment("doubtful", f"{text}; but another model gave {mismatches} answers.")
    return Assessment("finished", f"{text}.")


def _again(entry: ListedSweep) -> str:
    words = ["merge-runner", "sweep", _study_of(entry)]
    for name in entry.config.drivers:
        words += ["--model", name or "?"]
    if entry.config.sample_set:
        words += ["--sample-set", str(entry.config.sample_set)]
    return shlex.join(words)


def _study_of(entry: ListedSweep) -> str:
    """The name of a sweep's study, or the file that it was read from, wherever that lies."""
    name = str(entry.row["name"])
    return name if name in study_files() or not entry.config.study else f"{name}.toml"


def _later(entry: ListedSweep, newer: list[ListedSweep]) -> str:
    """The newest sweep that went on with the same trials."""

    def plays(sweep: ListedSweep) -> tuple[str, str, int]:
        return sweep.row["name"], sweep.config.model, sweep.config.sample_set

    return next((other.sweep_id for other in newer if plays(other) == plays(entry)), "")
