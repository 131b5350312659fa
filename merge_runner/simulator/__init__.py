"""The driving task: pure functions of positions and speeds, without I/O."""
