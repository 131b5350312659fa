"""Configuration as frozen models; the only reader of TOML files and the environment."""

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
# A shorter key is a dummy that may occur in any text.
SHORTEST_SECRET = 8
UNNAMED = "default"


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


class Price(Frozen):
    """Price in USD per million tokens, with its source.

    ``tiers`` are factors by the ``service_tier`` in a reply.
    """

    input: NotNegative
    cached_input: NotNegative | None = None
    output: NotNegative
    tiers: dict[str, Positive] = {}
    source: str


class BatchTerms(Frozen):
    """Price of a batch mode as a factor of the usual price, with its source."""

    price_factor: Annotated[Positive, Field(le=1)]
    source: str


class ModelEntry(Frozen):
    """One model of a ``models.toml``.

    ``id`` is the model id to send (UNNAMED: the model of a local server); a served model that is
    neither the id nor one of ``aliases`` is a mismatch. The request has exactly the ``parameters``;
    ``applied_defaults`` documents the provider's defaults, ``rejects`` the parameters that the
    model refuses or ignores, ``efforts`` the parameters for each level of ``reasoning_effort`` of a
    model without a parameter of this name. ``successor`` is the entry to use from the ``shutdown``
    on. ``price`` is ``free``, ``genai-prices`` (the table of that package) or explicit figures.
    ``rpm`` and ``tpm`` are requests and tokens a minute. ``typical_output_tokens`` and
    ``typical_latency_s`` are for estimates only. A reply longer than ``max_reply_mb`` (unpacked) is
    refused. ``batch`` is the batch mode: the ``provider``'s, ``none``, or the terms of another
    server with this wire format.
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
        """Table and file of the entry, for messages: ``[o3] in models.toml``."""
        return self._place

    def with_place(self, place: str) -> Self:
        """Return a copy with another ``place``."""
        copied = self.model_copy()
        copied._place = one_line(place)
        return copied

    @property
    def key_envs(self) -> tuple[str, ...]:
        """Environment variables of the key, by precedence; raises UsageError."""
        return (self.key_env,) if self.key_env else PROVIDERS.require(self.provider).key_envs


@dataclass(frozen=True, slots=True)
class Provider:
    """Provider: base URL, environment variables and authentication.

    ``auth`` is ``bearer`` or the header of the key. ``error_members`` are the members that every
    error of the provider has, by its documentation: an error without them may be a gateway's.
    ``parameters`` are accepted in addition to those of the wire format. ``batch`` are the terms of
    the batch mode. ``model_env`` is the variable with the model id of an UNNAMED entry; such a
    provider also lists its models at ``/models``. ``if_nobody`` is the advice for a refused
    connection.
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
        # Of vLLM, llama.cpp and Ollama; a server ignores unknown ones.
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
    """Destination of one model's calls.

    ``identity`` is a part of every cache key: the provider's name at its default URL, ``emulator``
    for our own server, otherwise the normalised base URL. ``auth_headers`` hold the secret and are
    neither hashed nor stored. ``place`` is that of the entry.
    """

    provider: str
    identity: str
    base_url: str
    auth_headers: Mapping[str, str] = field(repr=False)
    place: str = "models.toml"


def resolve_endpoint(name: str, entry: ModelEntry, env: Mapping[str, str] = os.environ) -> Endpoint:
    """Return the endpoint of a model, from its entry and the environment.

    Raises UsageError for a missing key, and for a key that no header can hold.
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
    """Return the model id to send, from the entry or the environment; None: ask the server."""
    variable = PROVIDERS.require(entry.provider).model_env
    if variable is None or entry.id != UNNAMED:
        return entry.id
    return env.get(variable) or None


def endpoint_identity(entry: ModelEntry, env: Mapping[str, str] = os.environ) -> str:
    """Return the endpoint's identity in cache keys (``Endpoint.identity``)."""
    provider = PROVIDERS.require(entry.provider)
    base_url = endpoint_url(entry, env)
    if entry.provider == "emulator":
        return "emulator"
    return entry.provider if base_url == normalised_url(provider.base_url) else base_url


def driver_name(model: str, endpoint: str | None) -> str:
    """Return a driver's name, with its endpoint unless that is the provider's own.

    The macro of this name in schema.sql is equal.
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
    """Return the driver of each side by a value of ``--model``: a name, or ``LEFT+RIGHT``."""
    left, _, right = model.partition("+")
    return {"left": left, "right": right or left}


def ego_side(sides: Mapping[Side, str], asking: Container[str], opponent: str = "") -> Side:
    """Return the side of the ego: the focal driver, whose odds ratio is reported, named first.

    The ego is the driver that is not the study's opponent; else a language model before a program
    (``asking`` has the models), else the first in the alphabet. For two equal drivers it is the
    left one. The view ``trial_drivers`` is equal.
    """
    left, right = sides["left"], sides["right"]
    if left == right or opponent in (left, right):
        return "right" if opponent == left != right else "left"
    if (left in asking) != (right in asking):
        return "left" if left in asking else "right"
    return "left" if left < right else "right"


def pair_name(pair: Iterable[str], endpoints: Mapping[str, str]) -> str:
    """Return the name of a pair, the ego first, as ``trial_drivers`` without the sample set."""
    ego, other = (driver_name(model, endpoints.get(model)) for model in pair)
    return ego if ego == other else f"{ego}+{other}"


def key_status(
    entry: ModelEntry, env: Mapping[str, str] = os.environ
) -> Literal["set", "missing", "not needed"]:
    """Return whether the environment holds the key of a live run of the model."""
    if not PROVIDERS.require(entry.provider).key_needed:
        return "not needed"
    return "set" if any(map(env.get, entry.key_envs)) else "missing"


def normalised_url(url: str, named: str = "base_url") -> str:
    """Return a normalised base URL: lower-case scheme and host, no default port, no last slash.

    Raises UsageError with the name of the setting (``named``) and without the URL, since a key may
    have been pasted there.
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
    """Return the parts of an HTTP URL, or None for a URL without a possible host."""
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


def base_urls(entries: Mapping[str, ModelEntry]) -> dict[str, str]:
    """Return the environment variables that set base URLs of the entries' providers."""
    variables = {PROVIDERS.require(entry.provider).base_url_env for entry in entries.values()}
    return {v: os.environ[v] for v in variables if v and os.environ.get(v)}


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
    """Return the folders of studies: that of the working directory, then the shipped one."""
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
