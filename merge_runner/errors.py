"""Everything that can go wrong, as one tree of exceptions."""

from __future__ import annotations

from collections.abc import Iterable

MOST_NAMES = 40


class MergeRunnerError(Exception):
    """The base of all errors that reach a user as one line; ``exit_code`` is the process's."""

    exit_code = 1


class UsageError(MergeRunnerError):
    """Wrong usage or configuration; the message says what is valid and what to type next."""

    exit_code = 2


def unknown_name(
    kind: str, name: str, names: Iterable[str], hint: str = "", *, likely: str = ""
) -> UsageError:
    """Return the error for a name that is none of ``names``; it suggests the nearest of them.

    What is most ``likely`` meant stands before them, and a ``hint`` behind them.
    """
    from difflib import get_close_matches

    valid = list(names)
    # The name of a key has its table before it.
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
    """The whole sweep stops; finished trials and saved replies are kept."""


class EndpointRefused(SweepStopped):
    """The endpoint refuses every call: a bad key, or a model that is unknown or retired."""

    exit_code = 2


class QuotaExhausted(SweepStopped):
    """The account has no quota or credit left; waiting does not help."""

    exit_code = 3


class ProviderDown(SweepStopped):
    """Nobody listens, or one trial after the other fails and no call is answered between them."""


class NoValidDecision(SweepStopped):
    """The first decisions of a model are all invalid, and the user has not said to go on."""


class CacheFailed(SweepStopped):
    """The cache can be neither written nor read, so that no reply could be kept."""


class TrialSuspended(MergeRunnerError):
    """The next call could exceed ``--max-cost``; the trial's replies so far are kept."""

    exit_code = 3


class StoreError(MergeRunnerError):
    """The database cannot be written or read."""


class StoreLocked(StoreError):
    """Another program holds the database for longer than we wait."""


class RecordingError(MergeRunnerError):
    """A recording is damaged, or is not one of ours."""
