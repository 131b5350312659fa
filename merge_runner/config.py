"""Every knob as a field of a frozen model; the only reader of TOML files and the environment."""

from __future__ import annotations

import ipaddress
import os
import re
import sys
import tomllib
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from datetime import date
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar, get_args
from urllib.parse import SplitResult, urlsplit

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    JsonValue,
    PrivateAttr,
    ValidationError,
    model_validator,
)

from merge_runner.errors import UsageError, unknown_name
from merge_runner.paths import SHIPPED_EXPERIMENTS
from merge_runner.planted_effect import PARAMETERS as PLANTED
from merge_runner.records import MOST_STEPS, SIDES, Side
from merge_runner.registry import Registry
from merge_runner.text_safety import one_line

LOOPBACK = ("127.0.0.1", "localhost", "::1")
# A shorter key is a dummy, and may occur in any text.
SHORTEST_SECRET = 8
UNNAMED = "default"


# Strict, or else "4" and true would be numbers.
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True)]
# What the equations of motion can take: the square of 1e308 is no number.
Rate = Annotated[Positive, Field(le=1e6)]
Deviation = Annotated[NotNegative, Field(le=1e6)]
Count = Annotated[int, Field(gt=0, strict=True)]
Resistance = Literal["none", "human"]
ModelT = TypeVar("ModelT", bound=BaseModel)


class Frozen(BaseModel):
    """A configuration object: frozen, finite, and an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def whole_steps(name: str, seconds: float, step_s: float) -> int:
    """How many steps a time takes; raises ValueError where that is no whole number from 1."""
    steps = seconds / step_s
    if steps > MOST_STEPS:
        raise ValueError(f"{name} = {seconds:g} s is more than {MOST_STEPS} steps")
    if abs(steps - round(steps)) > 1e-9 or round(steps) < 1:
        raise ValueError(f"{name} = {seconds:g} s is no whole number of {step_s} s")
    return round(steps)


class Perception(Frozen):
    """How the driver of one side perceives the other vehicle; by default exactly, at once, always.

    ``position_sd_m`` and ``speed_sd_mps`` are the standard deviations of the errors of the relative
    distance and of the other's speed. An error after t seconds is correlated by
    exp(-t / autocorrelation_s) with itself (Uhlenbeck and Ornstein, Phys. Rev. 36, 823, 1930); 0:
    each instant has its own. The other is seen as it was ``delay_s`` ago. A decision receives
    nothing with the probability ``dropout``, and shows what was received last. The other is seen up
    to a relative distance of ``range_m``, and once the own car is within ``view_from_m`` of the
    merge point, or past it. ``own`` gives the own position and speed errors of the same sizes.
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
        """Whether errors or dropouts are drawn."""
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
    """The driving task of arXiv 2604.09609 (Table I), with a switch for each open point.

    ``collision_rule``: ``euclid2d`` (centres closer than a vehicle length), ``rectangle`` (the
    vehicles' oriented boxes overlap, as in the human experiment) or ``shared_lane``
    (|s_L - s_R| below a vehicle length once either has passed the merge point).
    ``control_start``: ``both_exits`` starts where both vehicles are out of their tunnels,
    ``own_exit`` at the earlier exit, the other vehicle cruising until its own.
    ``resistance``: ``human`` adds the drag of the human simulator, 0.5 + 0.005 v^2 in m/s^2;
    drivers are not told, and a plan of zeros then slows by 1 m/s per second at 10 m/s.
    ``history_start``: before t = 0 the history shows ``cruise`` (a = 0, constant speeds) or is
    ``empty``. ``fallback``: after an invalid reply the last valid plan ``continue``s where it
    was left, or ``restart``s at its first action. ``straight_after``: the prompt says "straight"
    once the ``own`` vehicle, or once ``both``, have passed the merge point.
    ``step_s`` is the world's step. ``plan_step_s`` is how long an action of a language model's plan
    lasts and how far apart the samples of its histories are, ``step_s`` where it is not given.
    ``prompt_rate_hz`` is a language model's, and that of a program without a rate of its own.
    ``perception_left`` and ``perception_right`` say what the driver of each side perceives.
    """

    horizon_s: Positive = 4.0
    step_s: Positive = 0.2
    # Left out where it is not given, so that specs from before it keep their hashes.
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
    # Left out where they are perfect, for the same reason.
    perception_left: Perception = Field(default=PERFECT, exclude_if=lambda p: p == PERFECT)
    perception_right: Perception = Field(default=PERFECT, exclude_if=lambda p: p == PERFECT)

    def perception(self, side: Side) -> Perception:
        """What the driver of a side perceives."""
        return self.perception_left if side == "left" else self.perception_right

    @cached_property
    def action_s(self) -> float:
        """How long an action of a language model's plan lasts."""
        return self.step_s if self.plan_step_s is None else self.plan_step_s

    @cached_property
    def action_steps(self) -> int:
        """How many steps of the world an action of a language model's plan lasts."""
        return round(self.action_s / self.step_s)

    @cached_property
    def plan_actions(self) -> int:
        """N, the number of actions of a language model's plan."""
        return round(self.horizon_s / self.action_s)

    @cached_property
    def executed_actions(self) -> int:
        """How many actions of a plan are driven before the next prompt."""
        return round(1 / (self.prompt_rate_hz * self.action_s))

    @cached_property
    def memory_samples(self) -> int:
        """The number of the world's samples in each history."""
        return round(self.memory_s / self.step_s)

    @cached_property
    def timeout_steps(self) -> int:
        """The number of steps after which a trial is over."""
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


