"""What all wire formats share, and chat completions, the one that most servers speak."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import JsonValue

from merge_runner.config import ModelEntry
from merge_runner.llm.reasoning import split_reasoning
from merge_runner.records import Usage

if TYPE_CHECKING:
    from merge_runner.llm.formats.server_error import ServerError

MOST_TOKENS = 2**31 - 1
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
