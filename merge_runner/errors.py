"""Errors that users see as one line, as a tree of exceptions.

Those of one call or attempt derive from MergeRunnerError where they are raised: CallFailed and
ReplayMiss (``records``), TryAgain, TransportFailure and BatchFailed (``llm``).
"""

from __future__ import annotations

from collections.abc import Iterable

MOST_NAMES = 40


class MergeRunnerError(Exception):
    """Base of all errors that users see as one line; the process ends with ``exit_code``."""

    exit_code = 1


class UsageError(MergeRunnerError):
    """Wrong usage or configuration; the message says what is valid and what to type next."""

    exit_code = 2


def unknown_name(
    kind: str, name: str, names: Iterable[str], hint: str = "", *, likely: str = ""
) -> UsageError:
    """Return the error for a name that is not in ``names``; it suggests the nearest of them.

    The message has the ``likely`` cause before the names, and a ``hint`` after them.
    """
    from difflib import get_close_matches

    valid = list(names)
    # A key's name has its table as a prefix.
    near = get_close_matches(name, valid) or get_close_matches(name.rpartition(".")[2], valid)
    more = f" and {len(valid) - MOST_NAMES} more" if len(valid) > MOST_NAMES else ""
    return UsageError(
        f"unknown {kind} {name!r}"
        + (f": {likely}" if likely else "")
        + f"; valid: {', '.join(valid[:MOST_NAMES]) or 'none'}{more}"
        + (f" ({hint})" if hint else "")
        + (f". Did you mean {' or '.join(near)}?" if near else "")
    )


class SweepStopped(MergeRunnerError):
    """The sweep stops; finished trials and replies stay stored."""


class EndpointRefused(SweepStopped):
    """The endpoint refuses every call: a bad key, or a model that is unknown or retired."""

    exit_code = 2


class QuotaExhausted(SweepStopped):
    """The account has no quota or credit left; waiting does not help."""

    exit_code = 3


class ProviderDown(SweepStopped):
    """Connections are refused, or trials fail in a row without a reply in between."""


class NoValidDecision(SweepStopped):
    """All first decisions of a model are invalid, and ``--keep-going`` is not set."""


class CacheFailed(SweepStopped):
    """The cache cannot be written or read, so that no reply could be stored."""


class TrialSuspended(MergeRunnerError):
    """The next call could exceed the cap; the trial's replies so far stay stored."""

    exit_code = 3


class StoreError(MergeRunnerError):
    """The database cannot be written or read."""


class StoreLocked(StoreError):
    """Another program holds the database longer than the program waits."""


class RecordingError(MergeRunnerError):
    """A recording is damaged, or was not written by merge-runner."""
