"""Driving task: the simplified merge."""
