"""What a sweep's configuration promises: its trials, and what their specs hold."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.pace import Pace, pace_of
from merge_runner.errors import UsageError
from merge_runner.llm.content_hashes import between_body_and_slot
from merge_runner.records import SIDES
from merge_runner.text_safety import in_a_name


class _Facts(BaseModel):
    """Read leniently: another version of the program may have written more members."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class ModelFacts(_Facts):
    """What a sweep says of one of its models."""

    id: str
    provider: str
    format: str = ""
    aliases: tuple[str, ...] = ()
    parameters: dict[str, JsonValue] = {}
    path: str | None = None
    note: str = ""


class ArmFacts(_Facts):
    """What a sweep says of an arm of its study; ``asked`` are keys of the sweep's models."""

    model: str
    variant: str
    repetitions: int
    scenario: dict[str, JsonValue]
    sides: dict[str, str]
    asked: dict[str, str]
    factors: dict[str, str] = {}

    @property
    def levels(self) -> str:
        """The part of its trials' ids that is for its factors, spelled as the plan spells it."""
        return "".join(
            f"/{name}={in_a_name(level)}"
            for name, level in sorted(self.factors.items())
            if name not in ("prompt", "opponent")
        )


class StudyFacts(_Facts):
    """The file of a sweep's study as a text; its plug-ins, which lie beside it, are not read."""

    text: str


class SweepConfig(_Facts):
    """The configuration of a sweep as its row holds it.

    Where only the prompt varies there are no ``stored_arms``, and each variant is one.
    """

    model: str
    models: dict[str, ModelFacts]
    endpoints: dict[str, str]
    scenario: dict[str, JsonValue] = {}
    repetitions: dict[str, int]
    conditions: tuple[str, ...]
    sample_set: int
    prompt_blocks: dict[str, dict[str, str]] = {}
    seat: str = ""
    study: StudyFacts | None = None
    stored_arms: tuple[ArmFacts, ...] = Field(default=(), alias="arms")

    @cached_property
    def arms(self) -> tuple[ArmFacts, ...]:
        """All arms; without the plan's code, so that this is audited, too."""
        left, _, right = self.model.partition("+")
        sides = {"left": left, "right": right or left}
        return self.stored_arms or tuple(
            ArmFacts(
                model=self.model,
                variant=variant,
                repetitions=repetitions,
                scenario=self.scenario,
                sides=sides,
                asked=sides,
            )
            for variant, repetitions in self.repetitions.items()
        )

    def asks(self, arm: ArmFacts) -> bool:
        """Whether a language model drives in an arm."""
        return any(name in self.models for name in arm.asked.values())

    @cached_property
    def arm_of(self) -> dict[str, ArmFacts]:
        """Trial id, spelled as the plan spells it, to the trial's arm."""
        return {trial_id: arm for arm in self.arms for trial_id, _, _ in self._slots(arm)}

    @cached_property
    def trials(self) -> dict[str, dict[str, Any]]:
        """Trial id to what the trial's row should say."""
        return {
            trial_id: {
                "variant": arm.variant,
                "condition": condition,
                "rep": rep,
                "sample_set": self.sample_set,
                "model_left": arm.sides["left"],
                "model_right": arm.sides["right"],
                "source": "seat" if self.seat else "llm" if self.asks(arm) else "driver",
            }
            for arm in self.arms
            for trial_id, condition, rep in self._slots(arm)
        }

    def _slots(self, arm: ArmFacts) -> Iterator[tuple[str, str, int]]:
        prefix = "seat/" if self.seat else ""
        suffix = f"/set{self.sample_set}" if self.sample_set else ""
        for condition in self.conditions:
            for rep in range(1, arm.repetitions + 1):
                trial_id = f"{prefix}{arm.model}/{arm.variant}/{condition}/rep{rep:02d}{suffix}"
                yield trial_id + arm.levels, condition, rep


@dataclass(frozen=True)
class Spec:
    """What a spec hash stands for, as stored; ``content`` is empty where it cannot be read."""

    spec_hash: str
    text: str

    @cached_property
    def content(self) -> dict[str, Any]:
        """The spec as JSON values."""
        try:
            content = json.loads(self.text)
        except ValueError:
            return {}
        return content if isinstance(content, dict) else {}

    @cached_property
    def scenario(self) -> ScenarioConfig | None:
        """The scenario, None where it cannot be read; what it lacks has its default."""
        fields = self.content.get("scenario")
        if not isinstance(fields, dict):
            return None
        try:
            return ScenarioConfig.model_validate(
                {name: fields[name] for name in ScenarioConfig.model_fields if name in fields}
            )
        except ValidationError:
            return None

    def driver(self, side: str) -> dict[str, Any]:
        """What drives on a side."""
        driver = self.content.get(side)
        return driver if isinstance(driver, dict) else {}

    def pace(self, side: str) -> Pace | None:
        """When the driver of a side decides, None where that cannot be read."""
        if self.scenario is None:
            return None
        try:
            return pace_of(self.scenario, self.driver(side))
        except UsageError:
            return None

    def asks(self, side: str) -> bool:
        """Whether a language model drives on a side."""
        return "endpoint" in self.driver(side)

    def between_body_and_slot(self, side: str) -> str | None:
        """That part of the text of which a call's key is the hash; None where it is not known."""
        driver = self.driver(side)
        endpoint, path, headers = (driver.get(name) for name in ("endpoint", "path", "headers"))
        if not isinstance(headers, dict):
            return None
        if not all(isinstance(text, str) for text in (endpoint, path, *headers.values())):
            return None
        return between_body_and_slot(endpoint, path, tuple(headers.items()))

    def disagreements(self, config: SweepConfig, arm: ArmFacts) -> Iterator[str]:
        """In what the spec of an arm disagrees with the sweep's configuration."""
        if self.content.get("scenario") != arm.scenario:
            yield "scenario"
        if self.content.get("sample_set") != config.sample_set:
            yield "sample set"
        # Programs read no prompt, so that their specs hold none.
        blocks = config.prompt_blocks.get(arm.variant)
        if blocks and config.asks(arm) and self.content.get("prompt_blocks") != blocks:
            yield "prompt blocks"
        for side in SIDES:
            name = arm.asked[side]
            for what in _differences(self.driver(side), name, config):
                yield f"{side} {what}"


def _differences(driver: dict[str, Any], name: str, config: SweepConfig) -> Iterator[str]:
    model = config.models.get(name)
    if model is None:
        if driver.get("program") != name:
            yield "program"
        return
    if driver.get("endpoint") != config.endpoints.get(name):
        yield "endpoint"
    body = driver.get("body")
    if not isinstance(body, dict):
        yield "body"
        return
    # Gemini names the model in the path alone.
    in_path = f"/{model.id}:" in str(driver.get("path")) or model.path is not None
    sent = list(_members(body))
    named = model.id in [value for _, value in sent] or in_path
    if body["model"] != model.id if "model" in body else not named:
        yield "model"
    if any(parameter not in sent for parameter in model.parameters.items()):
        yield "parameters"


def _members(value: object) -> Iterator[tuple[str, object]]:
    """All members of the objects in a JSON value: formats put the parameters where they like."""
    for name, each in value.items() if isinstance(value, dict) else ():
        yield name, each
        yield from _members(each)
