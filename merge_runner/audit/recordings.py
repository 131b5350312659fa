"""Audits of a recording: of what a sweep asked and was answered, without its results."""

from __future__ import annotations

import hashlib
import json
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

from pydantic import ValidationError

from merge_runner.audit.answers import answers_another
from merge_runner.audit.checks import run_checks
from merge_runner.audit.expected import SweepConfig
from merge_runner.audit.findings import Audit, Finding
from merge_runner.audit.ids import REPEATED_IDS, identified, meaningless_ids
from merge_runner.audit.replies import shared_replies
from merge_runner.errors import RecordingError
from merge_runner.llm.cache import CachedCall
from merge_runner.llm.content_hashes import canonical_json, without_prompt
from merge_runner.records import SIDES, Side, Slot
from merge_runner.results.database import SETTINGS, append, in_memory
from merge_runner.results.recording import BATCH, read_provenance, read_recording, sweeps_of
from merge_runner.results.rows import Row
from merge_runner.served_model import other_models

NO_CONFIG = "it does not say of what sweep it is: trials are not compared"
# The tables that the checks of calls read. Each call has a trial of its own there, with its key in
# the place of a spec's hash: a recording does not say which prompt variant it was made for.
TABLES = """
CREATE TABLE calls (trial_id VARCHAR, spec_hash VARCHAR, side VARCHAR, decision BIGINT,
    call_key VARCHAR, request VARCHAR, endpoint VARCHAR, model_requested VARCHAR, attempt BIGINT,
    http_status INTEGER, model_served VARCHAR, outcome VARCHAR, reply_id VARCHAR, content VARCHAR);
CREATE VIEW reply_ids AS FROM calls WHERE reply_id IS NOT NULL;
CREATE VIEW audited AS SELECT DISTINCT trial_id, spec_hash FROM calls;
CREATE TABLE sweeps (config JSON);
CREATE TABLE done (trial_id VARCHAR, spec_hash VARCHAR);
CREATE TABLE other_models (model_requested VARCHAR, model_served VARCHAR);
"""
COUNTS = """
SELECT 'calls', count(DISTINCT call_key) FROM calls
UNION ALL SELECT 'attempts', count(*) FROM calls
UNION ALL SELECT 'reply ids', count(DISTINCT (endpoint, model_requested, reply_id)) FROM reply_ids
"""
OUTCOMES = """
SELECT 'answers ' || outcome AS name, count(*)
FROM (SELECT max_by(outcome, attempt) AS outcome FROM calls GROUP BY call_key)
GROUP BY ALL ORDER BY name
"""


class Drive(NamedTuple):
    """One driver in the trials of one repetition: those of several variants together.

    ``template`` is the request without its prompt, with the model and the endpoint.
    """

    template: str
    trial: str
    repetition: int
    side: Side


class RecordedSweep(NamedTuple):
    """A sweep's configuration, as text too, and whether it claims that all its trials ended."""

    text: str
    config: SweepConfig
    ended: bool


# How often each decision of each driver was asked for.
Drives = defaultdict[Drive, Counter[int]]


def audit_recording(file: Path) -> Audit:
    """Audit a recording; one that is damaged is a finding. Raises UsageError without a file."""
    audit = Audit(str(file))
    drives: Drives = defaultdict(Counter)
    with in_memory(SETTINGS) as connection:
        connection.execute(TABLES)
        try:
            provenance = read_provenance(file)
            entries = read_recording(file)
            while some := list(islice(entries, BATCH)):
                append(connection, "calls", chain.from_iterable(map(_calls, some)))
                audit.findings += chain.from_iterable(map(_exchanged, some))
                for entry in some:
                    drives[_drive(entry)][entry.request.slot.decision] += 1
        except RecordingError as exc:
            return Audit(str(file), findings=[Finding("recording", str(exc))])
        sweeps = list(_sweeps(provenance))
        append(connection, "sweeps", [(sweep.text,) for sweep in sweeps])
        connection.execute(REPEATED_IDS)
        append(connection, "other_models", other_models(connection))
        audit.counts = dict(connection.execute(COUNTS).fetchall())
        audit.counts["drives"] = len(drives)
        audit.counts |= dict(connection.execute(OUTCOMES).fetchall())
        audit.findings += _numbering(drives, [sweep.config for sweep in sweeps])
        audit.findings += shared_replies(connection)
        audit.findings += run_checks(connection, ("served", "attempt"))
        for sweep in sweeps:
            audit.findings += _missing(drives, sweep.config) if sweep.ended else ()
        audit.notes += meaningless_ids(connection)
        audit.notes += [] if sweeps else [NO_CONFIG]
    return audit


