"""The time at which a sweep stops by itself: ``--until``."""

from __future__ import annotations

from datetime import datetime, time, timedelta

from merge_runner.errors import UsageError

# How long trials that have begun may go on: a few calls each. What they do not finish by then is
# not lost, since their replies are kept.
GRACE_S = 60.0


def deadline(text: str, now: datetime) -> datetime:
    """The next time that a text names, local time of day or an ISO date-time, after ``now``.

    Raises UsageError.
    """
    try:
        named: time | datetime = time.fromisoformat(text)
    except ValueError:
        named = _date_time(text)
    if isinstance(named, datetime):
        found = named.astimezone()  # one without a zone is local
    else:
        # Through local times without a zone, since a night may have 23 or 25 hours.
        today = datetime.combine(now.astimezone().replace(tzinfo=None), named.replace(tzinfo=None))
        found = today.astimezone()
        if found <= now:
            found = (today + timedelta(days=1)).astimezone()
    if found <= now:
        raise UsageError(f"--until {text} is over: name a time to come, such as 07:00")
    return found


def _date_time(text: str) -> datetime:
    try:
        return datetime.fromisoformat(text)
    except ValueError as exc:
        raise UsageError(
            f"--until {text!r} is no time: a time of day such as 07:00, or a date and time such as "
            "2027-01-31T07:00"
        ) from exc
