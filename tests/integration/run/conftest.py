"""Fixtures for sweeps on a cluster."""

from __future__ import annotations

from tests.support.cluster import scheduler, started

__all__ = ["scheduler", "started"]
