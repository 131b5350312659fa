"""What the emulator replies to a chat request, however it arrives, and how often it has."""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from dataclasses import dataclass
from typing import Any

from merge_runner.config import validated
from merge_runner.emulator import driver, random_driver
from merge_runner.emulator.faults import Fault, FaultPlan
from merge_runner.emulator.formats import Said, ServedFormat
from merge_runner.errors import UsageError
from merge_runner.planted_effect import PlantedEffect, planted_fields
from merge_runner.records import ANSWERED_FIELD, SCRIPTED_FIELD, Slot

MODELS = ("scripted-driver",)
# What anything but a chat request can raise: refused with 400.
UNREADABLE = (ValueError, TypeError, AttributeError, KeyError, IndexError, RecursionError)
# What the model says in place of the driver's answer.
TEXTS = {
    "malformed": "M\n\nI would rather describe my plan in words than write a list of numbers.",
    "empty": "",
}


@dataclass(frozen=True, slots=True)
class Asked:
    """A chat request: its path and body, and the slot and the attempt as the client told them.

    ``model`` is the one in the path, where it stands there. ``custom_id`` is that of a line of a
    batch.
    """

    wire: ServedFormat
    path: str
    raw: bytes
    model: str | None = None
    slot: str | None = None
    attempt: str = ""
    custom_id: str | None = None

    @property
    def where(self) -> str:
        """What names the request among all that may be asked."""
        return self.slot or self.body_sha256

    @property
    def body_sha256(self) -> str:
        """The hash of its body."""
        return hashlib.sha256(self.raw).hexdigest()


@dataclass(frozen=True, slots=True)
class Question:
    """A request that has been understood."""

    asked: Asked
    slot: Slot | None
    prompt: str
    model: str
    effect: PlantedEffect | None


class Replies:
    """Answers questions, and counts the answers: a provider would bill each."""

    def __init__(self, faults: FaultPlan) -> None:
        self.faults = faults
        self._asked: Counter[str] = Counter()
        self._answered: Counter[tuple[str, str | None, str | None]] = Counter()

    def question(self, asked: Asked) -> Question:
        """What is asked; raises UsageError."""
        try:
            body = json.loads(asked.raw)
            slot = _slot(asked.slot)
            prompt = asked.wire.prompt(body)
            model = asked.model or str(body.get("model", MODELS[0]))
            (prompt + model).encode()
            planted = planted_fields(asked.wire.parameters(body))
        except UNREADABLE as exc:
            raise UsageError("The body is not valid.") from exc
        effect = validated(PlantedEffect, planted, "the emulator") if planted else None
        return Question(asked, slot, prompt, model, effect)

    def attempt(self, asked: Asked) -> int:
        """The attempt's number: the client's own count, or else how often this was asked."""
        self._asked[asked.where] += 1
        told = asked.attempt
        return int(told) if re.fullmatch("[0-9]{1,6}", told) else self._asked[asked.where]

    def answer(self, question: Question, attempt: int, fault: Fault | None) -> dict[str, Any]:
        """The body of an answer, with the field that says that no model made it."""
        asked, slot = question.asked, question.slot
        text = TEXTS[fault] if fault in TEXTS else _text(question)
        # Only the same attempt at the same request gets the same id: the audit takes one that
        # comes back for an answer that was given twice.
        which = f"{asked.path} {asked.where} {attempt}".encode()
        reply_id = hashlib.sha256(asked.raw + which).hexdigest()[:24]
        refused, typical = fault == "refused", self.faults.output_tokens
        said = Said(reply_id, question.model, question.prompt, text, refused, typical)
        body_sha256 = asked.body_sha256
        told = {"body_sha256": body_sha256, "slot": slot and slot.as_dict()}
        self._answered[body_sha256, asked.slot, asked.custom_id] += 1
        return marked({**asked.wire.answer(said), ANSWERED_FIELD: told})

    def count(self) -> list[dict[str, Any]]:
        """How often each request was answered; one without a ``custom_id`` was asked singly."""
        return [
            {"body_sha256": body, "slot": slot, "custom_id": custom_id, "answered": count}
            for (body, slot, custom_id), count in self._answered.items()
        ]


def _text(question: Question) -> str:
    if question.model == random_driver.MODEL:
        return random_driver.answer(question.prompt, question.slot)
    return driver.answer(question.prompt, question.slot, question.effect)


def marked(body: dict[str, Any]) -> dict[str, Any]:
    """A body with the field that says that no model made it."""
    return {**body, SCRIPTED_FIELD: True}


def dumps(body: object) -> bytes:
    """A body as it is sent."""
    return json.dumps(body, ensure_ascii=False).encode()


def _slot(header: str | None) -> Slot | None:
    """The slot that a client sent; raises ValueError or TypeError for an impossible one."""
    if header is None:
        return None
    return Slot(**json.loads(header))
