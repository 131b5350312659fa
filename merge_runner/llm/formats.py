"""The wire formats: how a prompt becomes a request body, and a reply's body an answer.

Those of OpenAI and the many servers that speak them, and two more. A package can add others.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

from pydantic import JsonValue

from merge_runner.llm.reasoning import split_reasoning
from merge_runner.providers import ModelEntry
from merge_runner.records import Usage
from merge_runner.registry import Registry

MOST_TOKENS = 2**31 - 1
# How an error names an exhausted quota: at OpenAI, LiteLLM (the eighth), Anthropic, Moonshot and
# MiniMax.
QUOTA = {
    *("insufficient_quota", "billing_hard_limit_reached", "credit_balance_exhausted"),
    *("organization_spend_limit_exceeded", "project_spend_limit_exceeded"),
    *("organization_usage_limit_exceeded", "billing_not_active", "budget_exceeded"),
    *("enforced_spend_limit_reached", "contract_spend_limit_reached"),
    *("exceeded_current_quota_error", "base_resp 1008"),
}
# The words of one that is named otherwise. Anthropic reports the first three as invalid requests;
# the last one is OpenRouter's limit of a key.
SPENT = re.compile(
    "credit balance is too low|spend limit|reached your specified API usage limits"
    "|insufficient (account |user )?balance|balance is (insufficient|not enough)"
    "|check your billing details on our website|key limit exceeded",
    re.IGNORECASE,
)
# A limit of a day, as OpenAI, Groq and OpenRouter name it.
PER_DAY = re.compile(r"per[-_ ]?day\b|\b[rt]pd\b|\bdaily\b", re.IGNORECASE)
# An error that also names one of these may list all limits, and be of a shorter one.
SHORTER = re.compile(r"per[-_ ]?(min|sec|hour)|\b[rt]pm\b", re.IGNORECASE)
# What ends an answer of Gemini that was refused.
REFUSALS = (
    *("SAFETY", "RECITATION", "LANGUAGE", "OTHER", "BLOCKLIST", "PROHIBITED_CONTENT", "SPII"),
    "MODEL_ARMOR",
)
# What ends a reply of a chat server that passes on another API's word: Gemini's in capitals,
# Anthropic's, Mistral's (model_length), Zhipu's (sensitive).
CHAT_TRUNCATED = {
    *("length", "MAX_TOKENS", "max_tokens", "max_output_tokens", "model_length"),
    "model_context_window_exceeded",
}
CHAT_REFUSED = {*REFUSALS, "content_filter", "refusal", "sensitive"}
# The server broke the reply off, and what came of it is no answer of the model: vLLM and SGLang
# (abort), Zhipu (network_error), DeepSeek, and routers (error).
BROKEN_OFF = {"abort", "error", "network_error", "insufficient_system_resource"}
# A protobuf Duration as JSON.
DURATION = re.compile(r"(\d+(?:\.\d+)?)s")


@dataclass(frozen=True, slots=True)
class WireRequest:
    """A request without its secret: ``headers`` are those that change its meaning."""

    path: str
    body: dict[str, JsonValue]
    headers: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Reading:
    """What a JSON body of status 200 says.

    ``outcome`` is ``ok``, ``refusal``, ``truncated``, ``empty``, or ``error`` where the body
    reports a failure after all. ``finish_reason`` is the provider's own word, and so is
    ``service_tier``, at which the reply is billed. ``reasoning`` is what stands apart from the text
    of the answer.
    """

    outcome: str
    text: str = ""
    finish_reason: str | None = None
    model_served: str | None = None
    usage: Usage = field(default_factory=Usage)
    reasoning: str = ""
    service_tier: str | None = None


@dataclass(frozen=True, slots=True)
class ServerError:
    """An error in one shape: servers send nested, flat, listed and string errors.

    ``status`` is that of the reply, or the one that an error within a 200 stands for. ``names``
    are its type, its code, its status in words and the reasons among its ``details``.
    """

    status: int
    headers: Mapping[str, str]
    body: str
    message: str
    names: frozenset[str]
    details: tuple[dict[str, Any], ...]


class WireFormat(ABC):
    """One format of requests and replies, with all that is particular to it.

    None leaves a question about an error to what is known of all servers: gateways pass on the
    errors of others, whatever format they speak themselves.
    """

    parameters: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """Parameters that a study may vary, by common names: where each stands in an entry's own."""
    members: ClassVar[frozenset[str]]
    """Members of a body: an answer has at least one of them, whatever it says."""
    headers: ClassVar[Mapping[str, str]] = {}
    """Headers that every request to a batch mode has, since they change its meaning."""
    retries_empty: ClassVar[bool] = False
    """Whether an empty answer is a known fault of the service that asking again may mend."""

    @abstractmethod
    def request(self, entry: ModelEntry, prompt: str) -> WireRequest:
        """Return the request for a prompt."""

    @abstractmethod
    def read(self, payload: dict[str, Any]) -> Reading:
        """Read a body of status 200; unknown keys and missing ones are normal.

        Reasoning that stands within the text stays there: see ``read_reply``.
        """

    def meaning(self, error: ServerError) -> str | None:
        """Return the meaning of an error whose status does not tell it.

        As in the table of calls: ``refusal``, ``quota_exhausted``, ``unknown_model``,
        ``not_allowed``, ``rate_limited``, ``request_too_large``, or ``bad_prompt``, which speaks
        of one prompt alone.
        """
        return None

    def delay_s(self, error: ServerError) -> float | None:
        """Return the delay in s in a member of the error; its words are read for every format."""
        return None


