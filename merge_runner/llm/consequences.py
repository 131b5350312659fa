"""What follows from an attempt: its answer, another attempt, the end of the call or the sweep."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

from merge_runner.config import ModelEntry, driver_name, is_own_host
from merge_runner.errors import EndpointRefused, MergeRunnerError, ProviderDown, QuotaExhausted
from merge_runner.llm.call import Call
from merge_runner.llm.first_call import (
    NOBODY_S,
    FirstCall,
    if_nobody,
    refusal,
    set_base_url,
    set_key,
)
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.http_outcome import AttemptOutcome, RawReply
from merge_runner.llm.retry import RequestFailed, TryAgain, backoff_s

EMPTY_RETRIES = 2
MODELS = "`merge-runner models`"


@dataclass(frozen=True, slots=True)
class Consequences:
    """What follows from attempts at one model; see LlmClient for the fields."""

    name: str
    entry: ModelEntry
    endpoint: str
    first: FirstCall

    @property
    def driver(self) -> str:
        """The model's name, with the endpoint where that is not the provider's own."""
        return driver_name(self.name, self.endpoint)

    @property
    def own_host(self) -> str | None:
        """The provider whose own host is asked; None: another server in its format."""
        return self.entry.provider if is_own_host(self.entry.provider, self.endpoint) else None

    def error(
        self, call: Call, outcome: AttemptOutcome, raw: RawReply | None
    ) -> MergeRunnerError | None:
        """What the last attempt at a call means for it; None: it is the answer."""
        refused = self._nobody(call) if raw is None else self._wrong_endpoint(raw, outcome)
        return refused or self._error(call, outcome)

    def pause_s(self, call: Call, outcome: AttemptOutcome) -> float | None:
        """For how long all calls with the same key wait; None: they go on."""
        if not outcome.pause or self._is_long(outcome):
            return None
        return outcome.delay_s or backoff_s(len(call.own_attempts))

    def _is_long(self, outcome: AttemptOutcome) -> bool:
        return (outcome.delay_s or 0.0) > self.entry.deadline_s

    def _nobody(self, call: Call) -> MergeRunnerError | None:
        """The end of the run where nobody listens and nothing was ever answered.

        A server that is just starting is waited for, but only for seconds.
        """
        waited_s = asyncio.get_running_loop().time() - call.began_s
        refused = call.attempts[-1].outcome == "no_connection"
        if self.first.passed or not refused or waited_s < NOBODY_S:
            return None
        return ProviderDown(
            f"{self.driver}: {call.last_failure}: {if_nobody(self.name, self.entry)}"
        )

    def _wrong_endpoint(self, raw: RawReply, outcome: AttemptOutcome) -> MergeRunnerError | None:
        """The end of the run at its first call, where no other one would fare better."""
        if not self.first.passed:
            why = refusal(self.name, self.entry, raw, outcome)
            if why is not None and self.first.is_final(outcome):
                return EndpointRefused(f"{self.driver}: {why}")
        if outcome.action == "accept":
            self.first.answered()
        return None

    def _error(self, call: Call, outcome: AttemptOutcome) -> MergeRunnerError | None:
        message = outcome.message or outcome.name
        if outcome.pause and self._is_long(outcome):
            return QuotaExhausted(
                f"{self.driver}: the provider asks to wait {outcome.delay_s:.0f} s, longer than a "
                f"call's deadline of {self.entry.deadline_s:.0f} s ({message}). Every reply so far "
                "is saved; run the same command again later to go on."
            )
        match outcome.action:
            case "retry":
                return TryAgain(message, outcome.delay_s)
            case "fail":
                which = "reply" if outcome.name == "reply_refused" else "request"
                return RequestFailed(f"the {which} was rejected")
            case "quota":
                return QuotaExhausted(
                    f"{self.driver}: the account's quota is exhausted ({message}). Every reply so "
                    "far is saved; when there is credit again, run the same command to go on."
                )
            case "refused":
                return EndpointRefused(f"{self.driver}: {self._advice(outcome)} ({message})")
        return TryAgain("empty answer") if self._is_asked_again(call, outcome) else None

    def _is_asked_again(self, call: Call, outcome: AttemptOutcome) -> bool:
        """Whether an empty answer is a passing fault, as servers of some formats have."""
        if outcome.name != "empty" or not FORMATS[self.entry.format].retries_empty:
            return False
        return sum(a.outcome == "empty" for a in call.own_attempts) <= EMPTY_RETRIES

    def _advice(self, outcome: AttemptOutcome) -> str:
        """What to do where the endpoint refuses all calls."""
        if outcome.name == "not_allowed":
            return f"the endpoint does not accept the key; {set_key(self.name, self.entry)}"
        if outcome.name == "bad_certificate":
            return (
                "the endpoint's certificate cannot be trusted, and nothing was sent; check the "
                "base URL, or set SSL_CERT_FILE to the certificates of whoever signed it"
            )
        shutdown = self.entry.shutdown
        retired = f", which was announced to shut down on {shutdown}" if shutdown else ""
        other = "" if self.own_host else f", or {set_base_url(self.name, self.entry)}"
        return f"the endpoint has no model {self.entry.id!r}{retired}; see {MODELS}{other}"