class Price(Frozen):
    """USD per million tokens, and where the figures were read.

    ``tiers`` are factors of them by the ``service_tier`` that a reply names.
    """

    input: NotNegative
    cached_input: NotNegative | None = None
    output: NotNegative
    tiers: dict[str, Positive] = {}
    source: str


class BatchTerms(Frozen):
    """What a batch mode costs, as a factor of what single calls cost, and where that was read."""

    price_factor: Annotated[Positive, Field(le=1)]
    source: str


class ModelEntry(Frozen):
    """One model of a ``models.toml``.

    ``id`` is what is sent (UNNAMED: what a server of one's own serves); a served model that is
    neither it nor one of ``aliases`` is a mismatch. ``parameters`` go into the request as they are,
    and nothing else does; ``applied_defaults`` puts on record which defaults of the provider apply,
    ``rejects`` names parameters that the model refuses or does not heed, ``efforts`` the levels of
    ``reasoning_effort`` as parameters, for a model that has none of this name. ``successor`` names
    the entry to go on with from the ``shutdown`` on. ``price`` is ``free``, ``genai-prices`` (the
    table of that package) or explicit figures. ``rpm`` and ``tpm`` are requests and tokens a
    minute. ``typical_output_tokens`` and ``typical_latency_s`` serve estimates
    alone. A reply longer than ``max_reply_mb`` (unpacked) is refused. ``batch`` is the batch mode:
    the ``provider``'s, ``none``, or one on the terms of another server that speaks the format.
    """

    provider: str
    format: str
    id: str = UNNAMED
    aliases: tuple[str, ...] = ()
    parameters: dict[str, JsonValue] = {}
    applied_defaults: dict[str, JsonValue] = {}
    rejects: tuple[str, ...] = ()
    efforts: dict[str, dict[str, JsonValue]] = {}
    max_output_tokens: Count
    cap_field: Literal["max_completion_tokens", "max_tokens"] = "max_completion_tokens"
    rpm: Count | None = None
    tpm: Count | None = None
    shutdown: date | None = None
    successor: str = ""
    price: Literal["free", "genai-prices"] | Price = "genai-prices"
    base_url: str | None = None
    path: str | None = None
    key_env: str | None = None
    auth: Literal["bearer", "api-key"] | None = None
    timeout_s: Positive = 600.0
    deadline_s: Positive = 1200.0
    max_reply_mb: Positive = 16.0
    batch: Literal["provider", "none"] | BatchTerms = "provider"
    typical_output_tokens: Count = 1000
    typical_latency_s: Positive = 10.0
    note: str = ""
    _place: str = PrivateAttr("its table of models.toml")

    @property
    def place(self) -> str:
        """Where a user corrects it: table and file, as ``[o3] in models.toml``."""
        return self._place

    def standing_at(self, place: str) -> Self:
        """Return it with another ``place``."""
        copied = self.model_copy()
        copied._place = one_line(place)
        return copied

    @property
    def key_envs(self) -> tuple[str, ...]:
        """The variables that may hold the key, the first one first; raises UsageError."""
        return (self.key_env,) if self.key_env else PROVIDERS.require(self.provider).key_envs


