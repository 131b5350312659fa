"""Reasons why an endpoint answers no call of a run, with what a user can do about each."""

from __future__ import annotations

import re
from urllib.parse import urlsplit

from merge_runner.llm.formats.wire import as_dict, as_text, at, is_error
from merge_runner.llm.http_outcome import AttemptOutcome
from merge_runner.providers import PROVIDERS, ModelEntry

# Statuses that reject the request itself.
REQUEST_ITSELF = (200, 400, 413, 422, 429)
REASONS = {
    "bad_certificate": "the endpoint's certificate cannot be trusted, and nothing was sent; check "
    "the base URL, or set SSL_CERT_FILE to the certificates of whoever signed it",
    "not_allowed": "the endpoint does not accept the key; set {key} to a valid one",
    "unknown_model": "the endpoint has no model {id!r}; see `merge-runner models`, or {base_url}",
    "path_twice": "the base URL ends as the path begins (such as with /v1), so that this part is "
    "there twice: {base_url}",
    "proxy_refused": "the proxy (HTTPS_PROXY, HTTP_PROXY or ALL_PROXY) lets nothing through, and "
    "nothing was sent: give its URL a user name and a password if it asks for them (407), have it "
    "allow the host, or name the host in NO_PROXY",
    "request": "the request is refused: look at {place}",
    "other_format": "what answers there does not speak {format}: {base_url}",
    "other_error": "the endpoint sends an error in place of a reply: {base_url}",
    "stream": "the endpoint sends a stream of events (SSE), though none is asked for: switch "
    "streaming off at the server or at the gateway before it, take `stream` out of `parameters` of "
    "{place}, or {base_url}",
    "page": "what answers there is a web page and does not speak {format}: {base_url}",
    "packed": "the body has a Content-Encoding ({encoding}) that cannot be read: have the server, "
    "or the gateway before it, send it plain or as gzip",
    "unreadable_reply": "what answers there cannot be read: have the server, or the gateway before "
    "it, send headers of at most 64 KiB and a body that is plain or gzip",
    "reasoning_alone": "the whole reply lies in `reasoning_content`, and the content is empty: "
    "start the server without its reasoning parser (vLLM, SGLang: leave --reasoning-parser out; "
    "llama.cpp: --reasoning-format none), or let the model think, as `chat_template_kwargs = "
    "{{ enable_thinking = true }}` among `parameters` of {place} does",
}
# A transient fault may look like these: only if they come again is the configuration wrong.
UNSURE = frozenset({"other_error", "text", "unreadable_reply", "proxy_refused"})
# A repeated part of a path, as in /v1/v1/messages.
_TWICE = re.compile(r"(/\w.*)\1(/|$)")


def reason_of(outcome: AttemptOutcome, url: str) -> str | None:
    """Return the reason, of REASONS or UNSURE, why all calls to ``url`` would fail like this one.

    None: others may succeed.
    """
    raw, name = outcome.raw, outcome.name
    if outcome.action == "rejected":
        is_twice = name == "unknown_model" and _TWICE.search(urlsplit(url).path)
        return "path_twice" if is_twice else name
    if raw is None or name == "bad_prompt":
        return outcome.reason
    if name == "bad_body":
        return raw.kind
    if outcome.action == "fail":
        return "request" if raw.status in REQUEST_ITSELF else "other_format"
    reports_error = is_error(as_dict(raw.payload).get("error"))
    if outcome.action == "retry" and raw.status == 200 and reports_error and not raw.error.names:
        return "other_error"
    message = as_dict(at(raw.payload, "choices.0.message"))
    # Thoughts within the text are the model's, not the server's, doing.
    is_apart = message and not as_text(message.get("content"))
    is_alone = name == "empty" and is_apart and outcome.reading.reasoning.strip()
    return "reasoning_alone" if is_alone else None


def why_rejected(reason: str, entry: ModelEntry, outcome: AttemptOutcome) -> str:
    """Return the text of a reason, with what to set and what the server sent."""
    raw = outcome.raw
    why = REASONS["other_format" if reason == "text" else reason].format(
        place=entry.place,
        key=" or ".join(entry.key_envs) or f"`key_env` of {entry.place}",
        id=entry.id,
        format=entry.format,
        encoding=raw and raw.headers.get("content-encoding"),
        base_url=set_base_url(entry),
    )
    return f"{why} ({outcome.message or (raw and raw.excerpt)})"


def if_nobody(entry: ModelEntry) -> str:
    """Return the hint for a server that does not answer."""
    what = PROVIDERS[entry.provider].if_nobody
    return f"{what}, or {set_base_url(entry)}; then run the same command again"


def set_base_url(entry: ModelEntry) -> str:
    """Return the hint to correct the base URL of an entry."""
    provider = PROVIDERS[entry.provider]
    if entry.base_url is not None or provider.base_url_env is None:
        return f"correct `base_url` of {entry.place}"
    path = urlsplit(provider.base_url).path
    ending = f" (with {path} at its end)" if path else ""
    return f"set {provider.base_url_env} to the base URL of the service{ending}, or unset it"
