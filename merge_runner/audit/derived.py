"""Everything stored, derived anew: each reply is read again, and each trial is driven by it again.

This shows what was changed after it was stored. It uses the program's own drivers, formats and
world; whether these are right is left to the other checks, which share little with them: how a
reply is read, a driver's pace, the track and what a collision is.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import duckdb

from merge_runner.audit.answers import COLUMNS, Answer, answers_another, read_answer
from merge_runner.audit.expected import ArmFacts, Spec, SweepConfig
from merge_runner.audit.findings import Audit, Finding
from merge_runner.config import ScenarioConfig
from merge_runner.drivers.base import Driver, MakeDriver, Seat, take_seat
from merge_runner.drivers.language_model import LanguageModel
from merge_runner.drivers.pace import Pace
from merge_runner.drivers.registry import PROGRAMS
from merge_runner.errors import CallFailed
from merge_runner.llm.content_hashes import SPEC_VERSION
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.formats.base import WireFormat
from merge_runner.prompts.blocks import VARIANTS, block_digests
from merge_runner.records import (
    SIDES,
    ChatReply,
    ChatRequest,
    Decision,
    Observation,
    Side,
    Slot,
    TrialRecord,
    TrialSpec,
)
from merge_runner.results.comparison import (
    FACTORS,
    LONG,
    PLACES,
    Difference,
    Spans,
    Stored,
    TrialKey,
    in_batches,
    stored_rows,
)
from merge_runner.results.rows import rows_of
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.trial import play_trial

TOLERANCE = 1e-9
"""Numbers may differ by this much, as between the arithmetic of two machines."""
SHOWN = 60
# The columns that follow from neither a reply nor a spec; docs/reference/audit.md says why. A
# cache has those of ``calls``, except ``cached``.
NOT_DERIVED = (
    "calls.cached",
    "calls.started_at",
    "calls.latency_s",
    "calls.cost_usd",
    "calls.batch_id",
    "sweeps.ended_at",
    "sweeps.exit_code",
    "sweeps.git_commit",
    "sweeps.git_dirty",
    "sweeps.versions",
)
CALLS = f"trial_id, spec_hash, {', '.join(COLUMNS)}, sha256(request::VARCHAR) AS asked"
# What could not be derived, in a reader's words.
OTHER_RULES = "anything, since another version of the program made them by other rules"
OTHER_PROMPTS = "the prompts, made of other texts than this version has"
NOT_INSTALLED = "anything, since their condition is not installed"
OTHER_DATA = "anything, since what a program drives by is not here, as human trials to replay"
OTHER_PROGRAM = "the decisions of a program that is not as it was"


class _NotStored(Exception):  # the name says what was found: it is no error of the program
    """What a decision would be derived from is not stored."""


@dataclass(slots=True)
class _Trial:
    """A trial as it is stored.

    ``scripted`` says that the sweep asks the emulator, ``prompts`` that its prompts are derived.
    """

    key: TrialKey
    row: dict[str, Any]
    scenario: ScenarioConfig
    attempts: list[Answer]
    plans: dict[tuple[str, int], Decision]
    scripted: bool
    factors: Mapping[str, str] = field(default_factory=dict)
    prompts: bool = True
    drivers: dict[Side, Driver] = field(default_factory=dict)

    async def played(self) -> TrialRecord | _NotStored:
        """The trial, driven anew."""
        try:
            return await play_trial(self.spec, self.scenario, self.drivers)
        except _NotStored as exc:
            return exc

    @property
    def spec(self) -> TrialSpec:
        """The trial as it was to be played."""
        row = self.row
        return TrialSpec(
            *self.key,
            source=row["source"],
            model_left=row["model_left"],
            model_right=row["model_right"],
            variant=row["variant"],
            condition=row["condition"],
            repetition=row["rep"],
            sample_set=row["sample_set"],
            order=0,
            scripted=self.scripted or any(a.wanted["scripted"] for a in self.attempts),
            factors=tuple(self.factors.items()),
        )

    def slot(self, row: Mapping[str, Any]) -> dict[str, str | int]:
        """The slot of a row of ``calls``."""
        own = self.row
        return Slot(
            own["condition"], own["rep"], row["side"], row["decision"], own["sample_set"]
        ).as_dict()

    def model(self) -> LanguageModel:
        """A language model that gives the stored replies."""
        ordered = sorted(self.attempts, key=lambda attempt: attempt.row["attempt"])
        last = {(a.row["side"], a.row["decision"]): a for a in ordered}
        failed = self.row["status"] == "failed"  # a driver that knew the trial would keep it alive

        async def ask(_: str, slot: Slot, __: TrialSpec) -> ChatReply:
            answer = last.get((slot.side, slot.decision))
            key = answer.row["call_key"] if answer else ""
            request = ChatRequest(key, "", "", "", "", {}, "", slot)
            if answer is not None and answer.text is not None:
                return ChatReply(answer.text, answer.wanted["outcome"], request, (), 0)
            if failed:
                raise CallFailed("no answer", request)
            raise _NotStored(
                f"the reply to decision {slot.decision} on the {slot.side} is not stored"
            )

        return LanguageModel(ask)


@dataclass(frozen=True, slots=True)
class _AsStored:
    """A driver that repeats the stored decisions of a side."""

    plans: Mapping[tuple[str, int], Decision]
    seat: Seat

    async def decide(self, _: Observation, number: int) -> Decision:
        """The stored decision; raises _NotStored."""
        side = self.seat.side
        if (side, number) not in self.plans:
            raise _NotStored(f"decision {number} on the {side} is not stored")
        decision = self.plans[side, number]
        if len(decision.applied) != self.seat.pace.executed_actions:
            raise _NotStored(f"decision {number} on the {side} has not the actions to drive")
        return decision


def check_derived(
    connection: duckdb.DuckDBPyConnection,
    specs: Mapping[str, Spec],
    config: SweepConfig,
    audit: Audit,
) -> None:
    """Derive the audited trials anew, and compare every column that replies and specs tell."""
    left_out: Counter[str] = Counter()
    played = 0
    audit.findings += [
        Finding("config", f"its model {name} has the format {model.format!r}, which there is not")
        for name, model in config.models.items()
        if model.format and model.format not in FORMATS
    ]
    audited = connection.execute("SELECT trial_id, spec_hash FROM audited").fetchall()
    batches = in_batches(connection, audited, PLACES, partial(_tables, connection))
    # An event loop may run in the caller's thread, where no other one can.
    with ThreadPoolExecutor(max_workers=1) as thread:
        for tables in batches:
            trials = list(_trials(tables, specs, config, left_out))
            records = thread.submit(asyncio.run, _all_played(trials)).result()
            for trial, record in zip(trials, records, strict=True):
                audit.findings += _findings(trial, record, tables)
            played += len(trials)
    audit.counts["derived anew"] = played
    audit.notes += [f"not derived anew in {n} trials: {what}" for what, n in left_out.items()]


async def _all_played(trials: list[_Trial]) -> list[TrialRecord | _NotStored]:
    return [await trial.played() for trial in trials]


def _tables(
    connection: duckdb.DuckDBPyConnection, keys: list[TrialKey], spans: Spans
) -> dict[str, Stored]:
    """What is stored of these trials; of ``calls`` what replies tell, and the replies."""
    return {
        table: stored_rows(
            connection, table, keys, spans[table], CALLS if table == "calls" else None
        )
        for table in PLACES
    }


def _trials(
    tables: Mapping[str, Stored],
    specs: Mapping[str, Spec],
    config: SweepConfig,
    left_out: Counter[str],
) -> Iterator[_Trial]:
    """The trials that can be derived; the others are counted, or reported by other checks."""
    for key in tables["trials"].rows:
        spec = specs.get(key[1])
        (row,) = tables["trials"].named(key)
        if spec is None or spec.scenario is None:
            continue
        if row["condition"] not in CONDITIONS:
            left_out[NOT_INSTALLED] += 1
            continue
        if not all(map(_is_here, map(spec.driver, SIDES))):
            left_out[OTHER_DATA] += 1
            continue
        paces = {side: pace for side in SIDES if (pace := spec.pace(side)) is not None}
        if len(paces) < len(SIDES):
            continue
        arm = config.arm_of.get(key[0], config.arms[0])
        wires = _wires(config, arm)
        known = all(side in wires for side in SIDES if spec.asks(side))
        same_rules = spec.content.get("spec_version") == SPEC_VERSION
        if not (same_rules and known):
            left_out[OTHER_RULES] += 1
            continue
        calls, decisions = tables["calls"].named(key), tables["decisions"].named(key)
        trial = _Trial(
            key,
            row,
            spec.scenario,
            [read_answer(c, wires[c["side"]]) for c in calls if c["side"] in wires],
            {(d["side"], d["decision"]): _decided(d) for d in decisions},
            scripted=_is_scripted(config, arm),
            factors=arm.factors,
        )
        left_out.update(_seat(trial, spec, paces))
        yield trial


def _is_here(told: Mapping[str, Any]) -> bool:
    """Whether what a driver of a spec drives by is here, if it is anything but its source."""
    program = PROGRAMS.get(str(told.get("program", "")))
    here = None if program is None or program.data is None else program.data.digest
    return "data" not in told or told["data"] == here


def _is_scripted(config: SweepConfig, arm: ArmFacts) -> bool:
    models = map(config.models.get, arm.asked.values())
    return any(model is not None and model.provider == "emulator" for model in models)


def _wires(config: SweepConfig, arm: ArmFacts) -> dict[str, WireFormat]:
    """The formats of an arm's models, by side."""
    models = {side: config.models.get(name) for side, name in arm.asked.items()}
    return {
        side: FORMATS[model.format]
        for side, model in models.items()
        if model is not None and model.format in FORMATS
    }