@dataclass(frozen=True, slots=True)
class Provider:
    """Where a provider is reached, which variables configure it, and how it takes a key.

    ``auth`` is ``bearer`` or the header that holds the key. ``error_members`` are the members that
    every error of the provider has, by its documentation: one without them may be a gateway's.
    ``parameters`` are those that its servers take beside those of the wire format. ``batch`` are
    the terms of its batch mode. ``model_env`` is the variable that names the model of an entry
    without a name; a provider with one also lists its models at ``/models``. ``if_nobody`` says
    what to do where nobody answers.
    """

    base_url: str
    base_url_env: str | None = None
    key_envs: tuple[str, ...] = ()
    auth: str = "bearer"
    key_needed: bool = True
    error_members: frozenset[str] = frozenset()
    parameters: frozenset[str] = frozenset()
    batch: BatchTerms | None = None
    model_env: str | None = None
    if_nobody: str = "check the network"


_half = partial(BatchTerms, price_factor=0.5)
_ANTHROPIC_GUIDE = "platform.claude.com/docs/en/build-with-claude/batch-processing, 2026-11"
PROVIDERS: Registry[Provider] = Registry("provider")
for _name, _provider in {
    "openai": Provider(
        "https://api.openai.com/v1",
        "OPENAI_BASE_URL",
        ("OPENAI_API_KEY",),
        error_members=frozenset({"message", "type", "code"}),
        batch=_half(source="platform.openai.com/docs/guides/batch, 2026-11"),
    ),
    "gemini": Provider(
        "https://generativelanguage.googleapis.com",
        "GOOGLE_GEMINI_BASE_URL",
        # The official SDK prefers GOOGLE_API_KEY where both are set.
        ("GOOGLE_API_KEY", "GEMINI_API_KEY"),
        auth="x-goog-api-key",
        error_members=frozenset({"message", "code", "status"}),
        batch=_half(source="ai.google.dev/gemini-api/docs/batch-api, 2026-11"),
    ),
    "anthropic": Provider(
        "https://api.anthropic.com",
        "ANTHROPIC_BASE_URL",
        ("ANTHROPIC_API_KEY",),
        auth="x-api-key",
        error_members=frozenset({"message", "type"}),
        batch=_half(source=_ANTHROPIC_GUIDE),
    ),
    "openrouter": Provider(
        "https://openrouter.ai/api/v1",
        key_envs=("OPENROUTER_API_KEY",),
        error_members=frozenset({"message", "code"}),
        parameters=frozenset({"top_k", "min_p", "top_a", "repetition_penalty", "reasoning"}),
    ),
    "local": Provider(
        "http://localhost:8000/v1",
        "LOCAL_BASE_URL",
        ("LOCAL_API_KEY",),
        key_needed=False,
        # Of vLLM, llama.cpp and Ollama; a server leaves out those that it does not know.
        parameters=frozenset(
            {"top_k", "min_p", "typical_p", "repeat_penalty", "repetition_penalty", "grammar"}
            | {"structured_outputs", "chat_template_kwargs", "mirostat_mode", "options"}
        ),
        model_env="LOCAL_MODEL",
        if_nobody="start a server (docs/models.md#local-models)",
    ),
    "emulator": Provider(
        "http://127.0.0.1/v1",
        "EMULATOR_BASE_URL",
        key_needed=False,
        parameters=PLANTED,
        batch=_half(source="as the providers that it stands in for"),
        if_nobody="start it with `merge-runner emulate`",
    ),
}.items():
    PROVIDERS.register(_name, _provider)


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Where the calls of one model go.

    ``identity`` enters every cache key: the provider's name at its default URL, ``emulator`` for
    our own server, otherwise the normalised base URL. ``auth_headers`` hold the secret and are
    neither hashed nor stored. ``place`` is that of its entry.
    """

    provider: str
    identity: str
    base_url: str
    auth_headers: Mapping[str, str] = field(repr=False)
    place: str = "models.toml"


def resolve_endpoint(name: str, entry: ModelEntry, env: Mapping[str, str] = os.environ) -> Endpoint:
    """The endpoint of a model, from its entry and the environment.

    Raises UsageError where a key is needed and none is set, or where one cannot be sent.
    """
    provider = PROVIDERS.require(entry.provider)
    variables = " or ".join(entry.key_envs)
    key = next(filter(None, map(env.get, entry.key_envs)), "")
    if not key and provider.key_needed:
        raise UsageError(
            f"{name} needs a key: set {variables}. Without one: `merge-runner sweep baseline` runs "
            f"the emulator, and `merge-runner replay baseline --model {name} --recording "
            "FILE.parquet` replays a recording."
        )
    if not (key.isascii() and key.isprintable() and " " not in key):
        raise UsageError(
            f"{name} needs another key: {variables} holds a space, a line break or another "
            "character that no key has"
        )
    base_url = endpoint_url(entry, env)
    if len(key) >= SHORTEST_SECRET and key.lower() in base_url.lower():
        raise UsageError(f"the base URL of {name} holds its key: take it out, since URLs are shown")
    auth = entry.auth or provider.auth
    headers = {"authorization": f"Bearer {key}"} if auth == "bearer" else {auth: key}
    identity = endpoint_identity(entry, env)
    return Endpoint(entry.provider, identity, base_url, headers if key else {}, entry.place)


def endpoint_url(entry: ModelEntry, env: Mapping[str, str] = os.environ) -> str:
    """Return the base URL of a model; raises UsageError."""
    provider = PROVIDERS.require(entry.provider)
    variable = provider.base_url_env
    if variable and not entry.base_url and env.get(variable):
        return normalised_url(env[variable], variable)
    return normalised_url(entry.base_url or provider.base_url)


def model_id(entry: ModelEntry, env: Mapping[str, str] = os.environ) -> str | None:
    """What is sent as the model, by the entry or the environment; None: the server says it."""
    variable = PROVIDERS.require(entry.provider).model_env
    if variable is None or entry.id != UNNAMED:
        return entry.id
    return env.get(variable) or None


def endpoint_identity(entry: ModelEntry, env: Mapping[str, str] = os.environ) -> str:
    """What stands for the endpoint in cache keys; see Endpoint."""
    provider = PROVIDERS.require(entry.provider)
    base_url = endpoint_url(entry, env)
    if entry.provider == "emulator":
        return "emulator"
    return entry.provider if base_url == normalised_url(provider.base_url) else base_url


def driver_name(model: str, endpoint: str | None) -> str:
    """How a driver is named: with its endpoint where that is not the provider's own.

    The macro of this name in schema.sql says the same.
    """
    host = re.search("://([^/]+)", endpoint or "")
    return f"{model} at {host[1]}" if host else model


def without_endpoint(driver: str) -> str:
    """Return a driver's name without its endpoints.

    >>> without_endpoint("bold at localhost:8123 [temperature=0.2]")
    'bold [temperature=0.2]'
    >>> without_endpoint("bold at localhost:8123/set1")
    'bold/set1'
    """
    return re.sub(r" at [^\s+]+?(?=/set\d+(?: |$)|[\s+]|$)", "", driver)


def both_sides(model: str) -> dict[Side, str]:
    """Who drives on each side, by what ``--model`` says: one name, or two that + joins."""
    left, _, right = model.partition("+")
    return {"left": left, "right": right or left}


def ego_side(sides: Mapping[Side, str], asking: Container[str], opponent: str = "") -> Side:
    """On which side the ego of a pair sits: the driver whose odds are told, and who is named first.

    It is the one that a study does not call the opponent; else a language model before a program
    (``asking`` holds those), and of two alike the first in the alphabet. Where both sides have one
    driver it is the left one. The view ``trial_drivers`` says the same.
    """
    left, right = sides["left"], sides["right"]
    if left == right or opponent in (left, right):
        return "right" if opponent == left != right else "left"
    if (left in asking) != (right in asking):
        return "left" if left in asking else "right"
    return "left" if left < right else "right"


def pair_name(pair: Iterable[str], endpoints: Mapping[str, str]) -> str:
    """Who drives; from the ego on, as the view ``trial_drivers`` says but for the sample set."""
    one, other = (driver_name(model, endpoints.get(model)) for model in pair)
    return one if one == other else f"{one}+{other}"


def key_status(
    entry: ModelEntry, env: Mapping[str, str] = os.environ
) -> Literal["set", "missing", "not needed"]:
    """Whether the environment holds the key that a live run of the model needs."""
    if not PROVIDERS.require(entry.provider).key_needed:
        return "not needed"
    return "set" if any(map(env.get, entry.key_envs)) else "missing"


def normalised_url(url: str, named: str = "base_url") -> str:
    """A base URL in one spelling: lower-case scheme and host, no default port, no last slash.

    Raises UsageError, which shows nothing of it: a key may have been pasted there. It is told apart
    by what it is ``named``.
    """
    parts = http_url(url.strip())
    if parts is None or "@" in parts.netloc or parts.query or parts.fragment:
        raise UsageError(
            f"{named} is no base URL: it must begin with http:// or https:// and name a host that "
            "there can be, without spaces, a user name, a password or a part after ? or # (write "
            "other letters than ASCII as xn--..., and a key into the provider's variable)"
        )
    default_port = ":443" if parts.scheme == "https" else ":80"
    host = parts.netloc.lower().removesuffix(default_port).removesuffix(":")
    return f"{parts.scheme}://{host}{parts.path.rstrip('/')}"


def http_url(url: str) -> SplitResult | None:
    """The parts of a URL, or None where no host can be reached at it by HTTP."""
    try:
        parts = urlsplit(url)
        name = parts.hostname or ""
        if ":" in name or re.fullmatch(r"[0-9]+(\.[0-9]+){3}", name):
            ipaddress.ip_address(name)
        name.encode("idna")  # raises where a label is empty or too long
        is_host = parts.port != 0 and re.fullmatch(r"[\w.:-]+", name)
    except ValueError:
        return None
    is_written = re.fullmatch("[!-~]+", url) and parts.scheme in ("http", "https")
    return parts if is_host and is_written else None


def has_screen(env: Mapping[str, str] = os.environ) -> bool:
    """Whether a browser could open a window here."""
    return sys.platform == "darwin" or bool(env.get("DISPLAY") or env.get("WAYLAND_DISPLAY"))


def state_folder(env: Mapping[str, str] = os.environ) -> Path:
    """Return the folder of what the program remembers for a user.

    It lies in XDG_STATE_HOME, or else in HOME, and is never relative, or else a working folder
    could bring its own. Raises UsageError.
    """
    home = Path(env.get("HOME", ""), ".local/state")
    folder = next(filter(Path.is_absolute, (Path(env.get("XDG_STATE_HOME", "")), home)), None)
    if folder is None:
        raise UsageError("HOME names no folder: set it, or XDG_STATE_HOME")
    return folder / "merge-runner"


def base_urls(entries: Mapping[str, ModelEntry]) -> dict[str, str]:
    """The variables of this environment that say where the entries' providers are reached."""
    variables = {PROVIDERS.require(entry.provider).base_url_env for entry in entries.values()}
    return {v: os.environ[v] for v in variables if v and os.environ.get(v)}


