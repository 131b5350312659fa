"""State of an endpoint in a run, and the error that follows from an attempt there.

Among them are the reasons why it answers no call of a run, with what a user can do about each.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from merge_runner.driver_names import driver_name
from merge_runner.errors import EndpointRefused, MergeRunnerError, ProviderDown, QuotaExhausted
from merge_runner.llm.call import Call
from merge_runner.llm.delays import TryAgain, utc_after
from merge_runner.llm.formats.wire import WireFormat, as_dict, as_text, at, is_error
from merge_runner.llm.http_outcome import AttemptOutcome
from merge_runner.llm.prices import underpriced_tiers
from merge_runner.providers import PROVIDERS, ModelEntry
from merge_runner.records import CallFailed

# How long a first call waits for a server that refuses connections.
NOBODY_S = 5.0
# For formats that know empty answers as a transient fault of their service.
MAX_EMPTY_RETRIES = 2
# So many rejections by an endpoint that has answered before mean a wrong configuration.
MAX_REJECTIONS = 3
# Part of the name of Gemini's daily quotas, whose delay is meaningless.
GEMINI_DAY = "PerDay"
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


@dataclass(slots=True)
class EndpointState:
    """A model at its endpoint, whose ``identity`` enters the keys of calls.

    It is ``verified`` by the first accepted reply of a run, and ``has_answered`` in this run or an
    earlier one. ``rejections`` counts attempts whose error points at the configuration;
    MAX_REJECTIONS of them end the run.
    """

    name: str
    entry: ModelEntry
    identity: str
    wire: WireFormat
    verified: bool = True
    has_answered: bool = False
    rejections: int = 0
    driver: str = field(init=False)
    underpriced_tiers: set[str] = field(init=False)

    def __post_init__(self) -> None:
        self.driver = driver_name(self.name, self.identity)
        self.underpriced_tiers = underpriced_tiers(self.entry)

    def error_of(self, call: Call, outcome: AttemptOutcome) -> MergeRunnerError | None:
        """Return the error that follows from a call's last attempt, None if it is an answer.

        It also notes what the attempt tells about the endpoint.
        """
        driver, message = self.driver, outcome.message or outcome.name
        if outcome.action == "rejected" or not self.verified:
            reason = reason_of(outcome, self.identity + call.request.path)
            self.rejections += reason is not None
            # An endpoint that has answered before may refuse this prompt alone.
            sure = not (self.has_answered or reason in UNSURE) or self.rejections >= MAX_REJECTIONS
            if reason is not None and (sure or outcome.action == "rejected"):
                why = why_rejected(reason, self.entry, outcome)
                return EndpointRefused(f"{driver}: {why}")
        # A server may just be starting: it is waited for, but only for seconds.
        is_late = self.entry.deadline_s - call.left_s >= NOBODY_S
        if outcome.name == "no_connection" and not self.verified and is_late:
            return ProviderDown(f"{driver}: {message}: {if_nobody(self.entry)}")
        if closed := self._why_closed(outcome):
            return QuotaExhausted(f"{driver}: {closed}")
        if outcome.action == "retry":
            return TryAgain(message, outcome.delay_s)
        if outcome.action == "fail":
            return self.failed(call, "nothing that is asked again would help")
        self.verified = self.has_answered = True
        if outcome.name == "empty" and self.wire.retries_empty and call.empty <= MAX_EMPTY_RETRIES:
            return TryAgain("empty reply")
        return None

    def _why_closed(self, outcome: AttemptOutcome) -> str:
        """Return the reason why the account is closed, and until when; empty if it is open."""
        delay_s, closed = outcome.delay_s or 0.0, ""
        if outcome.action == "quota":
            closed = "the account's quota is exhausted"
        elif outcome.pause and delay_s > self.entry.deadline_s:
            closed = f"the provider asks to wait {delay_s:.0f} s, longer than a call's deadline"
        if not closed:
            return ""
        later = "run the same command later to go on"
        if outcome.delay_s is not None:
            later = f"it opens again at {utc_after(delay_s)}: run the same command then"
        elif outcome.raw and GEMINI_DAY in outcome.raw.body:
            later = "it opens again at midnight Pacific time: run the same command then"
        return f"{closed} ({outcome.message or outcome.name}): {later}"

    def out_of_time(self, call: Call, delay_s: float) -> MergeRunnerError:
        """Return the error of a call whose deadline would pass before the next attempt."""
        why = f"no reply within {self.entry.deadline_s:.0f} s"
        if delay_s >= self.entry.deadline_s:
            why = (
                f"the server asks to wait {delay_s:.0f} s, longer than a call's deadline of "
                f"{self.entry.deadline_s:.0f} s: run the same command again after that"
            )
        if self.verified:
            return self.failed(call, why)
        return ProviderDown(
            f"{self.driver}: the first call of this run: {why} ({call.last_failure}): run the same "
            "command when the service answers again"
        )

    def failed(self, call: Call, why: str) -> CallFailed:
        """Return the error of a call that ends without an answer."""
        why = f"{self.name}: {why} ({call.last_failure}), {len(call.own_attempts)} attempts"
        return CallFailed(why, call.request, tuple(call.attempts), call.earlier_attempts)


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