def _decided(row: Mapping[str, Any]) -> Decision:
    """The stored decision of a program."""
    return Decision(
        row["plan"], tuple(row["applied"]), failure=row["failure"], fallback=row["fallback"]
    )


def _seat(trial: _Trial, spec: Spec, paces: Mapping[Side, Pace]) -> set[str]:
    """Give the trial its drivers; returns what of it cannot be derived.

    A program that is not registered here, or has changed since, repeats its stored decisions.
    """
    variant, blocks = trial.row["variant"], spec.content.get("prompt_blocks")
    trial.prompts = not blocks or (variant in VARIANTS and block_digests(variant) == blocks)
    left_out = set() if trial.prompts else {OTHER_PROMPTS}
    own = trial.spec if trial.prompts else replace(trial.spec, variant="baseline")
    for side, pace in paces.items():
        told = spec.driver(side)
        name = str(told.get("program", ""))
        program = PROGRAMS.get(name)
        same = program is not None and program.in_spec(name) == told
        maker: MakeDriver | None = trial.model() if spec.asks(side) else program if same else None
        if maker is not None:
            trial.drivers[side] = maker.make(trial.scenario, own, side)
            continue
        seat = take_seat(trial.scenario, own, side, pace)
        trial.drivers[side] = _AsStored(trial.plans, seat)
        left_out.add(OTHER_PROGRAM if program is not None else _not_here(name))
    return left_out