def read_text(path: Path) -> str:
    """The text of a file, without the byte order mark of Windows editors; raises UsageError."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as exc:
        why = getattr(exc, "strerror", exc)
        raise UsageError(f"{path} cannot be read: {why}") from exc


def toml_of(text: str, where: str) -> dict[str, Any]:
    """A TOML text as a dict; raises UsageError, which says ``where`` it stands."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as exc:  # also a number of thousands of digits
        raise UsageError(f"{where} is no TOML file: {exc}") from exc


def validated(model: type[ModelT], value: object, where: str) -> ModelT:
    """A value as a configuration object; raises UsageError, which says ``where`` it stands."""
    try:
        return model.model_validate(value)
    except ValidationError as exc:
        raise UsageError(one_line(f"{where}: {'; '.join(_explain(exc, model))}")) from exc


def experiments() -> list[Path]:
    """The folders of studies: that of the working directory goes before what ships."""
    folders = {path.resolve(): path for path in (SHIPPED_EXPERIMENTS, Path("experiments"))}
    return [path for path in reversed(folders.values()) if path.is_dir()]


def url_origin(url: str) -> str:
    """Return the scheme, host and port of a URL in one spelling; raises UsageError."""
    parts = urlsplit(normalised_url(url))
    return f"{parts.scheme}://{parts.netloc}"


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
