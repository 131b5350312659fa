"""Base of all wire formats, and chat completions, which most servers speak."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from pydantic import JsonValue

from merge_runner.llm.reasoning import split_reasoning
from merge_runner.providers import ModelEntry
from merge_runner.records import Usage
from merge_runner.registry import FAULTS, fault_of

if TYPE_CHECKING:
    from merge_runner.llm.formats.server_error import ServerError

MOST_TOKENS = 2**31 - 1
# Finish reasons of Gemini for a refusal.
REFUSALS = (
    *("SAFETY", "RECITATION", "LANGUAGE", "OTHER", "BLOCKLIST", "PROHIBITED_CONTENT", "SPII"),
    "MODEL_ARMOR",
)
# Finish reasons of chat servers, some of which pass on another API's: Gemini's in capitals,
# Anthropic's, Mistral's (model_length), Zhipu's (sensitive).
CHAT_TRUNCATED = {
    *("length", "MAX_TOKENS", "max_tokens", "max_output_tokens", "model_length"),
    "model_context_window_exceeded",
}
CHAT_REFUSED = {*REFUSALS, "content_filter", "refusal", "sensitive"}
# Finish reasons of an aborted generation, which is no answer of the model: vLLM and SGLang (abort),
# Zhipu (network_error), DeepSeek, and routers (error).
BROKEN_OFF = {"abort", "error", "network_error", "insufficient_system_resource"}


@dataclass(frozen=True, slots=True)
class WireRequest:
    """A request without its key: ``headers`` are those that change its meaning."""

    path: str
    body: dict[str, JsonValue]
    headers: dict[str, str] = field(default_factory=dict)


class Reading(NamedTuple):
    """Content of a JSON body of status 200.

    ``outcome`` is ``ok``, ``refusal``, ``truncated``, ``empty``, or ``error`` where the body
    reports a failure after all. ``finish_reason`` is the provider's own word, and so is
    ``service_tier``, at which the reply is billed. ``reasoning`` is separate from the ``text`` of
    the answer.
    """

    outcome: str
    text: str = ""
    finish_reason: str | None = None
    model_served: str | None = None
    usage: Usage = Usage()
    reasoning: str = ""
    service_tier: str | None = None


class WireFormat(ABC):
    """A format of requests and replies.

    ``meaning`` and ``delay_s`` return None for errors that all formats share: a gateway of one
    format passes on errors of another.
    """

    parameters: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """Parameters that a study may vary, by common names, with their paths in a body."""
    members: ClassVar[frozenset[str]]
    """Members of which each answer has at least one."""
    headers: ClassVar[Mapping[str, str]] = {}
    """Headers of all requests to a batch mode that change their meaning."""
    retries_empty: ClassVar[bool] = False
    """True if an empty answer is a known transient fault of the service."""

    @abstractmethod
    def request(self, entry: ModelEntry, prompt: str) -> WireRequest:
        """Return the request for a prompt."""

    @abstractmethod
    def read(self, payload: dict[str, Any]) -> Reading:
        """Read a body of status 200; unknown and missing keys are normal.

        Reasoning within the text stays there: ``read_reply`` separates it.
        """

    def meaning(self, error: ServerError) -> str | None:
        """Return the meaning of an error that its status does not show.

        A name of the table of calls: ``refusal``, ``quota_exhausted``, ``unknown_model``,
        ``not_allowed``, ``rate_limited``, ``request_too_large``, or ``bad_prompt``, which concerns
        one prompt alone.
        """
        return None

    def delay_s(self, error: ServerError) -> float | None:
        """Return the delay in s in a member of the error; its message is read for every format."""
        return None


def read_reply(wire: WireFormat, payload: dict[str, Any]) -> Reading:
    """Read a body of status 200, and separate the answer in its text from the reasoning.

    Raises UsageError where a plug-in's format fails.
    """
    try:
        reading = wire.read(payload)
    except FAULTS as error:
        raise fault_of(f"the wire format {type(wire).__name__}", error) from error
    if reading.outcome not in {"ok", "truncated", "empty"}:
        return reading
    thoughts, answer, cut = split_reasoning(reading.text)
    if not thoughts and answer == reading.text:
        return reading
    return reading._replace(
        outcome=outcome_of(answer, truncated=cut or reading.outcome == "truncated"),
        text=answer,
        reasoning=reading.reasoning + thoughts,
    )


def outcome_of(
    text: str, *, failed: object = False, truncated: bool = False, refused: bool = False
) -> str:
    """Return the outcome of an answer, by its text and the meaning of its finish reason.

    ``failed`` is the error that the body reports, if any.
    """
    if failed or refused:
        return "error" if failed else "refusal"
    if truncated:
        return "truncated"
    return "ok" if text.strip() else "empty"


def at(value: object, path: str) -> Any:  # noqa: ANN401 # any JSON
    """Return the JSON at a path such as ``choices.0.message``, or None."""
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
    """Return the objects of a JSON array, or none for anything else."""
    return [as_dict(item) for item in value] if isinstance(value, list) else []


def as_text(value: object) -> str | None:
    """Return a JSON string, or None for anything else.

    JSON can spell half of a surrogate pair, which no file can hold: it becomes "?".
    """
    if not isinstance(value, str):
        return None
    return value if value.isascii() else value.encode(errors="replace").decode()


def as_count(value: object) -> int | None:
    """Return a token count, or None for an impossible one; some servers write 9.0."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return value if type(value) is int and 0 <= value <= MOST_TOKENS else None


def is_error(value: object) -> bool:
    """Return whether a member reports an error; some services add an empty one to good answers."""
    return any(value.values()) if isinstance(value, dict) else bool(value)


def joined(parts: Iterable[dict[str, Any]], member: str = "text") -> str:
    """Return the joined text of the parts of an answer."""
    return "".join(as_text(part.get(member)) or "" for part in parts)


def usage_of(counts: object, *, total: str = "", **places: str) -> Usage:
    """Return the tokens at these paths of ``counts``; several paths are summed.

    Some servers (xAI, gateways) leave the reasoning out of the output: the output is at least
    ``total`` less input, and where it is less than the reasoning alone both are added.
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
    """Return parameters at the top of a body, under their common names."""
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