def read_reply(wire: WireFormat, payload: dict[str, Any]) -> Reading:
    """Read a body of status 200; of its text the answer is kept apart from the reasoning."""
    reading = wire.read(payload)
    if reading.outcome not in {"ok", "truncated", "empty"}:
        return reading
    thoughts, answer, cut = split_reasoning(reading.text)
    if not thoughts and answer == reading.text:
        return reading
    return replace(
        reading,
        outcome=outcome_of(answer, truncated=cut or reading.outcome == "truncated"),
        text=answer,
        reasoning=reading.reasoning + thoughts,
    )


def reasoning_of(payload: dict[str, Any]) -> str:
    """Return the reasoning in a body of any format that is known."""
    readings = (read_reply(w, payload) for w in FORMATS.values() if w.members & payload.keys())
    return next((reading.reasoning for reading in readings if reading.reasoning), "")


def outcome_of(
    text: str, *, failed: object = False, truncated: bool = False, refused: bool = False
) -> str:
    """Return the outcome of an answer, from its text and what its finish reason means.

    ``failed`` is what the body reports as an error, where it does.
    """
    if failed or refused:
        return "error" if failed else "refusal"
    if truncated:
        return "truncated"
    return "ok" if text.strip() else "empty"


def at(value: object, path: str) -> Any:  # noqa: ANN401 # whatever JSON holds there
    """Return the JSON at a path such as ``choices.0.message``, None where there is none."""
    for name in path.split("."):
        if isinstance(value, dict):
            value = value.get(name)
        elif isinstance(value, list) and value and name == "0":
            value = value[0]
        else:
            return None
    return value


def as_dict(value: object) -> dict[str, Any]:
    """Return a JSON object, or an empty one for anything else."""
    return value if isinstance(value, dict) else {}


def as_dicts(value: object) -> list[dict[str, Any]]:
    """Return the objects of a JSON array; anything else counts as an empty one."""
    return [as_dict(item) for item in value] if isinstance(value, list) else []


def as_text(value: object) -> str | None:
    """Return a JSON string, or None for anything else.

    JSON can spell half of a surrogate pair, which no file can hold: a "?" takes its place.
    """
    if not isinstance(value, str):
        return None
    return value if value.isascii() else value.encode(errors="replace").decode()


