"""Studies: their files, their parts, and what their factors cross to."""
