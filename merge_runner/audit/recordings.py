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
from merge_runner.audit.replies import CONSTANT_IDS
from merge_runner.errors import RecordingError
from merge_runner.llm.cache import Entry
from merge_runner.llm.keys import canonical_json, without_prompt
from merge_runner.recording import read_recording, summarise
from merge_runner.records import SIDES, Attempt, ChatRequest, Side
from merge_runner.served import others_among


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
    """What is gathered of a recording while it is read."""

    decisions: defaultdict[Track, Counter[int]] = field(
        default_factory=lambda: defaultdict(Counter)
    )
    reply_ids: defaultdict[tuple[str, str, str], list[ChatRequest]] = field(
        default_factory=lambda: defaultdict(list)
    )
    served: Counter[tuple[str, str]] = field(default_factory=Counter)
    misnumbered: list[ChatRequest] = field(default_factory=list)
    exchanged: list[ChatRequest] = field(default_factory=list)


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
    findings = [
        *_numbering(tracks, config),
        *_shared(contents),
        *_served(contents, config),
        *(_at(request, "attempt", "its attempts are out of order, or one follows an answer")
          for request in contents.misnumbered),
        *(_at(request, "derived", "its reply is, as the server says in it, another's answer")
          for request in contents.exchanged),
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
        notes=(
            *summary.notes,
            *(() if config else ("it does not say of what sweep it is: trials are not compared",)),
        ),
    )


def _gather(entry: Entry, contents: Contents) -> None:
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
    for reply_id in {found for found in map(_reply_id, entry.attempts) if found}:
        if not (request.provider == "emulator" and reply_id in CONSTANT_IDS):
            contents.reply_ids[request.endpoint, request.model, reply_id].append(request)
    for attempt in entry.attempts:
        if attempt.http_status == 200 and attempt.model_served is not None:
            contents.served[request.model, attempt.model_served] += 1
    asked = hashlib.sha256(request.body.encode()).hexdigest()
    if any(answers_another(_json(a.reply), asked, slot.as_dict()) for a in entry.attempts):
        contents.exchanged.append(request)
    numbers = [attempt.number for attempt in entry.attempts]
    early = any(a.outcome in ("ok", "refusal", "truncated") for a in entry.attempts[:-1])
    if early or numbers != list(range(1, len(numbers) + 1)):
        contents.misnumbered.append(request)


def _reply_id(attempt: Attempt) -> str | None:
    """The provider's id of a reply of status 200; None where it has none."""
    reply = _json(attempt.reply)
    if attempt.http_status != 200 or not isinstance(reply, dict):
        return None
    found = reply.get("id") or reply.get("responseId")
    return found if isinstance(found, str) else None


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


def _shared(contents: Contents) -> Iterator[Finding]:
    for requests in contents.reply_ids.values():
        if len(requests) > 1:
            first, second, *rest = sorted(requests, key=lambda r: tuple(r.slot.as_dict().items()))
            more = f" and {len(rest)} more" if rest else ""
            yield _at(
                first,
                "shared",
                f"the provider's id of its reply is also that of {_told(second)}{more}",
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


def _at(request: ChatRequest, kind: str, text: str) -> Finding:
    slot = request.slot
    track = Track("", slot.condition, slot.repetition, slot.sample_set, slot.side)
    return _in(track, slot.decision, kind, text)


def _told(request: ChatRequest) -> str:
    found = _at(request, "", "")
    return f"{found.trial}, {found.side}, decision {found.decision}"