def as_count(value: object) -> int | None:
    """Return a token count, or None for what cannot be one; some servers write 9.0."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return value if type(value) is int and 0 <= value <= MOST_TOKENS else None


def is_error(value: object) -> bool:
    """Return whether a member reports an error; some services add an empty one to good answers."""
    return any(value.values()) if isinstance(value, dict) else bool(value)


def joined(parts: Iterable[dict[str, Any]], member: str = "text") -> str:
    """Return the text of all parts of an answer that have some."""
    return "".join(as_text(part.get(member)) or "" for part in parts)


def read_error(status: int, headers: Mapping[str, str], body: str, payload: object) -> ServerError:
    """Read an error body of any known shape; one that is no JSON is its own message."""
    top = as_dict(payload)
    nested = top.get("error") if top.get("error") is not None else at(top, "choices.0.error")
    error = as_dict(nested) or ({"message": nested} if isinstance(nested, str) else top)
    details = as_dicts(error.get("details")) or [as_dict(error.get("details"))]
    names = [error.get(name) for name in ("type", "code", "status")]
    names += [detail.get(name) for detail in details for name in ("error_code", "reason")]
    known = {str(name) for name in names if name is not None}
    minimax = as_dict(top.get("base_resp"))
    known |= {f"base_resp {code}" for code in [minimax.get("status_code")] if code}
    words = as_text(error.get("message")) or as_text(minimax.get("status_msg")) or body[:200]
    # It reaches a user as one line; Gemini's has several.
    message = " ".join(words.split()) or "no reason is given"
    passed_on = as_dict(as_dict(error.get("metadata")).get("headers"))  # by OpenRouter
    all_headers = {**{name.lower(): str(value) for name, value in passed_on.items()}, **headers}
    return ServerError(status, all_headers, body, message, frozenset(known), tuple(details))


def is_per_day(error: ServerError) -> bool:
    """Return whether an error speaks of a limit of a day alone, as Gemini's words do not."""
    words = " ".join((error.message, *error.names))
    return bool(error.status == 429 and PER_DAY.search(words) and not SHORTER.search(words))


def known_meaning(error: ServerError) -> str | None:
    """Return what an error of one of the four services means; see ``WireFormat.meaning``.

    What an added format knows is its own alone: it must not change how others are read.
    """
    names, words = error.names, error.message
    violations = [v for detail in error.details for v in as_dicts(detail.get("violations"))]
    per_day = any("PerDay" in str(violation.get("quotaId")) for violation in violations)
    in_flight = "openrouter_in_flight_budget" in error.body and "retry-after" in error.headers
    cases = (
        # Azure's content filter, and OpenRouter's moderation.
        (400, "content_filter" in names, "refusal"),
        (403, "flagged_input" in error.body, "refusal"),
        (400, "invalid_prompt" in names, "bad_prompt"),  # first, since it may quote the prompt
        # OpenRouter's want of credit while other requests run: it passes when they end.
        (402, in_flight, "rate_limited"),
        (error.status, bool(names & QUOTA), "quota_exhausted"),
        *((each, SPENT.search(words), "quota_exhausted") for each in (400, 403, 429)),
        # Gemini's quota per day has the words of one per minute, and does not pass.
        (429, per_day or is_per_day(error), "quota_exhausted"),
        *((each, "model_not_found" in names, "unknown_model") for each in (400, 401, 403, 404)),
        (429, words.startswith("Request too large"), "request_too_large"),
        (400, "API_KEY_INVALID" in names, "not_allowed"),
    )
    told = (meaning for status, is_so, meaning in cases if is_so and status == error.status)
    return next(told, None)


def known_delay_s(error: ServerError) -> float | None:
    """Return the delay in s in Gemini's RetryInfo, which is one of the details."""
    delays = (as_text(detail.get("retryDelay")) or "" for detail in error.details)
    return next((float(found[1]) for d in delays if (found := DURATION.fullmatch(d))), None)


def usage_of(counts: object, *, total: str = "", **places: str) -> Usage:
    """Return the tokens that stand in ``counts`` at these places; of several the sum.

    Some servers (xAI, gateways) leave the reasoning out of the output: it is at least what the
    ``total`` has beside the input, and where it is less than the reasoning alone both are added.
    """
    sums = dict[str, int]()
    for name, paths in places.items():
        for path in paths.split():
            count = as_count(at(counts, path))
            if count is not None:
                sums[name] = sums.get(name, 0) + count
    read, written = sums.get("input_tokens"), sums.get("output_tokens")
    reasoned = sums.get("reasoning_tokens", 0)
    if written is not None and reasoned > written:
        written = min(written + reasoned, MOST_TOKENS)
    in_all = as_count(at(counts, total)) if total else None
    if in_all is not None and read is not None and in_all > read:
        written = max(written or 0, in_all - read)
    return Usage(**sums | {"output_tokens": written})


def plain(*names: str) -> dict[str, tuple[str, ...]]:
    """Return parameters that stand at the top, under their common names."""
    return {name: (name,) for name in names}


