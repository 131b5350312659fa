"""Simplified merge: pure functions of positions and speeds, without I/O."""
