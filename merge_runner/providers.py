"""Providers, the entries of models.toml, and the endpoints of calls."""

from __future__ import annotations

import ipaddress
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import date
from functools import partial
from typing import Annotated, Literal, Self
from urllib.parse import SplitResult, urlsplit

from pydantic import Field, JsonValue, PrivateAttr

from merge_runner.config import Count, Frozen, NotNegative, Positive
from merge_runner.errors import UsageError
from merge_runner.planted_effect import PARAMETERS as PLANTED
from merge_runner.registry import Registry
from merge_runner.text_safety import one_line

LOOPBACK = ("127.0.0.1", "localhost", "::1")
# A shorter key is a dummy that may occur in any text.
SHORTEST_SECRET = 8
UNNAMED = "default"


class Price(Frozen):
    """Price in USD per million tokens, with its source.

    ``tiers`` are factors by the ``service_tier`` in a reply.
    """

    input: NotNegative
    cached_input: NotNegative | None = None
    output: NotNegative
    tiers: dict[str, Positive] = Field(default_factory=dict)
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
    parameters: dict[str, JsonValue] = Field(default_factory=dict)
    applied_defaults: dict[str, JsonValue] = Field(default_factory=dict)
    rejects: tuple[str, ...] = ()
    efforts: dict[str, dict[str, JsonValue]] = Field(default_factory=dict)
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
    ``parameters`` are accepted besides the wire format's parameters. ``batch`` are the terms of
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
    neither hashed nor stored. ``place`` says where the entry stands.
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
            f"{name} needs a key: set {variables}. Without one, `--model emulator` rehearses the "
            "study, and `merge-runner replay FILE.parquet` replays a recording."
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
    if entry.provider == "emulator" and entry.base_url:
        raise UsageError(f"the emulator takes no `base_url`: set {variable}")
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
            f"{named} is no base URL: it must begin with http:// or https:// and name a possible "
            "host, without spaces, a user name, a password or a part after ? or # (write "
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


def base_urls(entries: Mapping[str, ModelEntry]) -> dict[str, str]:
    """Return the environment variables that set base URLs of the entries' providers."""
    variables = {PROVIDERS.require(entry.provider).base_url_env for entry in entries.values()}
    return {v: os.environ[v] for v in variables if v and os.environ.get(v)}


def url_origin(url: str) -> str:
    """Return the scheme, host and port of a URL in one spelling; raises UsageError."""
    parts = urlsplit(normalised_url(url))
    return f"{parts.scheme}://{parts.netloc}"