class OpenAIChat(WireFormat):
    """``POST /chat/completions``; the path can be overridden, as Azure's classic form needs."""

    parameters = plain(
        *("temperature", "top_p", "seed", "presence_penalty", "frequency_penalty"),
        *("reasoning_effort", "verbosity", "response_format"),
    )
    members = frozenset({"choices"})

    def request(self, entry: ModelEntry, prompt: str) -> WireRequest:
        """Return one user message; the cap covers reasoning and visible tokens."""
        return WireRequest(
            path=entry.path or "/chat/completions",
            body={
                "model": entry.id,
                "messages": [{"role": "user", "content": prompt}],
                entry.cap_field: entry.max_output_tokens,
                **entry.parameters,
            },
        )

    def read(self, payload: dict[str, Any]) -> Reading:
        """Read the first choice."""
        choice = as_dict(at(payload, "choices.0"))
        message = as_dict(choice.get("message"))
        content = message.get("content")
        parts = as_dicts(content)  # at some servers
        text = content if isinstance(content, str) else joined(parts)
        # Mistral's parts hold parts; OpenRouter and vLLM send the same words in both members.
        thoughts = [message.get("reasoning_content"), message.get("reasoning")]
        thoughts += [joined(as_dicts(part.get("thinking"))) for part in parts]
        refusal = as_text(message.get("refusal"))
        finish = as_text(choice.get("finish_reason"))
        # Routers answer 200 and put the failure of a generation into the body.
        failed = is_error(payload.get("error")) or is_error(choice.get("error"))
        return Reading(
            outcome_of(
                text,
                failed=failed or finish in BROKEN_OFF,
                truncated=finish in CHAT_TRUNCATED,
                refused=finish in CHAT_REFUSED or bool(refusal),
            ),
            text or refusal or "",
            finish,
            as_text(payload.get("model")),
            usage_of(
                payload.get("usage"),
                input_tokens="prompt_tokens",
                cached_input_tokens="prompt_tokens_details.cached_tokens",
                output_tokens="completion_tokens",
                reasoning_tokens="completion_tokens_details.reasoning_tokens",
                total="total_tokens",
            ),
            reasoning="".join(dict.fromkeys(filter(None, map(as_text, thoughts)))),
            service_tier=as_text(payload.get("service_tier")),
        )


class OpenAIResponses(WireFormat):
    """``POST /responses``, not stored at the provider."""

    parameters: ClassVar = {
        **plain("temperature", "top_p"),
        "reasoning_effort": ("reasoning", "effort"),
        "verbosity": ("text", "verbosity"),
    }
    members = frozenset({"output", "status"})

    def request(self, entry: ModelEntry, prompt: str) -> WireRequest:
        """Return the prompt as the whole input; the cap covers reasoning and visible tokens."""
        return WireRequest(
            path=entry.path or "/responses",
            body={
                "model": entry.id,
                "input": prompt,
                "max_output_tokens": entry.max_output_tokens,
                "store": False,
                **entry.parameters,
            },
        )

    def read(self, payload: dict[str, Any]) -> Reading:
        """Join the text parts of all messages; a failed response arrives with status 200.

        A commentary beside the final message is reasoning.
        """
        items = as_dicts(payload.get("output"))
        messages = [item for item in items if item.get("type") == "message"]
        final = [item for item in messages if item.get("phase") != "commentary"]
        beside = [item for item in messages if item.get("phase") == "commentary"] if final else []
        parts = [part for item in final or messages for part in as_dicts(item.get("content"))]
        text = joined(part for part in parts if part.get("type") == "output_text")
        reasoned = [item for item in items if item.get("type") == "reasoning"] + beside
        members = (item.get(name) for item in reasoned for name in ("summary", "content"))
        thoughts = [joined(as_dicts(member)) for member in members]
        refusal = joined((part for part in parts if part.get("type") == "refusal"), "refusal")
        status = as_text(payload.get("status"))
        reason = as_text(at(payload, "incomplete_details.reason"))
        return Reading(
            outcome_of(
                text,
                failed=status == "failed" or is_error(payload.get("error")),
                truncated=status == "incomplete" or reason == "max_output_tokens",
                refused=reason == "content_filter" or bool(refusal),
            ),
            text or refusal,
            reason or status,
            as_text(payload.get("model")),
            usage_of(
                payload.get("usage"),
                input_tokens="input_tokens",
                cached_input_tokens="input_tokens_details.cached_tokens",
                output_tokens="output_tokens",
                reasoning_tokens="output_tokens_details.reasoning_tokens",
                total="total_tokens",
            ),
            reasoning="\n\n".join(filter(None, thoughts)),
            service_tier=as_text(payload.get("service_tier")),
        )


