"""Audits of a recording: of what a sweep asked and was answered, without its results."""

from __future__ import annotations

import hashlib
import json
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import ValidationError

from merge_runner.audit.answers import answers_another
from merge_runner.audit.expected import SweepConfig
from merge_runner.audit.findings import Audit, Finding
from merge_runner.audit.ids import CONSTANT_IDS, identified, repetition_note
from merge_runner.errors import RecordingError
from merge_runner.llm.cache import CachedCall
from merge_runner.llm.content_hashes import canonical_json, without_prompt
from merge_runner.records import SIDES, Side, Slot
from merge_runner.results.recording import read_recording, summarise
from merge_runner.served_model import others_among

NO_CONFIG = "it does not say of what sweep it is: trials are not compared"
# An endpoint, a model, and an id that it gave a reply.
ReplyId = tuple[str, str, str]
Answer = tuple[Slot, str]


@dataclass(frozen=True, slots=True)
class Track:
    """One driver in the trials of one repetition: those of several variants together.

    ``template`` is the request without its prompt, with the model and the endpoint.
    """

    template: str
    condition: str
    repetition: int
    sample_set: int
    side: Side

    @property
    def trial(self) -> str:
        """The trials in a reader's words."""
        suffix = f"/set{self.sample_set}" if self.sample_set else ""
        return f"{self.condition}/rep{self.repetition:02d}{suffix}"


@dataclass(slots=True)
class Contents:
    """What is gathered of a recording while it is read, without its texts.

    ``reply_ids`` has the calls of each endpoint, model and id of a reply: by their key, the slot
    and a hash of the answer.
    """

    decisions: defaultdict[Track, Counter[int]] = field(
        default_factory=lambda: defaultdict(Counter)
    )
    reply_ids: defaultdict[ReplyId, dict[str, Answer]] = field(
        default_factory=lambda: defaultdict(dict)
    )
    served: Counter[tuple[str, str]] = field(default_factory=Counter)
    misnumbered: list[Slot] = field(default_factory=list)
    exchanged: list[Slot] = field(default_factory=list)


def audit_recording(file: Path) -> Audit:
    """Audit a recording; one that is damaged is a finding. Raises UsageError without a file."""
    try:
        summary = summarise(file)
        contents = Contents()
        for entry in read_recording(file):
            _gather(entry, contents)
    except RecordingError as exc:
        return Audit(str(file), {}, (Finding("recording", str(exc)),))
    config = _config(summary.provenance)
    tracks = contents.decisions
    telling, notes = _repeated(contents)
    findings = [
        *_numbering(tracks, config),
        *_shared(telling),
        *_served(contents, config),
        *(_at(slot, "attempt", "its attempts are out of order, or one follows an answer")
          for slot in contents.misnumbered),
        *(_at(slot, "derived", "its reply is, as the server says in it, another's answer")
          for slot in contents.exchanged),
        *_missing(tracks, config, ended=_ended(summary.provenance)),
    ]  # fmt: skip
    return Audit(
        subject=str(file),
        counts={
            "calls": summary.calls,
            "attempts": summary.attempts,
            "drives": len(tracks),
            "reply ids": len(contents.reply_ids),
            **{f"answers {name}": count for name, count in sorted(summary.outcomes.items())},
        },
        findings=tuple(findings),
        notes=(*summary.notes, *notes, *(() if config else (NO_CONFIG,))),
    )


def _gather(entry: CachedCall, contents: Contents) -> None:
    request, slot = entry.request, entry.request.slot
    template = canonical_json(
        [
            request.endpoint,
            request.model,
            request.path,
            request.headers,
            without_prompt(request.body),
        ]
    )
    track = Track(template, slot.condition, slot.repetition, slot.sample_set, slot.side)
    contents.decisions[track][slot.decision] += 1
    for attempt in entry.attempts:
        told = identified(attempt.reply or "") if attempt.http_status == 200 else None
        if told and not (request.provider == "emulator" and told[0] in CONSTANT_IDS):
            replies = contents.reply_ids[request.endpoint, request.model, told[0]]
            replies[request.key] = (slot, told[1])
        if attempt.http_status == 200 and attempt.model_served is not None:
            contents.served[request.model, attempt.model_served] += 1
    asked = hashlib.sha256(request.body.encode()).hexdigest()
    if any(answers_another(_json(a.reply), asked, slot.as_dict()) for a in entry.attempts):
        contents.exchanged.append(slot)
    numbers = [attempt.number for attempt in entry.attempts]
    early = any(a.outcome in ("ok", "refusal", "truncated") for a in entry.attempts[:-1])
    if early or numbers != list(range(1, len(numbers) + 1)):
        contents.misnumbered.append(slot)


