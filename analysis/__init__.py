"""Analyses of what lies in the results database."""
