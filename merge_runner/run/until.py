"""The time at which a sweep stops by itself: ``--until``."""

from __future__ import annotations

import re
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
    if isinstance(named, time) and named.tzinfo is not None:
        raise UsageError(f"--until {text}: a time of day is local; with a zone, name the date, too")
    if isinstance(named, datetime):
        found = named.astimezone()  # one without a zone is local
    else:
        # Through local times without a zone, since a night may have 23 or 25 hours.
        today = datetime.combine(now.astimezone().replace(tzinfo=None), named)
        found = today.astimezone()
        if found <= now:
            found = (today + timedelta(days=1)).astimezone()
    if found <= now:
        raise UsageError(f"--until {text} is over: name a time to come, such as 07:00")
    return found


def duration_s(text: str, option: str) -> float:
    """The seconds that a text such as 2h, 90m or 0 names; raises UsageError."""
    found = re.fullmatch(r"([0-9]{1,6}(?:\.[0-9]{1,3})?)\s*(h|m|min|s|)", text.strip())
    if found is None or (found[2] == "" and float(found[1])):
        raise UsageError(f"{option} {text!r} is no duration: write 2h, 90m, 30s or 0")
    return float(found[1]) * {"h": 3600, "m": 60, "min": 60}.get(found[2], 1)


def _date_time(text: str) -> datetime:
    try:
        return datetime.fromisoformat(text)
    except ValueError as exc:
        raise UsageError(
            f"--until {text!r} is no time: a time of day such as 07:00, or a date and time such as "
            "2027-01-31T07:00"
        ) from exc