def _json(text: str | None) -> object:
    try:
        return json.loads(text or "null")
    except (ValueError, RecursionError):
        return None


def _config(provenance: dict[str, str]) -> SweepConfig | None:
    try:
        return SweepConfig.model_validate_json(provenance.get("config", ""))
    except ValidationError:
        return None


def _numbering(tracks: dict[Track, Counter[int]], config: SweepConfig | None) -> Iterator[Finding]:
    """Every driver is asked from its first decision to its last, once per variant.

    Where a driver takes control at its own tunnel's exit, the later one begins later.
    """
    late = config is not None and config.scenario.get("control_start") == "own_exit"
    for track, numbers in tracks.items():
        # Without a word on variants: as many as there are first requests.
        variants = (
            sum(track.repetition <= wanted for wanted in config.repetitions.values())
            if config
            else numbers[min(numbers)]
        )
        first = min(numbers) if late else 0
        for number in range(first, max(numbers) + 1):
            if numbers[number] == 0:
                yield _in(track, number, "numbering", "nothing is recorded, though of later ones")
            elif numbers[number] > variants:
                text = f"{numbers[number]} requests are recorded, for {variants} prompt variants"
                yield _in(track, number, "numbering", text)


def _repeated(contents: Contents) -> tuple[list[list[Slot]], list[str]]:
    """The calls with one answer under one id, and notes of servers whose ids prove nothing.

    The rule is that of a database (see ids.py).
    """
    servers: defaultdict[tuple[str, str], list[list[Answer]]] = defaultdict(list)
    for (endpoint, model, _), answers in contents.reply_ids.items():
        if len(answers) > 1:
            servers[endpoint, model].append(list(answers.values()))
    telling, notes = [], []
    for (endpoint, model), repeated in servers.items():
        same = [answers for answers in repeated if len({content for _, content in answers}) == 1]
        found = same if 2 * len(same) >= len(repeated) else []
        telling += [[slot for slot, _ in answers] for answers in found]
        if others := sum(map(len, repeated)) - sum(map(len, found)):
            notes.append(repetition_note(model, endpoint, others))
    return telling, notes


def _shared(telling: list[list[Slot]]) -> Iterator[Finding]:
    for slots in telling:
        first, second, *rest = sorted(slots, key=lambda slot: tuple(slot.as_dict().items()))
        more = f" and {len(rest)} more" if rest else ""
        yield _at(
            first,
            "shared",
            f"its answer, with the provider's id of it, is also that of {_told(second)}{more}",
        )


def _served(contents: Contents, config: SweepConfig | None) -> Iterator[Finding]:
    models = config.models.values() if config else ()
    aliases = [(model.id, alias) for model in models for alias in model.aliases]
    for requested, served in others_among(sorted(contents.served), aliases):
        yield Finding(
            "served",
            f"{requested} -> {served}: another model answered than was asked for "
            f"({contents.served[requested, served]} answers)",
        )


def _ended(provenance: dict[str, str]) -> bool:
    """Whether the recorded sweep claims that all its trials ended."""
    return "ended_at" in provenance and provenance.get("exit_code", "0") == "0"


def _missing(
    tracks: dict[Track, Counter[int]], config: SweepConfig | None, *, ended: bool
) -> Iterator[Finding]:
    """Of a sweep that has ended, every trial asks each of its models for a first decision."""
    if config is None or not ended:
        return
    asked = [side for side in SIDES if config.sides[side] in config.models]
    recorded = {(track.condition, track.repetition, track.side) for track in tracks}
    cells = {(cell.condition, cell.repetition) for cell in config.trials.values()}
    for condition, repetition in sorted(cells):
        for side in asked:
            if (condition, repetition, side) not in recorded:
                track = Track("", condition, repetition, config.sample_set, side)
                yield _in(track, None, "missing", "nothing is recorded")


def _in(track: Track, decision: int | None, kind: str, text: str) -> Finding:
    return Finding(kind, text, trial=track.trial, side=track.side, decision=decision)


def _at(slot: Slot, kind: str, text: str) -> Finding:
    track = Track("", slot.condition, slot.repetition, slot.sample_set, slot.side)
    return _in(track, slot.decision, kind, text)


def _told(slot: Slot) -> str:
    found = _at(slot, "", "")
    return f"{found.trial}, {found.side}, decision {found.decision}"
