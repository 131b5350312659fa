"""Consistency checks of stored requests, replies and states, and of unique samples."""
