"""The first live call of a run goes alone: a wrong key, URL or parameter is found by one call.

The others wait until an endpoint has answered it. Where no other call would fare better the run
ends, with one line that says what to set.
"""

from __future__ import annotations

import asyncio
from urllib.parse import urlsplit

from merge_runner.config import PROVIDERS, ModelEntry
from merge_runner.llm.formats.base import as_dict, as_text
from merge_runner.llm.http_outcome import AttemptOutcome, RawReply, is_web_page

NOBODY_S = 5.0
SEVERAL = 3
REGISTRY = "experiments/models.toml"
REQUEST_ITSELF = (400, 413, 422, 429)


class FirstCall:
    """Whether an endpoint has answered: ``passed`` in this run, ``known`` ever, in its format."""

    def __init__(self, *, passed: bool = False, known: bool = False) -> None:
        self.passed = passed
        self.known = known
        self._refused = 0
        self._alone = asyncio.Lock()

    async def turn(self) -> bool:
        """Wait until a call may go; True if it goes alone, until ``give_turn``."""
        await self._alone.acquire()
        if self.passed:  # it was answered while this call waited: nobody goes alone any more
            self._alone.release()
        return not self.passed

    def give_turn(self) -> None:
        """The call that went alone has ended, and another one may go."""
        self._alone.release()

    def is_final(self, outcome: AttemptOutcome) -> bool:
        """Whether a refusal holds for all calls.

        An endpoint that has answered before may mean this prompt alone; several refusals mean
        the configuration.
        """
        self._refused += outcome.action == "fail"
        return not self.known or self._refused >= SEVERAL or outcome.action == "accept"

    def answered(self) -> None:
        """The endpoint has answered in its format."""
        self.passed = self.known = True


def refusal(name: str, entry: ModelEntry, raw: RawReply, outcome: AttemptOutcome) -> str | None:
    """Why no other call of a run would fare better, and what to set; None: one might."""
    if is_web_page(raw) and raw.status == 200:
        return f"a web page answers there, and no language model: {set_base_url(name, entry)}"
    if outcome.name == "bad_body" and isinstance(raw.payload, dict):
        return f"what answers there does not speak {entry.format}: {set_base_url(name, entry)}"
    if outcome.action != "fail" or outcome.of_prompt:
        return None
    if raw.status not in (200, *REQUEST_ITSELF):
        return f"no language model answers there: {set_base_url(name, entry)} ({outcome.message})"
    return f"the request is refused: {_set_parameter(name, entry, raw)} ({outcome.message})"


def if_nobody(name: str, entry: ModelEntry) -> str:
    """What to do where nobody answers."""
    return (
        f"{PROVIDERS[entry.provider].if_nobody}, or {set_base_url(name, entry)}; then run the same "
        "command again"
    )


def set_base_url(name: str, entry: ModelEntry) -> str:
    """What to do about the base URL of an entry, and where it is set."""
    provider = PROVIDERS[entry.provider]
    if entry.base_url is not None or provider.base_url_env is None:
        return f"correct `base_url` of [{name}] in {REGISTRY}"
    path = urlsplit(provider.base_url).path
    ending = f" (with {path} at its end)" if path else ""
    return f"set {provider.base_url_env} to the base URL of the service{ending}, or unset it"


def set_key(name: str, entry: ModelEntry) -> str:
    """What to do about the key of an entry, and where it is set."""
    variables = (entry.key_env,) if entry.key_env else PROVIDERS[entry.provider].key_envs
    return f"set {' or '.join(variables) or f'`key_env` of [{name}] in {REGISTRY}'} to a valid one"


def _set_parameter(name: str, entry: ModelEntry, raw: RawReply) -> str:
    """Where to look for the parameter that an error names."""
    error = as_dict(as_dict(raw.payload).get("error"))
    said = f"{as_text(error.get('param'))} {as_text(error.get('message'))}"
    named = next((f"parameters.{each}" for each in entry.parameters if each in said), None)
    if named is None and any(words in said for words in ("max_", "tokens", "Request too large")):
        named = "max_output_tokens"
    return f"look at {f'`{named}` of ' if named else ''}[{name}] in {REGISTRY}"
