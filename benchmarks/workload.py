"""Workload of every runner of the comparison: trials of two drivers who decide ten times."""

TRIALS, CALLS = 110, 20
PROMPT = "You drive the left vehicle; the other one is 12.3 m ahead at 9.8 m/s. " * 57
"""A prompt of 4 KB; what numbers it goes before it."""
