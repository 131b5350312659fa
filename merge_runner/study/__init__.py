"""A study: its file, its prompts and conditions, its plug-ins, and what its factors cross to."""
