"""A sweep: its plan, the players of its trials, their storage, and the display."""