def _drive(entry: CachedCall) -> Drive:
    request, slot = entry.request, entry.request.slot
    asked = (request.endpoint, request.model, request.path, request.headers)
    template = canonical_json([*asked, without_prompt(request.body)])
    return Drive(template, _place(slot)[0], slot.repetition, slot.side)


def _place(slot: Slot) -> tuple[str, Side, int]:
    """The trials, in a reader's words, the side and the decision."""
    return _trial(slot.condition, slot.repetition, slot.sample_set), slot.side, slot.decision


def _trial(condition: str, repetition: int, sample_set: int) -> str:
    return f"{condition}/rep{repetition:02d}" + (f"/set{sample_set}" if sample_set else "")


def _calls(entry: CachedCall) -> Iterator[Row]:
    """Rows of ``calls``, without the texts: all attempts at a call have its one request."""
    request = entry.request
    trial, side, decision = _place(request.slot)
    call = (trial, request.key, side, decision, request.key, "", request.endpoint, request.model)
    for attempt in entry.attempts:
        told = (attempt.number, attempt.http_status, attempt.model_served, attempt.outcome)
        answered = attempt.http_status == 200
        found = identified(attempt.reply or "", request.provider) if answered else None
        yield (*call, *told, *(found or (None, None)))


def _exchanged(entry: CachedCall) -> Iterator[Finding]:
    request = entry.request
    asked = hashlib.sha256(request.body.encode()).hexdigest()
    slot = request.slot.as_dict()
    if any(answers_another(_json(attempt.reply), asked, slot) for attempt in entry.attempts):
        text = "its reply is, as the server says in it, another's answer"
        yield Finding("derived", text, None, *_place(request.slot))


def _json(text: str | None) -> object:
    try:
        return json.loads(text or "null")
    except (ValueError, RecursionError):
        return None


def _sweeps(provenance: dict[str, str]) -> Iterator[RecordedSweep]:
    """The sweeps that a recording says it holds, without those whose configuration is unreadable.

    One whose trials all ended claims that of each trial something is recorded.
    """
    for row in sweeps_of(provenance):
        text = row.get("config", "")
        with suppress(ValidationError):
            config = SweepConfig.model_validate_json(text)
            ended = "ended_at" in row and row.get("exit_code", "0") == "0"
            yield RecordedSweep(text, config, ended)


def _numbering(drives: Drives, configs: Sequence[SweepConfig]) -> Iterator[Finding]:
    """Every driver is asked from its first decision to its last, once per arm at most.

    Where a driver takes control at its own tunnel's exit, the later one begins later.
    """
    late = any(
        arm.scenario.get("control_start") == "own_exit" for config in configs for arm in config.arms
    )
    for drive, numbers in drives.items():
        # Without a word on arms: as many as there are first requests.
        arms = _arms(configs, drive.repetition) if configs else numbers[min(numbers)]
        before = min(numbers) - 1 if late else -1
        for number in sorted(numbers):
            if number > before + 1:
                # One finding for each hole: the numbers of a foreign file may be of any size.
                text = f"nothing is recorded, though of later ones: the next is {number}"
                yield Finding("numbering", text, None, drive.trial, drive.side, before + 1)
            if numbers[number] > arms:
                text = f"{numbers[number]} requests are recorded, for {arms} prompt variants"
                yield Finding("numbering", text, None, drive.trial, drive.side, number)
            before = number


def _arms(configs: Sequence[SweepConfig], repetition: int) -> int:
    """How many different prompts may ask for a decision: those of equal arms are the same."""
    return len(
        {
            (
                arm.variant,
                canonical_json(config.prompt_blocks.get(arm.variant)),
                *arm.asked.values(),
                arm.levels,
            )
            for config in configs
            for arm in config.arms
            if repetition <= arm.repetitions
        }
    )


def _missing(drives: Drives, config: SweepConfig) -> Iterator[Finding]:
    """Of a sweep that has ended, every trial asks each of its models for a first decision."""
    asked = [side for side in SIDES if any(a.asked[side] in config.models for a in config.arms)]
    recorded = {(drive.trial, drive.side) for drive in drives}
    cells = {(trial["condition"], trial["rep"]) for trial in config.trials.values()}
    for condition, repetition in sorted(cells):
        trial = _trial(condition, repetition, config.sample_set)
        for side in asked:
            if (trial, side) not in recorded:
                yield Finding("missing", "nothing is recorded", trial=trial, side=side)