class GeminiGenerateContent(WireFormat):
    """``POST /v1beta/models/MODEL:generateContent``: the model is in the path alone.

    The parameters are members of ``generationConfig``.
    """

    parameters: ClassVar = {
        **plain("temperature", "seed", "responseMimeType", "responseSchema"),
        "top_p": ("topP",),
        "top_k": ("topK",),
        "thinking_budget": ("thinkingConfig", "thinkingBudget"),
        "thinking_level": ("thinkingConfig", "thinkingLevel"),
    }
    # A STOP without content is a known intermittent fault of Gemini 2.5 Pro.
    retries_empty = True
    members = frozenset({"candidates", "promptFeedback", "usageMetadata"})

    def request(self, entry: ModelEntry, prompt: str) -> WireRequest:
        """Return one user turn; the cap covers thoughts and visible tokens."""
        config = {"maxOutputTokens": entry.max_output_tokens, **entry.parameters}
        return WireRequest(
            path=entry.path or f"/v1beta/models/{entry.id}:generateContent",
            body={
                "contents": [{"role": "user", "parts": [{"text": prompt}]}],
                "generationConfig": config,
            },
        )

    def read(self, payload: dict[str, Any]) -> Reading:
        """Join the parts of the first candidate that are no thoughts."""
        parts = as_dicts(at(payload, "candidates.0.content.parts"))
        text = joined(part for part in parts if not part.get("thought"))
        finish = as_text(at(payload, "candidates.0.finishReason"))
        blocked = as_text(at(payload, "promptFeedback.blockReason"))
        return Reading(
            outcome_of(
                text,
                failed=is_error(payload.get("error")),
                truncated=finish == "MAX_TOKENS",
                refused=bool(blocked) or finish in REFUSALS,
            ),
            text,
            finish or blocked,
            as_text(payload.get("modelVersion")),
            usage_of(
                payload.get("usageMetadata"),
                input_tokens="promptTokenCount",
                cached_input_tokens="cachedContentTokenCount",
                output_tokens="candidatesTokenCount thoughtsTokenCount",
                reasoning_tokens="thoughtsTokenCount",
                total="totalTokenCount",
            ),
            reasoning=joined(part for part in parts if part.get("thought")),
            service_tier=(as_text(at(payload, "usageMetadata.serviceTier")) or "").lower() or None,
        )


class AnthropicMessages(WireFormat):
    """``POST /v1/messages`` with the API version as a header."""

    parameters: ClassVar = {
        **plain("temperature", "top_p", "top_k", "thinking"),
        "reasoning_effort": ("output_config", "effort"),
    }
    members = frozenset({"content", "stop_reason"})
    # The version whose sampling default is temperature 1.0; later ones reject the parameter.
    headers: ClassVar = {"anthropic-version": "2023-06-01"}

    def request(self, entry: ModelEntry, prompt: str) -> WireRequest:
        """Return one user message; ``max_tokens`` is required."""
        return WireRequest(
            path=entry.path or "/v1/messages",
            body={
                "model": entry.id,
                "max_tokens": entry.max_output_tokens,
                "messages": [{"role": "user", "content": prompt}],
                **entry.parameters,
            },
            headers=dict(self.headers),
        )

    def read(self, payload: dict[str, Any]) -> Reading:
        """Join the text blocks; thinking blocks are the reasoning."""
        blocks = as_dicts(payload.get("content"))
        text = joined(block for block in blocks if block.get("type") == "text")
        finish = as_text(payload.get("stop_reason"))
        cap = ("max_tokens", "model_context_window_exceeded")
        return Reading(
            outcome_of(
                text,
                failed=payload.get("type") == "error",
                truncated=finish in cap,
                refused=finish == "refusal",
            ),
            text,
            finish,
            as_text(payload.get("model")),
            usage_of(
                payload.get("usage"),
                # Anthropic counts cached tokens apart; here the input includes them.
                input_tokens="input_tokens cache_read_input_tokens cache_creation_input_tokens",
                cached_input_tokens="cache_read_input_tokens",
                output_tokens="output_tokens",
                reasoning_tokens="output_tokens_details.thinking_tokens",
            ),
            reasoning=joined(blocks, "thinking"),
        )


FORMATS: Registry[WireFormat] = Registry("wire format")
for _name, _format in {
    "openai-chat": OpenAIChat(),
    "openai-responses": OpenAIResponses(),
    "gemini": GeminiGenerateContent(),
    "anthropic": AnthropicMessages(),
}.items():
    FORMATS.register(_name, _format)
