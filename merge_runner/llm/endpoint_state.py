"""State of an endpoint in a run, and the error that follows from an attempt there."""

from __future__ import annotations

from dataclasses import dataclass, field

from merge_runner.driver_names import driver_name
from merge_runner.errors import EndpointRefused, MergeRunnerError, ProviderDown, QuotaExhausted
from merge_runner.llm.call import Call
from merge_runner.llm.delays import TryAgain, utc_after
from merge_runner.llm.formats.wire import WireFormat
from merge_runner.llm.http_outcome import AttemptOutcome
from merge_runner.llm.prices import underpriced_tiers
from merge_runner.llm.rejections import UNSURE, if_nobody, reason_of, why_rejected
from merge_runner.providers import ModelEntry
from merge_runner.records import CallFailed

# How long a first call waits for a server that refuses connections.
NOBODY_S = 5.0
# For formats that know empty answers as a transient fault of their service.
MAX_EMPTY_RETRIES = 2
# So many rejections by an endpoint that has answered before mean a wrong configuration.
MAX_REJECTIONS = 3
# Part of the name of Gemini's daily quotas, whose delay is meaningless.
GEMINI_DAY = "PerDay"


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
