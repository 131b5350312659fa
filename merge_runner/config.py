"""Configuration as frozen models; the only reader of TOML files."""

from __future__ import annotations

import os
import sys
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from merge_runner.errors import UsageError, unknown_name
from merge_runner.paths import SHIPPED_EXPERIMENTS
from merge_runner.records import MOST_STEPS, SIDES, Side
from merge_runner.text_safety import one_line

# Strict: without it "4" and true would be numbers.
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True)]
# Bounds of the equations of motion: the square of 1e308 overflows.
Rate = Annotated[Positive, Field(le=1e6)]
Deviation = Annotated[NotNegative, Field(le=1e6)]
Count = Annotated[int, Field(gt=0, strict=True)]
Resistance = Literal["none", "human"]
ModelT = TypeVar("ModelT", bound=BaseModel)


class Frozen(BaseModel):
    """Configuration object: frozen, finite; an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def whole_steps(name: str, seconds: float, step_s: float) -> int:
    """Return a duration as a number of steps; raises ValueError unless that is an integer >= 1."""
    steps = seconds / step_s
    if steps > MOST_STEPS:
        raise ValueError(f"{name} = {seconds:g} s is more than {MOST_STEPS} steps")
    if abs(steps - round(steps)) > 1e-9 or round(steps) < 1:
        raise ValueError(f"{name} = {seconds:g} s is no whole number of {step_s} s")
    return round(steps)


class Perception(Frozen):
    """Observation model of the driver of one side; the default is perfect perception.

    ``position_sd_m`` and ``speed_sd_mps`` are the standard deviations of the errors of the relative
    distance and of the other's speed. An error after t seconds is correlated by
    exp(-t / autocorrelation_s) with itself (Uhlenbeck and Ornstein, Phys. Rev. 36, 823, 1930); with
    0, errors are independent. The other is observed with a delay of ``delay_s``. A decision
    receives no new observation with the probability ``dropout``; it uses the last one. The other is
    visible up to a relative distance of ``range_m``, and once the ego is within ``view_from_m`` of
    the merge point, or past it. With ``own``, the ego's position and speed have errors of the same
    sizes.
    """

    position_sd_m: Deviation = 0.0
    speed_sd_mps: Deviation = 0.0
    autocorrelation_s: NotNegative = 0.0
    delay_s: NotNegative = 0.0
    dropout: Annotated[NotNegative, Field(le=1)] = 0.0
    range_m: Positive | None = None
    view_from_m: Positive | None = None
    own: Annotated[bool, Field(strict=True)] = False

    @property
    def is_random(self) -> bool:
        """True if errors or dropouts are random."""
        return bool(self.position_sd_m or self.speed_sd_mps or self.dropout)

    @model_validator(mode="after")
    def _errors_of_a_size(self) -> Perception:
        if (self.autocorrelation_s or self.own) and not (self.position_sd_m or self.speed_sd_mps):
            raise ValueError(
                "autocorrelation_s and own need an error: set position_sd_m or speed_sd_mps"
            )
        return self


PERFECT = Perception()


class ScenarioConfig(Frozen):
    """Driving task of arXiv 2604.09609 (Table I), with a switch for each open point.

    ``collision_rule``: ``euclid2d`` (centres closer than a vehicle length), ``rectangle`` (the
    vehicles' oriented boxes overlap, as in the human experiment) or ``shared_lane``
    (|s_L - s_R| below a vehicle length once either has passed the merge point).
    ``control_start``: ``both_exits`` starts when both vehicles are out of their tunnels,
    ``own_exit`` at the earlier exit; the other vehicle cruises until its own exit.
    ``resistance``: ``human`` adds the drag of the human simulator, 0.5 + 0.005 v^2 in m/s^2. No
    prompt mentions it; a plan of zeros then slows by 1 m/s per second at 10 m/s.
    ``history_start``: before t = 0 the history shows ``cruise`` (a = 0, constant speeds) or is
    ``empty``. ``fallback``: after an invalid reply the last valid plan ``continue``s at its next
    action, or ``restart``s at its first action. ``straight_after``: the prompt says "straight"
    once the ``own`` vehicle, or once ``both``, have passed the merge point.
    ``step_s`` is the world's step. ``plan_step_s`` is the duration of an action of a language
    model's plan and the sampling interval of its histories, by default ``step_s``.
    ``prompt_rate_hz`` is the decision rate of a language model, and of a program without its own.
    ``perception_left`` and ``perception_right`` are the observation models of the two drivers.
    """

    horizon_s: Positive = 4.0
    step_s: Positive = 0.2
    # Left out if not given, so that older specs keep their hashes.
    plan_step_s: Positive | None = Field(default=None, exclude_if=lambda value: value is None)
    prompt_rate_hz: Positive = 1.0
    memory_s: Positive = 2.0
    max_acceleration_mps2: Rate = 2.5
    vehicle_length_m: Annotated[Positive, Field(le=100)] = 4.5
    vehicle_width_m: Annotated[Positive, Field(le=100)] = 1.8
    timeout_s: Positive = 30.0
    collision_rule: Literal["euclid2d", "rectangle", "shared_lane"] = "euclid2d"
    control_start: Literal["both_exits", "own_exit"] = "both_exits"
    resistance: Resistance = "none"
    history_start: Literal["cruise", "empty"] = "cruise"
    fallback: Literal["continue", "restart"] = "continue"
    straight_after: Literal["own", "both"] = "own"
    # Left out if perfect, for the same reason.
    perception_left: Perception = Field(default=PERFECT, exclude_if=lambda p: p == PERFECT)
    perception_right: Perception = Field(default=PERFECT, exclude_if=lambda p: p == PERFECT)

    def perception(self, side: Side) -> Perception:
        """Return the perception of the driver of a side."""
        return self.perception_left if side == "left" else self.perception_right

    @cached_property
    def action_s(self) -> float:
        """Duration of an action of a language model's plan."""
        return self.step_s if self.plan_step_s is None else self.plan_step_s

    @cached_property
    def action_steps(self) -> int:
        """Number of the world's steps in an action of a language model's plan."""
        return round(self.action_s / self.step_s)

    @cached_property
    def plan_actions(self) -> int:
        """Number of actions of a language model's plan (N in the paper)."""
        return round(self.horizon_s / self.action_s)

    @cached_property
    def executed_actions(self) -> int:
        """Number of actions of a plan that are executed before the next prompt."""
        return round(1 / (self.prompt_rate_hz * self.action_s))

    @cached_property
    def memory_samples(self) -> int:
        """Number of the world's samples in each history."""
        return round(self.memory_s / self.step_s)

    @cached_property
    def timeout_steps(self) -> int:
        """Number of steps until a trial times out."""
        return round(self.timeout_s / self.step_s)

    @model_validator(mode="after")
    def _whole_steps(self) -> ScenarioConfig:
        delays_s = {side: self.perception(side).delay_s for side in SIDES}
        for name, seconds, step_s in (
            ("plan_step_s", self.action_s, self.step_s),
            ("horizon_s", self.horizon_s, self.action_s),
            ("memory_s", self.memory_s, self.action_s),
            ("timeout_s", self.timeout_s, self.step_s),
            ("1 / prompt_rate_hz", 1 / self.prompt_rate_hz, self.action_s),
            *((f"perception_{s}.delay_s", delays_s[s], self.step_s) for s in SIDES if delays_s[s]),
        ):
            try:
                whole_steps(name, seconds, step_s)
            except ValueError as exc:
                raise ValueError(f"{exc}: set step_s and plan_step_s so that it fits") from exc
        if self.executed_actions > self.plan_actions:
            raise ValueError("the horizon is shorter than the time between two prompts")
        return self


def has_screen(env: Mapping[str, str] = os.environ) -> bool:
    """Return whether this machine can open a browser window."""
    return sys.platform == "darwin" or bool(env.get("DISPLAY") or env.get("WAYLAND_DISPLAY"))


def state_folder(env: Mapping[str, str] = os.environ) -> Path:
    """Return the program's state folder of the user, in XDG_STATE_HOME or HOME.

    A relative one is ignored: a working folder could bring its own. Raises UsageError.
    """
    home = Path(env.get("HOME", ""), ".local/state")
    folder = next(filter(Path.is_absolute, (Path(env.get("XDG_STATE_HOME", "")), home)), None)
    if folder is None:
        raise UsageError("HOME names no folder: set it, or XDG_STATE_HOME")
    return folder / "merge-runner"


def read_text(path: Path) -> str:
    """Return the text of a file without a byte order mark; raises UsageError."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as exc:
        why = getattr(exc, "strerror", exc)
        raise UsageError(f"{path} cannot be read: {why}") from exc


def toml_of(text: str, where: str) -> dict[str, Any]:
    """Return a TOML text as a dict; raises UsageError with its place ``where``."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as exc:  # also a number of thousands of digits
        raise UsageError(f"{where} is no TOML file: {exc}") from exc


def validated(model: type[ModelT], value: object, where: str) -> ModelT:
    """Return a value as a configuration object; raises UsageError with its place ``where``."""
    try:
        return model.model_validate(value)
    except ValidationError as exc:
        raise UsageError(one_line(f"{where}: {'; '.join(_explain(exc, model))}")) from exc


def experiments() -> list[Path]:
    """Return the folders of studies: ``experiments`` here, then the shipped one."""
    folders = {path.resolve(): path for path in (SHIPPED_EXPERIMENTS, Path("experiments"))}
    return [path for path in reversed(folders.values()) if path.is_dir()]


def _explain(exc: ValidationError, model: type[BaseModel]) -> Iterator[str]:
    for error in exc.errors():
        place = ".".join(map(str, error["loc"]))
        text = error["msg"].removeprefix("Value error, ")
        if error["type"] not in ("extra_forbidden", "unexpected_keyword_argument"):
            yield f"{place}: {text}" if place else text
            continue
        owner: Any = model
        for part in error["loc"][:-1]:
            known = getattr(owner, "model_fields", {}).get(str(part))
            owner = (known and model_in(known.annotation)) or owner
        keys = [f.name for f in fields(owner)] if is_dataclass(owner) else owner.model_fields
        yield str(unknown_name("key", place, keys))


def model_in(annotation: object) -> type | None:
    """Return the model or data class that a field holds, also in a list or a table of them."""
    if isinstance(annotation, type) and (
        issubclass(annotation, BaseModel) or is_dataclass(annotation)
    ):
        return annotation
    return next(filter(None, map(model_in, get_args(annotation))), None)
