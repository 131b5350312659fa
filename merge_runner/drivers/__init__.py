"""Drivers of vehicles: the built-in programs, and language models."""

# The built-in programs: the import of each registers it in PROGRAMS.
from merge_runner.drivers import (
    cei,
    constant,
    human_odds,
    human_replay,
    idm,
    projected_order,
    quantal,
)

__all__ = ["cei", "constant", "human_odds", "human_replay", "idm", "projected_order", "quantal"]