def _not_here(program: str) -> str:
    return (
        f"the decisions of {program!r}, which is no driver here; valid: {', '.join(PROGRAMS)} "
        "(install the package that registers it, or name the study: --study FILE)"
    )


def _findings(
    trial: _Trial, record: TrialRecord | _NotStored, tables: Mapping[str, Stored]
) -> Iterator[Finding]:
    if isinstance(record, _NotStored):
        yield Finding("derived", f"it cannot be driven anew: {record}", trial=trial.key[0])
        return
    for answer in trial.attempts:
        if answers_another(answer.payload, answer.row["asked"], trial.slot(answer.row)):
            text = "its reply is, as the server says in it, the answer to another request"
            place = (answer.row["side"], answer.row["decision"])
            yield Finding("derived", text, None, trial.key[0], *place)
    ignored = set() if trial.prompts else {"prompt", "prompt_hash"}
    if record.status == "failed":
        ignored.add("error")  # the reason, in words
    wanted = {**rows_of(record), "calls": [attempt.derived for attempt in trial.attempts]}
    for table, stored in tables.items():
        if table == FACTORS:
            _leave_others(stored, trial)
        for difference in stored.differences(
            trial.key, wanted[table], ignored=ignored, tolerance=TOLERANCE
        ):
            yield _finding(trial.key[0], difference)


def _leave_others(stored: Stored, trial: _Trial) -> None:
    """Keep the factors that the sweep names: another study may have others for the same trial."""
    at = stored.names.index("factor")
    rows = stored.rows.get(trial.key, [])
    stored.rows[trial.key] = [row for row in rows if row[at] in trial.factors]


def _finding(trial_id: str, found: Difference) -> Finding:
    place = found.place
    at = f" at step {place['step']}" if "step" in place else ""
    more = f", and {found.rows - 1} more in the trial" if found.rows > 1 else ""
    if found.column is None:
        text = f"{found.name} are missing or too many{at}{more}"
    elif found.column in LONG.get(found.table, ()):
        text = f"{found.name} is not what it is derived anew{more}"
    else:
        stored, wanted = _short(found.stored), _short(found.wanted)
        text = f"{found.name}{at} is {stored}, and {wanted} derived anew{more}"
    return Finding(
        "derived", text, trial=trial_id, side=place.get("side"), decision=place.get("decision")
    )


def _short(value: object) -> str:
    text = "NULL" if value is None else str(value)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."
