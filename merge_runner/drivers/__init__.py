"""Whoever decides how a vehicle accelerates: a language model or a plain program."""

# The built-in programs, each of which registers itself: the registry knows none of them.
from merge_runner.drivers import constant, human_odds, idm, projected_order, quantal

__all__ = ["constant", "human_odds", "idm", "projected_order", "quantal"]
