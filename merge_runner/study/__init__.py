"""Studies: file, plug-ins, prompts, conditions, and the full factorial design."""
