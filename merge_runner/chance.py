"""Deterministic random numbers: functions of their arguments, equal on every machine."""

from __future__ import annotations

import hashlib


def draw(*key: object) -> float:
    """Return a uniform number in [0, 1) that depends on the arguments' texts alone."""
    digest = hashlib.sha256("\x1f".join(map(str, key)).encode()).digest()
    return int.from_bytes(digest[:7]) / 2**56


def draw_index(count: int, *key: object) -> int:
    """Return a uniform integer in [0, count)."""
    return int(draw(*key) * count)


def draw_between(low: float, high: float, *key: object) -> float:
    """Return a uniform number between two bounds."""
    return low + (high - low) * draw(*key)
